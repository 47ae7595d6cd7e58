"""A page over one condition: its ratios and its verdict on made runs."""

from dataclasses import dataclass

import pandas as pd
import pytest

from bench.report.condition_curves import ConditionCurves, Measure

SHAPES = [("sofa", f"sofa {index}") for index in range(8)]


@dataclass
class Made:
    """What a page reads of its runs."""

    frame: pd.DataFrame
    records: list

    @property
    def executed(self):
        return self

    def number(self, name):
        return self.frame[name]


def runs_of(errors: dict[tuple[str, float], float]) -> Made:
    """Runs of 8 shapes: the error of a row at a value of the condition, times a factor of the shape."""
    lines = [
        {"family": family, "solid": solid, "seed": 0, "row": row, "preset": row.lower(), "status": "ok"}
        | {"config.key": value, "error": error * (1 + index), "psnr": 20.0, "evaluations_cost": 100.0}
        for (row, value), error in errors.items()
        for index, (family, solid) in enumerate(SHAPES)
    ]
    return Made(pd.DataFrame(lines), [])


def page(**more) -> ConditionCurves:
    measures = (Measure("error", "Error", 10.0), Measure("psnr", "PSNR", failed=0.0))
    more = {"first": 1, "compared": 4} | more
    return ConditionCurves(
        "key", "Key", measures=measures, title="T.", question="Q?", verdict="Error", notes=lambda _: [], **more
    )


def test_a_row_is_compared_with_itself_at_the_first_value(monkeypatch):
    made = runs_of({("A", 1): 2.0, ("A", 4): 1.0, ("B", 1): 1.0, ("B", 4): 1.0})
    lines = page()._lines(made.frame.assign(value=made.frame["config.key"], cost=1.0, error=10 * made.frame.error))
    by_cell = {(line["name"], line["value"]): line for line in lines}
    assert by_cell["A", 4]["ratio"] == pytest.approx(0.5) and by_cell["A", 1]["ratio"] is None
    assert by_cell["A", 1]["error"] == pytest.approx(10 * 2.0 * 4.5, rel=0.1)
    verdict = page()._verdict(page()._over_first(lines))
    assert "*0.500* (A)" in verdict and "1 other ratio is not significantly different" in verdict
    assert "n = 8 shapes" in verdict
    further = runs_of({("A", 1): 2.0, ("A", 4): 1.0, ("A", 16): 4.0})
    lines = page()._lines(further.frame.assign(value=further.frame["config.key"], cost=1.0))
    ratios = page(also_compared=(16,))._over_first(lines)
    assert {name: ratio.value for name, ratio in ratios.items()} == pytest.approx({"A at 4": 0.5, "A at 16": 2})


def test_a_page_says_that_no_row_has_the_compared_value():
    assert "No ratio at key 4" in page()._verdict({})


def test_rows_are_compared_with_the_reference_on_common_shapes():
    made = runs_of({("A", 4): 2.0, ("B", 4): 1.0})
    frame = made.frame.assign(value=made.frame["config.key"])
    ratios = page(reference="a")._against_reference(frame[(frame.row == "A") | (frame.solid != "sofa 0")])
    assert ratios.keys() == {"B"} and ratios["B"].value == pytest.approx(0.5) and len(ratios["B"].points) == 7


def test_a_metric_that_no_run_of_a_line_has_is_neither_shown_nor_drawn():
    made = runs_of({("A", 1): 2.0, ("A", 4): 1.0})
    frame = made.frame.assign(value=made.frame["config.key"], cost=1.0)
    frame["psnr"] = frame["psnr"].where(frame["value"] == 4)
    lines = page()._lines(frame)
    assert [set(line["estimates"]) for line in lines] == [{"error"}, {"error", "psnr"}]
    drawn = page()._panel(lines, page().measures[1])["series"]
    assert [series["x"] for series in drawn] == [[1]]  # the position of 4 among the values
