"""bench.compare on shipped runs of the suite, and bench.plot on run folders with known numbers."""

import numpy as np
import pytest

import bench
from bench.report.write import paper
from tests.report.test_report_sweeps import cell, ran

SHIPPED = paper.SHIPPED  # before tests/conftest.py replaces it


@pytest.fixture
def shipped(monkeypatch) -> None:
    monkeypatch.setattr(paper, "SHIPPED", SHIPPED)


@pytest.mark.usefixtures("shipped")
def test_a_comparison_agrees_with_its_reverse_and_with_the_table_of_the_suite(tmp_path):
    table = bench.compare(["newton", "dist", "DVR, n = 64, early stop"], tmp_path)
    assert list(table.index) == ["DIST, our default", "DVR, n = 64, early stop"] and {*table["versus"]} == {"Newton"}
    assert np.allclose(table["difference"], table["progress"] - table["progress_versus"])
    assert ((table["low"] < table["difference"]) & (table["difference"] < table["high"])).all()
    assert list(table["significant"]) == [False, True] and {*table["scenes"]} == {24}
    reverse = bench.compare(["dvr_64_early_stop", "newton"], tmp_path).loc["Newton"]
    same = table.loc["DVR, n = 64, early stop"]
    assert reverse["difference"] == pytest.approx(-same["difference"])
    assert reverse["p_uncorrected"] == same["p_uncorrected"]
    assert reverse["low"] == pytest.approx(-same["high"], abs=1e-6)


@pytest.mark.usefixtures("shipped")
def test_a_renderer_without_runs_is_named_with_the_command_that_makes_them(tmp_path):
    with pytest.raises(ValueError, match=r"'newtn' .* at 1 unit: did you mean newton\?; complete are DIST"):
        bench.compare(["dist", "newtn"], tmp_path)
    with pytest.raises(ValueError, match="two renderers or more"):
        bench.compare("newton")


def test_a_chart_has_the_median_of_all_runs_and_a_point_per_run_that_ended_ok(tmp_path):
    for seed, chamfer in enumerate((0.001, 0.004, None)):
        ran(tmp_path, cell("dist", seed=seed), chamfer, evaluations={"cost": 100 * (seed + 1)})
        ran(tmp_path, cell("dvr", seed=seed), 0.002, evaluations={"cost": 500})
    figure = bench.plot(bench.load(tmp_path))
    (axes,) = figure.axes
    assert axes.get_ylabel() == "Chamfer (x1000)" and axes.get_yscale() == "log"
    points = {tuple(map(float, pair)) for line in axes.lines for pair in zip(*line.get_data(), strict=True)}
    assert {(150.0, 4.0), (500.0, 2.0)} <= points  # DIST: the median of 1, 4 and infinity
    (names,) = ([text.get_text() for text in legend.get_texts()] for legend in figure.legends)
    assert sorted(names) == ["DIST (1 of 3 failed)", "DVR"]


def test_a_chart_of_several_tasks_or_without_the_error_is_refused(tmp_path):
    ran(tmp_path, cell("dist"), 0.001, evaluations={"cost": 1})
    ran(tmp_path, cell("dvr"), 0.001, evaluations={"cost": 1}, task="pose")
    runs = bench.load(tmp_path)
    with pytest.raises(ValueError, match="several values of task: completion, pose; select one"):
        bench.plot(runs)
    pose = runs[runs.task == "pose"]
    with pytest.raises(ValueError, match="no run has the error 'chamfer_l3': did you mean chamfer_l2"):
        bench.plot(pose, error="chamfer_l3")
    with pytest.raises(ValueError, match="no run has a default cost: name a column, cost=COLUMN"):
        bench.plot(pose.drop(columns="evaluations_cost"))
    with pytest.raises(ValueError, match="no column 'task'"):
        bench.plot(pose.drop(columns="task"))
    with pytest.raises(ValueError, match="there are no runs to draw"):
        bench.plot(runs[:0])


def test_a_folder_within_a_results_folder_is_refused_with_the_right_one(tmp_path):
    ran(tmp_path, cell("dist"), 0.001)
    runs = next((tmp_path / "runs").iterdir())
    for within in (tmp_path / "runs", runs):
        with pytest.raises(ValueError, match=f"lies in the results folder {tmp_path}: name that folder"):
            bench.load(within)
