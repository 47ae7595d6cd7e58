"""The best possible errors of a run are those of the prior's fit to its shape, if it is evaluated in the same way."""

import pytest

from bench.records.metrics import LOWER, better_direction
from bench.records.shipped import FITS, SURFACE_METRICS, best_possible, cell_value, shipped_rows
from tests.composing import identified


@pytest.mark.parametrize(("family", "index"), [("sofa", 0), ("car", 7)])
def test_a_completion_has_the_errors_of_the_fit_to_its_shape(family, index):
    run = identified("task=completion", f"dataset={family}", f"index={index}")
    (row,) = [row for row in shipped_rows(FITS) if row["scene"] == f"{family} test {index}"]
    best = best_possible(run.config)
    assert best == {name: float(row[f"metrics.{name}"]) for name in SURFACE_METRICS}
    assert all(best[name] < 0.02 if better_direction(name) == LOWER else best[name] > 0.9 for name in best)


@pytest.mark.parametrize("other", ["index=8", "scale=smoke", "evaluation.points=999", "field=box", "prior.steps=9"])
def test_another_shape_prior_or_evaluation_has_none(other):
    assert best_possible(identified("task=completion", other).config) == {}


@pytest.mark.parametrize(
    ("cell", "value"), [("[1]", [1]), ("{}", {}), ("1e3", 1000.0), ("null", None), ("dist", "dist")]
)
def test_a_cell_is_json_or_text_and_shares_no_list(cell, value):
    first, second = cell_value(cell), cell_value(cell)
    assert first == second == value and (first is not second or not isinstance(value, list | dict))
