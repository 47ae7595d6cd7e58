"""Finished runs are exported as they are; a tracker that fails, or is not installed, costs no run."""

import json
import re
import sys
from pathlib import Path

import pytest

from bench.records.record import read_record
from bench.trackers import MLflow, TensorBoard, curve, settings, values
from datasets.extras import install
from tests.run.driving import FAILING, record_of


@pytest.fixture
def finished(tmp_path) -> Path:
    """The folder of a run that ended with numbers, and with a curve of three lines, one of them not a number."""
    folder = tmp_path / "runs" / "completion-dist-sofa-1"
    folder.mkdir(parents=True)
    record = {
        "schema": 1, "id": folder.name, "task": "completion", "renderer": "dist", "dataset": "sofa", "seed": 3,
        "status": "ok", "reason": "", "started": "2026-01-01T00:00:00+00:00", "reused": False, "notes": [],
        "config": {"seed": 3, "renderer": {"steps": 50, "cap": None}}, "metrics": {"chamfer_l2": 0.002, "psnr": "inf"},
        "metrics_start": {"chamfer_l2": 0.01}, "definitions": {}, "evaluations": {"value": 1000}, "environment": {},
        "seconds": {"total": 12.5}, "peak_memory_bytes": None, "flops": 10, "gemm_fraction": 0.5,
    }  # fmt: skip
    (folder / "record.json").write_text(json.dumps(record))
    (folder / "summary.png").write_bytes(b"a picture")
    lines = [{"iteration": 0, "seconds": 0.1, "total": 3.0}, {"iteration": 1, "seconds": 0.2, "total": "nan"}]
    (folder / "curve.jsonl").write_text("\n".join(map(json.dumps, [*lines, {"iteration": 2, "total": 1.0}])))
    return folder


def test_content_is_what_the_run_folder_says(finished):
    record = read_record(finished)
    assert settings(record["config"]) == {"seed": "3", "renderer.steps": "50", "renderer.cap": "None"}
    assert values(record) == {
        "metrics.chamfer_l2": 0.002, "metrics_start.chamfer_l2": 0.01, "evaluations.value": 1000.0,
        "seconds.total": 12.5, "flops": 10.0, "gemm_fraction": 0.5,
    }  # fmt: skip
    assert curve(finished) == [(0, {"seconds": 0.1, "total": 3.0}), (1, {"seconds": 0.2}), (2, {"total": 1.0})]


def test_a_run_without_a_curve_has_none(tmp_path):
    assert curve(tmp_path) == []


@pytest.mark.filterwarnings("ignore")  # of MLflow's own libraries
def test_mlflow_has_the_run(finished, tmp_path):
    mlflow = pytest.importorskip("mlflow", reason="MLflow is not installed: pip install -e '.[mlflow]'")
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    MLflow(uri, "ours", str(tmp_path / "pictures")).export(finished, read_record(finished))
    client = mlflow.MlflowClient(tracking_uri=uri)
    (run,) = client.search_runs([client.get_experiment_by_name("ours").experiment_id])
    assert run.info.run_name == finished.name
    assert run.info.status == "FINISHED"
    assert run.info.end_time - run.info.start_time == 12_500
    assert run.data.tags["status"] == "ok"
    assert run.data.params["renderer.steps"] == "50"
    assert run.data.metrics["metrics.chamfer_l2"] == 0.002
    assert [item.path for item in client.list_artifacts(run.info.run_id)] == ["summary.png"]
    assert list((tmp_path / "pictures").rglob("summary.png"))
    history = client.get_metric_history(run.info.run_id, "curve.total")
    assert sorted((point.step, point.value) for point in history) == [(0, 3.0), (2, 1.0)]


@pytest.mark.filterwarnings("ignore")  # of TensorBoard's own libraries
def test_tensorboard_has_the_run(finished, tmp_path):
    pytest.importorskip("tensorboard", reason="TensorBoard is not installed: pip install -e '.[tensorboard]'")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    TensorBoard(str(tmp_path / "tb")).export(finished, read_record(finished))
    events = EventAccumulator(str(tmp_path / "tb" / finished.name)).Reload()
    assert [(e.step, e.value) for e in events.Scalars("curve/total")] == [(0, 3.0), (2, 1.0)]
    assert events.Scalars("metrics/chamfer_l2")[0].value == pytest.approx(0.002)


@pytest.mark.parametrize(("cls", "package"), [(MLflow, "mlflow"), (TensorBoard, "tensorboard")])
def test_a_tracker_that_is_not_installed_is_told_before_the_run(monkeypatch, cls, package):
    monkeypatch.setattr(sys.modules[cls.__module__], "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=re.escape(f": {install(package)}")):
        cls(*("sqlite:///x.db", "e", "a") if cls is MLflow else ("folder",))


def tracked(monkeypatch, export) -> tuple[str, ...]:
    """Overrides that choose a tracker whose export is replaced."""
    monkeypatch.setattr(sys.modules[TensorBoard.__module__], "find_spec", lambda name: True)
    monkeypatch.setattr(TensorBoard, "export", export)
    return ("tracker=tensorboard",)


def test_a_tracker_that_fails_is_noted_and_costs_no_run(isolated, monkeypatch):
    def fail(self, folder, record):
        raise ConnectionError("the server\nis away")

    _, out, _ = isolated(*FAILING, "+renderer.how=not", *tracked(monkeypatch, fail))
    record = record_of(out)
    assert record["notes"][-1] == "not exported to the tracker: the server is away"
    assert record["metrics"]


def test_what_is_reused_is_not_exported_again(isolated, monkeypatch):
    exported = []
    tracker = tracked(monkeypatch, lambda self, folder, record: exported.append(folder.name))
    for _ in range(2):
        isolated(*FAILING, "+renderer.how=not", *tracker)
    assert len(exported) == 1
