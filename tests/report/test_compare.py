"""The comparison of rows and its pages, made from run folders whose errors and costs are known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bench.records.read import read_records
from bench.report.compare import ALL_FAMILIES, Compared, Comparison, differing, ordered
from bench.report.data import statistics
from bench.report.data.runs import Runs, Selection, choose
from bench.report.write.result import Result
from tests.report.test_report_paper import write_run

SELECTION = Selection("mine", ("task.points",))
# Error over DIST's, field values, seconds of the loop of a run.
METHODS = {"dist": (1.0, 1000, 4.0), "newton": (0.5, 500, 8.0), "neus": (0.25, 9000, 30.0), "volsdf": (2.0, 9000, 40.0)}


def page(runs: Runs) -> Result:
    """A page of the ratios to DIST."""
    made = Comparison("Rows.", "Which?", "dist_mask", "DIST", lambda _: (), least_of="errors")(runs)
    return replace(made, verdict=f"{made.verdict} {Compared(runs, 'dist_mask').differing('to DIST')}".strip())


def compared(results, *, families=("sofa", "plane"), shapes=6, failed=()):
    """Runs of every method; the error of a shape is that of its method times the shape's own."""
    for name in families:
        for index, points in ((i, p) for i in range(shapes) for p in ("100", "20")):
            for renderer, (factor, values, seconds) in METHODS.items():
                ok = (renderer, name, index) not in failed
                error = factor * (1 + index) * (4 if points == "20" else 1) * (9 if name == "plane" else 1) / 1000
                write_run(
                    results,
                    "mine",
                    f"{renderer} with mask",
                    **{"task": "completion", "dataset": name, "renderer": renderer},
                    **{"method": f"{renderer}_mask", "status": "ok" if ok else "empty"},
                    metrics={"chamfer_l2": error} if ok else {},
                    evaluations={"value": values},
                    seconds={"forward": seconds / 2, "backward": seconds / 2},
                    index=index,
                    settings={
                        "task": {"points": points, "_target_": "completion"},
                        "silhouette": {"_target_": "renderers.silhouette.Hinge", "_label_": "DIST's mask loss"},
                    },
                )
    return choose(read_records(results)[0], SELECTION, results)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The runs without a failure, written once."""
    return compared(tmp_path_factory.mktemp("whole"))


def of_eight(ratios):
    """Ratios of the errors of a row, in turn, on eight shapes."""
    return statistics.ratio([np.array([ratio]) for ratio in ratios * 4], [np.ones(1)] * 8)


def kept(runs, keep):
    """The page of those runs alone that are to be kept."""
    return page(type(runs)(runs.selection, runs.results_dir, [*filter(keep, runs.records)]))


def line(result, row, family=ALL_FAMILIES):
    """The only line of the page's data of a row and family."""
    found = result.data[(result.data["row"] == row) & (result.data["family"] == family)]
    assert len(found) == 1
    return found.iloc[0]


def test_a_line_has_errors_ratio_and_cost(whole):
    result = page(whole)
    newton = line(result, "newton with mask")
    assert newton["ratio"] == "0.500 [0.500, 0.500]; 12 of 12"
    assert (newton["evaluations"], newton["seconds"], newton["failed"]) == (500, 8.0, "0 of 24")
    assert newton["100"] == pytest.approx(0.5 * (6 + 9) / 2)  # of sofas 1 to 6 and planes 9 to 54
    own = line(result, "newton with mask", "plane")
    assert own["error"] == pytest.approx(0.5 * 12 ** (1 / 2) * 2 * 9)  # of shapes 1 to 6, points 1 and 4
    assert own["100"] == pytest.approx(0.5 * 3.5 * 9) and own["20"] == pytest.approx(0.5 * 3.5 * 9 * 4)
    assert line(result, "dist with mask")["ratio"] == ""
    assert "*3 of 3* error ratios to DIST differ significantly from 1 by the sign test" in result.verdict


def test_a_failure_counts_as_the_worst_error_of_its_shape(tmp_path):
    result = page(compared(tmp_path, families=("sofa",), failed={("newton", "sofa", 0)}))
    newton = line(result, "newton with mask", "sofa")
    assert newton["failed"] == "2 of 12"
    assert newton["error"] == pytest.approx(4)  # of 2 to 6, and of VolSDF's 4 on the first shape


def test_conditions_stand_from_many_points_to_few():
    found = {"9", "dense", "500", "20", "mine", "90", "10%", "100"}
    assert ordered(found) == ["dense", "10%", "500", "100", "90", "20", "9", "mine"]


def test_without_the_reference_there_is_no_ratio_and_no_verdict(whole):
    result = kept(whole, lambda record: record["renderer"] != "dist")
    assert set(result.data["ratio"]) == {""} and "error ratios" not in result.verdict


def test_where_nothing_ended_well_there_is_no_verdict(tmp_path):
    every = {(renderer, "sofa", 0) for renderer in METHODS}
    result = page(compared(tmp_path, families=("sofa",), shapes=1, failed=every))
    assert result.verdict == ""


def test_the_verdict_names_the_best_and_the_quickest(whole):
    verdict = page(whole).verdict
    assert "(neus with mask, 30.0 s); n = 12 shapes." in verdict and "(dist with mask, 4.00 s)." in verdict


def test_a_shape_that_lacks_a_condition_is_left_out_of_the_mean_and_the_row_has_no_rank(whole):
    def keep(record):
        cell = (record["method"], record["config"]["index"], record["config"]["task"]["points"])
        return record["dataset"] == "sofa" and cell != ("newton_mask", 5, "100")

    result = kept(whole, keep)
    newton = line(result, "newton with mask", "sofa")
    assert newton["ratio"].endswith("(n = 5); 5 of 5") and newton["failed"] == "0 of 11, 1 missing"
    assert "newton" not in result.verdict


def test_rows_without_a_common_shape_are_not_ranked(whole):
    of = {"dist_mask": "sofa", "newton_mask": "plane"}
    assert kept(whole, lambda record: of.get(record["method"]) == record["dataset"]).verdict == ""


def test_the_reference_is_the_first_row_of_the_plan_not_the_oldest_of_its_preset(tmp_path):
    cells = []
    for label, factor in (("tried before", 3), ("DIST", 2), ("Newton", 1)):
        folder = write_run(
            tmp_path,
            "mine",
            label,
            **{"task": "completion", "renderer": "dist", "method": "newton_mask" if factor == 1 else "dist_mask"},
            metrics={"chamfer_l2": factor / 1000},
            settings={"task": {"points": "20"}, "renderer": {"steps": factor}},
        )
        cells.append(
            {"id": folder.name, "overrides": [], "seed": 0, "config": {}}
            | dict.fromkeys(("task", "renderer", "dataset", "method"), "")
        )
    runs = choose(read_records(tmp_path)[0], SELECTION, tmp_path)
    assert line(page(runs), "Newton", "car")["ratio"].startswith("0.333 ")  # without a plan
    (tmp_path / "sweeps" / "one").mkdir(parents=True)
    plan = {"schema": 1, "name": "one", "asked": "2025-03-01T12:00:00+00:00", "cells": cells[1:]}
    (tmp_path / "sweeps" / "one" / "plan.json").write_text(json.dumps(plan))
    found = page(runs)
    assert line(found, "Newton", "car")["ratio"].startswith("0.500 ")
    assert line(found, "DIST", "car")["ratio"] == ""


def test_rows_of_other_families_with_other_evaluations_are_told(tmp_path):
    for name, points in (("sofa", 1000), ("plane", 5000)):
        evaluation = {"evaluation": {"points": points}, "prior": {"name": name}}
        write_run(tmp_path, "mine", "DIST", dataset=name, settings=evaluation)
    assert choose(read_records(tmp_path)[0], SELECTION, tmp_path).mixed() == ["evaluation.points"]


def test_a_verdict_counts_the_ratios_that_differ_from_1():
    ratios = {name: of_eight([one, other]) for name, one, other in (("worse", 2.0, 2.0), ("mixed", 1.5, 0.7))}
    said = differing([*ratios.items()], "to DIST")
    assert said.startswith("*1 of 2* error ratios to DIST differ significantly from 1 by the sign test")
    assert "worse 2.00" in said and "mixed" not in said


def test_a_ratio_with_seven_of_eight_shapes_is_no_difference():
    seven = statistics.ratio([np.array([0.5])] * 7 + [np.array([2.0])], [np.ones(1)] * 8)
    said = differing([("one", seven), ("other", seven)], "to DIST")
    assert said.startswith("*0 of 2* error ratios to DIST differ significantly from 1")
    assert said.endswith("The test needs 8 of 8 shapes on one side of 1.")


def test_a_verdict_on_one_ratio_that_is_not_significant_has_its_value():
    said = differing([("one", of_eight([1.5, 0.7]))], "")
    assert said.startswith("one: the error ratio is *1.0") and "not significantly different from 1" in said


def test_a_verdict_that_no_data_could_give_is_none():
    said = differing([(f"row {n}", of_eight([2.0, 2.0])) for n in range(7)], "to DIST")
    assert "*cannot be decided with 8 shapes*" in said and "7 ratios need 9 shapes or more" in said
    assert differing([("none", None)], "to DIST") == ""


def test_its_panels_have_a_line_per_row_the_least_error_first(whole):
    errors, ratios, evaluations, seconds = Compared(whole, "dist_mask").panels("Ratio to DIST")
    names = [f"{name} with mask" for name in ("neus", "newton", "dist", "volsdf")]
    assert [panel["rows"] for panel in (errors, ratios, evaluations, seconds)] == [names] * 4
    assert [(each["name"], each["y"]) for each in errors["series"]] == [(name, [n]) for n, name in enumerate(names)]
    equal, *points = ratios["series"]
    assert equal["x"] == [1, 1] and ratios["x"] == {"title": "Ratio to DIST", "log": True}
    assert [(each["x"], each["y"]) for each in points] == [([0.25], [0]), ([0.5], [1]), ([2.0], [3])]
    assert [each["x"] for each in evaluations["series"]] == [[9000], [500], [1000], [9000]]
