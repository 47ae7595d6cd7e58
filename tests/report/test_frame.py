"""The table of all runs has typed columns, whatever the runs are."""

import sys

import pandas as pd
import pytest

import bench
from bench.records import read as read_module
from bench.records.results import Plan, PlannedRun
from bench.report.__main__ import main as report
from bench.report.data.frame import FIXED_COLUMNS, to_frame
from tests.report.test_report import crashed, record, write_run


@pytest.fixture
def results(tmp_path):
    """Three runs: an ok one, one that crashed, one that a sweep planned."""
    config = {"renderer": {"epsilon": "auto", "steps": 5}, "seed": 1, "index": 3, "packages": ["mine"]}
    metrics = {"chamfer_l2": 0.001, "depth_mae": "inf", "psnr": "nan", "status": 4, "best": "grid_8"}
    write_run(tmp_path, record("one", metrics=metrics, config=config, seed=1, started="2025-03-02T10:00:00Z"), "one")
    other = {"renderer": {"epsilon": 1e-3, "steps": 7, "early": True}, "label": "Mine"}
    write_run(tmp_path, crashed("two", config=other, seed=None, reason="why"), "two")
    cell = PlannedRun("three", [], "completion", "dvr", "plane", 0, {"seed": 0, "index": 0})
    Plan("planned", tmp_path, [cell], asked="2025-03-03T10:00:00Z").write()
    return tmp_path


def test_there_is_a_row_for_each_run_and_each_planned_cell(results):
    runs = bench.load(results, config=True)
    assert list(runs.folder) == ["three", "one", "two"]
    assert list(runs.status) == ["not_run", "ok", "crashed"]
    assert list(runs.name) == ["dvr", "dist", "Mine"]
    assert runs.chamfer_l2.tolist()[1] == 0.001 and runs.chamfer_l2.isna().tolist() == [True, False, True]
    assert runs.start_chamfer_l2[1] == 0.0456 and runs.seconds_forward[1] == 10 and runs.evaluations_value[1] == 1.43e6
    assert runs["metric_status"].tolist()[1] == 4 and runs.best[1] == "grid_8"
    assert runs.depth_mae[1] == float("inf") and pd.isna(runs.psnr[1])
    assert runs.sweep.isna().tolist() == [False, True, True] and runs.sweep[0] == "planned"
    assert runs.reason[2] == "why" and runs["config.renderer.steps"].tolist()[1:] == [5, 7]


def test_columns_have_types_that_do_not_depend_on_the_runs(results, tmp_path_factory):
    runs, none = bench.load(results, config=True), bench.load(tmp_path_factory.mktemp("none"))
    plain = bench.load(results_dir=results)
    assert list(plain) == [name for name in runs if not name.startswith("config.")]
    assert {name: str(kind) for name, kind in none.dtypes.items()} == FIXED_COLUMNS
    assert {name: str(kind) for name, kind in runs.dtypes.items()} | FIXED_COLUMNS == dict(runs.dtypes.map(str))
    typed = {"chamfer_l2": "Float64", "start_fscore": "Float64", "seconds_total": "Float64", "best": "string"}
    typed |= {"config.renderer.steps": "Int64", "config.renderer.early": "boolean", "config.packages": "string"}
    typed |= {"config.renderer.epsilon": "string", "config.seed": "Int64", "metric_status": "Float64"}
    assert {name: str(runs[name].dtype) for name in typed} == typed


def test_the_table_can_be_written_for_a_spreadsheet(results):
    runs = bench.load(results, config=True)
    runs.to_csv(results / "all_runs.csv", index=False)
    table = pd.read_csv(results / "all_runs.csv")
    assert list(table) == list(runs) and list(table.folder) == list(runs.folder)
    assert table.depth_mae[1] == float("inf") and list(table["config.renderer.epsilon"])[1:] == ["auto", "0.001"]


def test_each_record_is_read_once_and_equal_settings_are_one_object(results, monkeypatch):
    for name in ("four", "five"):
        write_run(results, record(name), name)
    read, before = [], read_module.read_run
    monkeypatch.setattr(read_module, "read_run", lambda *of: (read.append(of[0].name), before(*of))[1])
    report([f"results_dir={results}"])
    assert sorted(read) == ["five", "four", "one", "two"]
    known = {run["folder"]: run for run in read_module.read_records(results)[0]}
    assert known["four"]["config"]["task"] is known["five"]["config"]["task"]


@pytest.mark.parametrize("odd", [{"threads": "auto"}, {"threads": 1.5}, {"threads": 10**400}, {"dirty": "yes"}])
def test_a_record_from_elsewhere_with_an_odd_value_leaves_the_table_whole(results, odd):
    environment = record("odd")["environment"] | odd
    write_run(results, record("odd", environment=environment, started="2025-03-04T10:00:00Z"), "odd")
    runs = bench.load(results)
    (name, value), *_ = odd.items()
    assert len(runs) == 4 and str(runs[name].dtype) == "string" and runs[name][0] == str(value)


@pytest.mark.parametrize("odd", [{"a": 1}, 3])
def test_a_machine_whose_name_is_no_text_is_written_as_text(results, odd):
    environment = record("odd")["environment"] | {"cpu": odd}
    write_run(results, record("odd", environment=environment, started="2025-03-04T10:00:00Z"), "odd")
    assert bench.load(results).cpu[0] == str(odd)


def test_a_column_of_odd_types_is_text():
    records = [record(name, config={"label": label}) for name, label in (("one", "a\rb\nc"), ("two", 1))]
    assert to_frame(records)["config.label"].tolist() == ["a\rb\nc", "1"]


def test_no_folder_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="there is no such folder"):
        bench.load(tmp_path / "nowhere")


def test_a_record_that_cannot_be_read_is_told(results):
    write_run(results, "{", "damaged")
    with pytest.warns(UserWarning, match=r"1 not read: damaged: record\.json is not JSON"):
        assert len(bench.load(results)) == 3


def test_the_module_says_what_it_has():
    assert sys.modules["bench"].__all__ == ["compare", "load", "load_field", "plot", "run"]
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        _ = bench.lode
