"""The comparison of rows and its pages, from run folders with given errors and costs."""

import json

import numpy as np
import pytest

from bench.records.read import read_records
from bench.report.compare import ALL_FAMILIES, HOLM, Compared, differing, ordered
from bench.report.data import statistics
from bench.report.data.runs import Runs, Selection, choose
from bench.report.write.result import Result
from tests.report.test_report_paper import write_run

SELECTION = Selection("mine", ("task.points",))
# The error over DIST's error, the field evaluations, the seconds of the loop.
METHODS = {"dist": (1.0, 1000, 4.0), "newton": (0.5, 500, 8.0), "neus": (0.25, 9000, 30.0), "volsdf": (2.0, 9000, 40.0)}


def page(runs: Runs) -> Result:
    """A page of the ratios to DIST."""
    comparison = Compared(runs, lambda _: "dist_mask")
    verdict = f"{comparison.best('errors')} {comparison.differing('to DIST')}".strip()
    return comparison.result("Rows.", "Which?", verdict=verdict, columns=comparison.columns("Ratio to DIST"))


def compared(results, *, families=("sofa", "plane"), shapes=6, failed=()):
    """Writes runs of every method; an error is the method's error times the shape's factor."""
    for name in families:
        for index, points in ((i, p) for i in range(shapes) for p in ("100", "20")):
            for renderer, (factor, values, seconds) in METHODS.items():
                ok = (renderer, name, index) not in failed
                error = factor * (1 + index) * (4 if points == "20" else 1) * (9 if name == "plane" else 1) / 1000
                silhouette = {"_target_": "renderers.silhouette.Hinge", "_label_": "DIST's mask loss"}
                write_run(
                    results, "mine", f"{renderer} with mask", task="completion", dataset=name, renderer=renderer,
                    method=f"{renderer}_mask", status="ok" if ok else "empty", evaluations={"value": values},
                    metrics={"chamfer_l2": error} if ok else {}, index=index,
                    seconds={"forward": seconds / 2, "backward": seconds / 2},
                    settings={"task": {"points": points, "_target_": "completion"}, "silhouette": silhouette},
                )  # fmt: skip
    return choose(read_records(results)[0], SELECTION, results)


@pytest.fixture(scope="module")
def complete_runs(tmp_path_factory):
    """The runs without a failure, written once."""
    return compared(tmp_path_factory.mktemp("complete"))


def ratio_of_eight(ratios):
    """The ratio of a row over eight shapes, which have two ratios in turn."""
    return statistics.ratio([np.array([ratio]) for ratio in ratios * 4], [np.ones(1)] * 8)


def page_of_kept(runs, keep):
    """The page of the runs that `keep` selects."""
    return page(type(runs)(runs.selection, runs.results_dir, [*filter(keep, runs.records)]))


def line(result, row, family=ALL_FAMILIES):
    """The line of the page's data of a row and family."""
    rows = result.data[(result.data["row"] == row) & (result.data["family"] == family)]
    assert len(rows) == 1
    return rows.iloc[0]


def test_a_line_has_errors_ratio_cost_and_both_fronts(complete_runs):
    result = page(complete_runs)
    newton = line(result, "newton with mask")
    assert newton["ratio"] == "0.500 [0.500, 0.500]; 12 of 12"
    assert (newton["evaluations"], newton["seconds"], newton["failed"]) == (500, 8.0, "0 of 24")
    assert newton["100"] == pytest.approx(0.5 * (6 + 9) / 2)  # of sofas 1 to 6 and planes 9 to 54
    plane = line(result, "newton with mask", "plane")
    assert plane["error"] == pytest.approx(0.5 * 12 ** (1 / 2) * 2 * 9)  # of shapes 1 to 6, points 1 and 4
    assert plane["100"] == pytest.approx(0.5 * 3.5 * 9) and plane["20"] == pytest.approx(0.5 * 3.5 * 9 * 4)
    assert line(result, "dist with mask")["ratio"] == ""
    assert "*3 of 3* ratios to DIST differ from 1: newton with mask 0.500 [0.500, 0.500];" in result.verdict


def test_a_failure_counts_as_the_worst_error_of_its_shape(tmp_path):
    result = page(compared(tmp_path, families=("sofa",), failed={("newton", "sofa", 0)}))
    newton = line(result, "newton with mask", "sofa")
    assert newton["failed"] == "2 of 12"
    assert newton["error"] == pytest.approx(4)  # of 2 to 6, and of VolSDF's 4 on the first shape


def test_conditions_stand_from_many_points_to_few():
    conditions = {"9", "dense", "500", "20", "mine", "90", "10%", "100"}
    assert ordered(conditions) == ["dense", "10%", "500", "100", "90", "20", "9", "mine"]


def test_without_the_reference_there_is_no_ratio_and_no_verdict(complete_runs):
    result = page_of_kept(complete_runs, lambda record: record["renderer"] != "dist")
    assert set(result.data["ratio"]) == {""} and "ratios to" not in result.verdict


def test_if_all_runs_failed_there_is_no_verdict(tmp_path):
    failed = {(renderer, "sofa", 0) for renderer in METHODS}
    result = page(compared(tmp_path, families=("sofa",), shapes=1, failed=failed))
    assert result.verdict == ""


def test_the_verdict_names_the_best_and_the_quickest(complete_runs):
    verdict = page(complete_runs).verdict
    assert "(neus with mask, 30.0 s)" in verdict and "(dist with mask, 4.00 s); n = 12 shapes." in verdict


def test_a_shape_that_lacks_a_condition_is_left_out_of_the_mean_and_the_row_has_no_rank(complete_runs):
    def keep(record):
        cell = (record["method"], record["config"]["index"], record["config"]["task"]["points"])
        return record["dataset"] == "sofa" and cell != ("newton_mask", 5, "100")

    result = page_of_kept(complete_runs, keep)
    newton = line(result, "newton with mask", "sofa")
    assert newton["ratio"].endswith("(n = 5); 5 of 5") and newton["failed"] == "0 of 11, 1 missing"
    assert "newton" not in result.verdict


def test_rows_without_a_common_shape_are_not_ranked(complete_runs):
    datasets = {"dist_mask": "sofa", "newton_mask": "plane"}
    assert page_of_kept(complete_runs, lambda record: datasets.get(record["method"]) == record["dataset"]).verdict == ""


def test_the_reference_is_the_first_row_of_the_plan_not_the_oldest_of_its_preset(tmp_path):
    cells = []
    for label, factor in (("tried before", 3), ("DIST", 2), ("Newton", 1)):
        fields = {"renderer": "dist", "method": "newton_mask" if factor == 1 else "dist_mask"}
        fields |= {"task": "completion", "metrics": {"chamfer_l2": factor / 1000}}
        settings = {"task": {"points": "20"}, "renderer": {"steps": factor}}
        folder = write_run(tmp_path, "mine", label, settings=settings, **fields)
        names = dict.fromkeys(("task", "renderer", "dataset", "method"), "")
        cells.append({"id": folder.name, "overrides": [], "seed": 0, "config": {}} | names)
    runs = choose(read_records(tmp_path)[0], SELECTION, tmp_path)
    assert line(page(runs), "Newton", "car")["ratio"].startswith("0.333 ")  # without a plan
    (tmp_path / "sweeps" / "one").mkdir(parents=True)
    plan = {"schema": 1, "name": "one", "asked": "2025-03-01T12:00:00+00:00", "cells": cells[1:]}
    (tmp_path / "sweeps" / "one" / "plan.json").write_text(json.dumps(plan))
    planned = page(runs)
    assert line(planned, "Newton", "car")["ratio"].startswith("0.500 ")
    assert line(planned, "DIST", "car")["ratio"] == ""


def test_rows_of_families_with_other_evaluations_are_named(tmp_path):
    for name, points in (("sofa", 1000), ("plane", 5000)):
        evaluation = {"evaluation": {"points": points}, "prior": {"name": name}}
        write_run(tmp_path, "mine", "DIST", dataset=name, settings=evaluation)
    assert choose(read_records(tmp_path)[0], SELECTION, tmp_path).mixed() == ["evaluation.points"]


def test_a_verdict_counts_the_ratios_that_differ_from_1():
    verdict = differing([("worse", ratio_of_eight([2.0, 2.0])), ("mixed", ratio_of_eight([1.5, 0.7]))], "to DIST")
    assert verdict.startswith(f"{HOLM}, *1 of 2* ratios to DIST differ from 1: worse 2.00")
    assert verdict.endswith("; 1 cannot be distinguished from 1.")


def test_a_ratio_with_seven_of_eight_shapes_is_no_difference():
    seven = statistics.ratio([np.array([0.5])] * 7 + [np.array([2.0])], [np.ones(1)] * 8)
    verdict = differing([("one", seven), ("other", seven)], "to DIST")
    assert verdict.startswith(f"{HOLM}, *0 of 2* ratios to DIST differ from 1; 2 cannot be distinguished from 1.")


def test_a_verdict_says_that_the_shapes_cannot_decide():
    verdict = differing([(f"row {n}", ratio_of_eight([2.0, 2.0])) for n in range(7)], "to DIST")
    assert "*cannot be decided with 8 shapes*" in verdict and "7 ratios need 9 shapes or more" in verdict
    assert differing([("none", None)], "to DIST") == ""


def test_its_panels_have_a_line_per_row_the_least_error_first(complete_runs):
    errors, ratios, evaluations, seconds = Compared(complete_runs, lambda _: "dist_mask").panels("Ratio to DIST")
    names = [f"{name} with mask" for name in ("neus", "newton", "dist", "volsdf")]
    assert [panel["rows"] for panel in (errors, ratios, evaluations, seconds)] == [names] * 4
    assert [(points["name"], points["y"]) for points in errors["series"]] == [
        (name, [n]) for n, name in enumerate(names)
    ]
    equal, *points = ratios["series"]
    assert equal["x"] == [1, 1] and ratios["x"] == {"title": "Ratio to DIST", "log": True}
    assert [(line["x"], line["y"]) for line in points] == [([0.25], [0]), ([0.5], [1]), ([2.0], [3])]
    assert [line["x"] for line in evaluations["series"]] == [[9000], [500], [1000], [9000]]
