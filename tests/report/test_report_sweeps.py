"""Any sweep has a table: a row for what varies, with failed cells counted and missing ones named."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from bench.records.read import read_plans, read_records
from bench.records.results import Plan, PlannedRun
from bench.report.__main__ import main as report
from bench.report.sweeps import COST, RUNTIME, lines, of_plan, table_of, write_sweep, write_sweeps
from bench.report.write.html import ASSETS
from bench.report.write.paper import find_sweeps
from tests.report.test_report import record, write_run

DRAWN = (
    "test_a_row_of_which_every_run_failed_is_in_the_table_and_the_chart",
    "test_a_swept_number_has_a_curve_and_no_front_and_failed_runs_cost_nothing",
)


@pytest.fixture(autouse=True)
def few_figures(request) -> None:
    if request.function.__name__ not in DRAWN:
        request.getfixturevalue("undrawn")


def cell(renderer: str, *, seed: int = 0, index: int = 0, dataset: str = "sofa", **asked: str) -> PlannedRun:
    """A planned cell; `asked` are keys of its renderer that the sweep asked for."""
    renderer_node = {"_label_": renderer.upper(), **asked}
    config = {"renderer": renderer_node, "seed": seed, "index": index, "experiment": None, "label": None}
    overrides = [f"renderer={renderer}", f"dataset={dataset}", f"seed={seed}", f"index={index}"]
    overrides += [f"+renderer.{key}={value}" for key, value in asked.items()]
    name = "-".join(override.replace("=", "") for override in overrides)
    return PlannedRun(name, overrides, "completion", renderer, dataset, seed, config)


def ran(results: Path, planned: PlannedRun, chamfer: float | None, **changed) -> None:
    """The run of a cell; without an error it crashed."""
    metrics = {} if chamfer is None else {"steps_taken": 9, "fscore": 1 - chamfer, "chamfer_l2": chamfer}
    ended = {"status": "ok"} if chamfer is not None else {"status": "crashed", "reason": "as planned"}
    given = {"config": planned.config, "renderer": planned.renderer, "dataset": planned.dataset, "seed": planned.seed}
    content = record(planned.id, **{**given, "metrics": metrics, **ended, **changed})
    write_run(results, content, planned.id)


def swept(results: Path, cells: list[PlannedRun], name: str = "completion-1") -> None:
    Plan(name, results, cells).write()


def table(results: Path, name: str = "completion-1") -> pd.DataFrame:
    write_sweeps(read_records(results)[0], results, problems := [])
    assert problems == []
    return pd.read_csv(results / "sweeps" / name / "table.csv").set_index("row")


def test_rows_are_what_varies_beside_shapes_and_seeds(tmp_path):
    cells = [cell(r, dataset=d, seed=s) for r in ("dist", "dvr") for d in ("sofa", "plane") for s in (0, 1)]
    swept(tmp_path, cells)
    for number, one in enumerate(cells):
        ran(tmp_path, one, 0.001 * (number + 1))
    found = table(tmp_path)
    assert list(found.index) == ["DIST", "DVR"]
    assert list(found["chamfer_l2"]) == pytest.approx([0.0025, 0.0065])
    assert list(found["runs"]) == [4, 4] and list(found["failed"]) == [0, 0]
    assert found.loc["DVR", "ratio"] == pytest.approx((5.5 * 7.5 / (1.5 * 3.5)) ** 0.5)  # of medians over seeds
    assert math.isnan(found.loc["DIST", "ratio"])
    assert list(found["loop_seconds"]) == [30, 30] and list(found["value_evaluations"]) == [1.43e6] * 2
    assert found["chamfer_l2_low"].isna().all()  # two shapes give no interval


def test_one_failed_seed_of_three_leaves_the_ratio_of_its_shape_finite(tmp_path):
    cells = [cell(renderer, seed=seed) for renderer in ("dist", "dvr") for seed in (0, 1, 2)]
    swept(tmp_path, cells)
    for number, one in enumerate(cells):
        ran(tmp_path, one, 0.001 if number < 3 else 0.002, **({"status": "crashed"} if number == 5 else {}))
    assert table(tmp_path).loc["DVR", "ratio"] == pytest.approx(2)


def test_each_data_set_has_a_column_and_a_panel_with_the_best_in_bold_and_n_once(tmp_path):
    errors = {
        ("dist", "sofa"): 1.0,
        ("dist", "plane"): 4.0,
        ("dvr", "sofa"): 3.0,
        ("dvr", "plane"): 2.0,
        ("dvr", "car"): 9.0,
    }
    cells = [cell(renderer, dataset=dataset) for renderer, dataset in errors]
    swept(tmp_path, cells)
    for one, error in zip(cells, errors.values(), strict=True):
        ran(tmp_path, one, error / 1000)
    table(tmp_path)
    (found,) = find_sweeps(tmp_path)
    shown = found.shown
    assert shown.columns[1:4] == ["sofa: Chamfer (x1000) ↓", "plane: Chamfer (x1000) ↓", "Chamfer (x1000) ↓"]
    assert [row[:4] for row in shown.rows] == [["DIST", "1.00", "4.00", "2.50"], ["DVR", "3.00", "2.00", "3.00"]]
    assert [at for at in shown.best if at[1] < 4] == [[0, 1], [1, 2], [0, 3]]
    assert shown.question == "Which has the lowest Chamfer?"
    assert shown.verdict == (
        "Median Chamfer (x1000): *2.50* (DIST) to 3.00 (DVR); n = 3 shapes. Best by data set: sofa DIST, plane DVR. "
        "The rows have different shapes, so their medians do not compare."
    )
    assert "n = 5 runs (3 shapes, 1 seed); fewer than six shapes: no interval." in shown.caption
    panels = shown.chart["panels"]
    assert [panel["title"] for panel in panels] == ["sofa", "sofa", "plane", "plane"]
    assert [panel["x"]["title"] for panel in panels[:2]] == [COST, RUNTIME]
    series = {each["name"]: each for each in panels[2]["series"]}
    assert [*series] == ["front", "initial error, median", "DIST", "DVR"]
    assert (series["DVR"]["y"], series["DVR"]["shapes"]) == ([2.0], [[1_431_998, 2.0]])
    assert series["front"]["y"] == [2.0]
    text, tex = ((found.base.with_suffix(suffix)).read_text() for suffix in (".md", ".tex"))
    assert "| DIST | **1.00** | 4.00 |" in text and r"& \textbf{\boldmath 1.00} & 4.00 &" in tex and "(n = " not in text


def test_a_sweep_of_renderings_has_the_errors_and_costs_of_table_1(tmp_path):
    cells = [cell("dist"), cell("dvr")]
    swept(tmp_path, cells)
    measured = {"queries": 9, "lost": 2, "false": 1, "pixel_errors": 3, "depth_error_median": 1e-4, "cost": 9.0}
    for planned in cells:
        ran(tmp_path, planned, 0.001, task="ablation", metrics=measured | {"forward_seconds": 0.02})
    table(tmp_path)
    header = (tmp_path / "sweeps" / "completion-1" / "table.md").read_text()
    titles = ("wrong pixels", "missed pixels", "spurious pixels", "median depth error (x1000)", "rendering (ms)")
    assert all(title in header for title in titles) and "queries |" not in header


@pytest.mark.parametrize(("errors", "answer"), [
    ({"dist": [1.0, 2.0], "dvr": [3.0, 3.0]}, "With fewer than six shapes, the order is not certain."),
    ({"dist": [1.0, 2.0, 9.0], "dvr": [3.0]}, "The rows have different shapes, so their medians do not compare."),
    ({"dist": [1, 2, 3, 4, 5, 6], "dvr": [1, 2, 3, 4, 5, 7]}, "The interval of DIST overlaps with those of DVR."),
    ({"dist": [1.0, 1.1, 1.2, 1.3, 1.4, 1.5], "dvr": [9.0] * 6}, "n = 6 shapes."),
    ({"dist": [None, None], "dvr": [None, None]}, ""),
])  # fmt: skip
def test_the_answer_of_a_sweep_says_whether_its_order_is_certain(tmp_path, errors, answer):
    cells = [(cell(name, index=i), error) for name, values in errors.items() for i, error in enumerate(values)]
    swept(tmp_path, [planned for planned, _ in cells])
    for planned, error in cells:
        ran(tmp_path, planned, error)
    sweep = of_plan(read_plans(tmp_path)[0][0], {r["folder"]: r for r in read_records(tmp_path)[0]})
    verdict = table_of(sweep).verdict
    assert verdict.endswith(answer) and bool(verdict) == bool(answer)


def test_a_row_of_which_every_run_failed_is_in_the_table_and_the_chart(tmp_path):
    cells = [cell("dist"), cell("dvr")]
    swept(tmp_path, cells)
    ran(tmp_path, cells[0], 0.001)
    ran(tmp_path, cells[1], 0.002, status="nan", reason="as planned")
    assert list(table(tmp_path)["failed"]) == [0, 1]
    assert (tmp_path / "sweeps" / "completion-1" / "table.png").is_file()


def test_a_data_set_on_which_a_row_only_failed_has_a_column_all_the_same(tmp_path):
    cells = [cell(renderer, dataset=dataset) for renderer in ("dist", "dvr") for dataset in ("sofa", "plane")]
    swept(tmp_path, cells)
    for one, chamfer in zip(cells, (0.001, 0.002, 0.003, None), strict=True):
        ran(tmp_path, one, chamfer)
    assert table(tmp_path)["chamfer_l2, plane"].isna().tolist() == [False, True]
    verdict = find_sweeps(tmp_path)[0].shown.verdict
    assert verdict.startswith("Median Chamfer (x1000): *1.50* (DIST) to ∞ (DVR)") and "Best by" not in verdict


def test_a_sweep_that_has_ended_has_its_table_at_once(tmp_path):
    cells = [cell(r, seed=s) for r in ("dist", "dvr") for s in (0, 1)]
    swept(tmp_path, [cell("dist", seed=9)], "completion-0")
    plan = Plan("completion-1", tmp_path, cells)
    plan.write()
    for one in cells[:3]:  # the last was not run
        ran(tmp_path, one, 0.001)
    problems: list[str] = []
    assert write_sweep(plan, read_records(tmp_path)[0], problems) == [
        tmp_path / "sweeps" / "completion-1" / "table.csv"
    ]
    at_once = (tmp_path / "sweeps" / "completion-1" / "table.csv").read_text()
    assert list(table(tmp_path)["failed"]) == [0, 0] and list(table(tmp_path)["runs"]) == [2, 1]
    assert at_once == (tmp_path / "sweeps" / "completion-1" / "table.csv").read_text()  # as the report makes it
    experiment = [replace(one, config=one.config | {"experiment": "table2"}) for one in cells]
    table2 = Plan("table2-1", tmp_path, experiment)
    assert write_sweep(table2, read_records(tmp_path)[0], problems) == problems == []  # a page without runs


def test_a_metric_with_the_name_of_a_cost_has_its_median(tmp_path):
    cells = [cell(renderer) for renderer in ("dist", "dvr")]
    swept(tmp_path, cells)
    for each in cells:
        ran(tmp_path, each, 0.001, metrics={"cost": 7.0}, evaluations={"cost": 9})
    rows = table(tmp_path)
    assert list(rows["cost"]) == [7, 7] and list(rows["evaluations_cost"]) == [9, 9]


def test_six_shapes_have_an_interval(tmp_path):
    cells = [cell(r, index=i) for r in ("dist", "dvr", "idr") for i in range(6)]
    swept(tmp_path, cells)
    for number, one in enumerate(cells):
        failed = one.renderer == "idr" and number % 3 == 0
        ran(tmp_path, one, None if failed else 0.001 * (1 + number % 6) * (2 if one.renderer == "dvr" else 1))
    found = table(tmp_path)
    assert found.loc["IDR", "failed"] == 2
    assert 0 < found.loc["IDR", "failed_low"] < 0.1 and 0.7 < found.loc["IDR", "failed_high"] < 0.9
    found = found.loc[["DIST", "DVR"]]
    assert (found["chamfer_l2_low"] < found["chamfer_l2"]).all() and (found["fscore_high"] > found["fscore"]).all()
    assert found.loc["DVR", ["ratio", "ratio_low", "ratio_high"]].tolist() == pytest.approx([2, 2, 2])  # paired
    text = (tmp_path / "sweeps" / "completion-1" / "table.md").read_text()
    assert "95 % bootstrap intervals over shapes" in text


def test_cells_that_failed_count_in_their_rows_and_those_that_were_not_run_do_not(tmp_path):
    cells = [cell(r, seed=s) for r in ("dist", "dvr") for s in (0, 1, 2)]
    swept(tmp_path, cells)
    for one, chamfer in zip(cells[:5], (0.001, 0.002, 0.003, 0.002, None), strict=True):
        ran(tmp_path, one, chamfer)
    found = table(tmp_path)
    assert list(found["failed"]) == [0, 1] and list(found["runs"]) == [3, 2]
    assert "Left out: 1 that were not run" in (tmp_path / "sweeps" / "completion-1" / "table.md").read_text()
    assert math.isinf(found.loc["DVR", "chamfer_l2"]) and found.loc["DVR", "fscore"] == pytest.approx(0.499)
    assert found.loc["DVR", "steps_taken"] == 9  # neither direction is better
    assert found.loc["DVR", "reasons"] == "crashed: as planned" and math.isnan(found.loc["DVR", "ratio"])


def test_settings_and_classes_are_told_apart(tmp_path):
    swept(tmp_path, [cell("dist", epsilon=e) for e in ("1e-4", "1e-3")], "epsilons")
    classes = [f"bad.{letter}" for letter in "ABCDEFGHIJKL"]
    swept(tmp_path, [cell("custom", _target_=path) for path in classes], "classes")
    assert list(table(tmp_path, "epsilons").index) == ["epsilon 1e-4", "epsilon 1e-3"]
    assert len(set(table(tmp_path, "classes").index)) == 12
    assert list(table(tmp_path, "classes")["failed"]) == [1] * 12  # not one was run


def test_a_stress_is_a_row_and_no_shape(tmp_path):
    cells = [cell("dist", dataset=stress) for stress in ("wires", "gap")]
    for one in cells:
        one.config["stress"] = {"scene": one.dataset}
    swept(tmp_path, cells)
    for one in cells:
        ran(tmp_path, one, 0.001)
    assert list(table(tmp_path).index) == ["wires", "gap"]
    assert "n = 2 runs;" in (tmp_path / "sweeps" / "completion-1" / "table.md").read_text()


def test_a_sweep_of_an_experiment_with_a_page_needs_no_table(tmp_path):
    for experiment in ("table2", "of_mine"):
        cells = [cell("dist", seed=s) for s in (0, 1)]
        for one in cells:
            one.config["experiment"] = experiment
        swept(tmp_path, cells, experiment)
    write_sweeps(read_records(tmp_path)[0], tmp_path, [])
    assert [found.name for found in find_sweeps(tmp_path)] == ["of_mine"]


def test_the_report_writes_the_table_and_it_is_read_back(tmp_path, capsys):
    cells = [cell(r) for r in ("dist", "dvr")]
    swept(tmp_path, cells)
    for one in cells:
        ran(tmp_path, one, 0.001)
    report([f"results_dir={tmp_path}"])
    folder = tmp_path / "sweeps" / "completion-1"
    assert str(folder / "table.csv") in capsys.readouterr().out
    assert not (tmp_path / "paper").exists()
    (found,) = find_sweeps(tmp_path)
    assert (found.name, found.shown.title) == ("completion-1", "Sweep over renderer, completion-1.")
    assert found.shown.columns[:2] == ["Row", "Chamfer (x1000) ↓"] and found.shown.rows[0][:2] == ["DIST", "1.00"]
    assert found.files == {
        suffix.upper(): f"sweeps/completion-1/table.{suffix}" for suffix in ("csv", "md", "pdf", "tex")
    }
    within = re.search(r"WITHIN = /(.*)/;", (ASSETS / "base" / "dom.js").read_text())
    assert within and all(re.fullmatch(within[1], link) for link in found.files.values())  # the page links to them
    assert r"\label{tab:completion-1}" in (folder / "table.tex").read_text()
    assert "swept over renderer (dist, dvr)." in found.shown.caption and "All 2 runs ended ok." in found.shown.caption


def test_a_cell_whose_record_is_damaged_is_missing(tmp_path):
    cells = [cell("dist", seed=s) for s in (0, 1)]
    swept(tmp_path, cells)
    ran(tmp_path, cells[0], 0.001)
    write_run(tmp_path, "{", cells[1].id)
    (plan,), known = read_plans(tmp_path)[0], {one["folder"]: one for one in read_records(tmp_path)[0]}
    sweep = of_plan(plan, known)
    assert sweep.missing == 1 and [(row["row"], row["runs"], row["failed"]) for row in lines(sweep)] == [("DIST", 1, 0)]


def test_a_sweep_with_an_odd_record_costs_no_other_table(tmp_path, capsys):
    for seed, name in enumerate(("odd", "sound")):
        swept(tmp_path, [cell("dist", seed=seed)], name)
        ran(tmp_path, cell("dist", seed=seed), 0.001, **({"environment": {"cpu": [1]}} if name == "odd" else {}))
    assert report([f"results_dir={tmp_path}"]) == 1 and [found.name for found in find_sweeps(tmp_path)] == ["sound"]
    told = capsys.readouterr()
    assert "not made: sweeps/odd (TypeError: " in told.err and told.out.endswith("index.html\n")


def test_a_row_has_medians_not_means_of_its_ended_runs(tmp_path):
    cells = [cell("dist", seed=s) for s in range(5)]
    swept(tmp_path, cells)
    for one, chamfer, seconds in zip(cells, (0.001, 0.002, 0.003, 0.020, None), (1, 2, 3, 20, 500), strict=True):
        spent = {"forward": seconds, "backward": 0.0, "total": 10 * seconds}
        ran(tmp_path, one, chamfer, seconds=spent, evaluations={"value": 1000 * seconds})
    found = table(tmp_path).loc["DIST"]
    assert found["chamfer_l2"] == pytest.approx(0.003)  # of five, one of them infinite
    assert (found["loop_seconds"], found["value_evaluations"]) == (2.5, 2500)  # of the four that ended ok


def test_two_sweeps_have_their_own_runs_in_the_order_of_their_plans(tmp_path):
    shared = cell("newton")
    for name, renderer, chamfer in (("first", "dvr", 0.002), ("second", "dist", 0.004)):
        one = cell(renderer)
        swept(tmp_path, [shared, one], name)
        ran(tmp_path, one, chamfer)
    ran(tmp_path, shared, 0.001)
    assert list(table(tmp_path, "first")["chamfer_l2"].items()) == [("NEWTON", 0.001), ("DVR", 0.002)]
    found = table(tmp_path, "second")
    assert list(found["chamfer_l2"].items()) == [("NEWTON", 0.001), ("DIST", 0.004)]
    named = [name for name in found if name in ("chamfer_l2", "fscore", "steps_taken")]
    assert named == ["chamfer_l2", "fscore", "steps_taken"]  # the first one has the ratio
    assert found.loc["DIST", "ratio"] == pytest.approx(4)


def test_a_swept_number_has_a_curve_and_no_front_and_failed_runs_cost_nothing(tmp_path):
    cells = [cell(r, index=i, steps=steps) for r in ("dist", "dvr") for steps in ("0", "9") for i in (0, 1, 2)]
    swept(tmp_path, cells)
    for number, planned in enumerate(cells):
        evaluations = {"value": 1, "gradient": 0, "per_ray": 1.0, "cost": 5.0 if number % 3 else 0.1}
        ran(tmp_path, planned, 0.001 * (1 + number) if number % 3 else None, evaluations=evaluations)
    table(tmp_path)
    panels = {panel["x"]["title"]: panel for panel in find_sweeps(tmp_path)[0].shown.chart["panels"]}
    curves = {each["name"]: each for each in panels["renderer.steps"]["series"]}
    assert [*curves][1:] == ["DIST", "DVR"] and curves["DVR"]["x"] == [0, 9]  # no front over the axis itself
    costs = {each["name"]: each for each in panels[COST]["series"]}
    assert costs["DIST"]["x"] == [5, 5] and "front" in costs


def test_settings_of_the_task_pose_other_problems_and_have_no_front(tmp_path):
    cells = [
        replace(planned, overrides=[*planned.overrides, f"task.points={points}"], id=f"{planned.id}-{points}")
        for planned in (cell("dist"), cell("dvr"))
        for points in (20, 50)
    ]
    cells = [replace(each, config=each.config | {"task": {"points": each.id[-2:]}}) for each in cells]
    swept(tmp_path, cells)
    for planned in cells:
        ran(tmp_path, planned, 0.001)
    table(tmp_path)
    panels = find_sweeps(tmp_path)[0].shown.chart["panels"]
    assert panels[0]["x"]["title"] == "task.points"
    assert all(each["name"] != "front" for panel in panels for each in panel["series"])
