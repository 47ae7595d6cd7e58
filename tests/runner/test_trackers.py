"""Finished runs are exported unchanged; a tracker that fails, or is not installed, costs no run."""

import json
import re
from pathlib import Path

import pytest

from bench import exports
from bench.exports import MLflow, TensorBoard, curve, settings, values
from bench.records.record import read_record
from datasets.extras import install_command
from tests.runner.driving import FAILING, record_of


@pytest.fixture
def finished(tmp_path) -> Path:
    """The folder of a run with metrics, and with a curve of three lines, one of them with a nan."""
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


def test_exported_values_are_the_values_of_the_run_folder(finished):
    record = read_record(finished)
    assert settings(record["config"]) == {"seed": "3", "renderer.steps": "50", "renderer.cap": "None"}
    assert values(record) == {
        "metrics.chamfer_l2": 0.002, "metrics_start.chamfer_l2": 0.01, "evaluations.value": 1000.0,
        "seconds.total": 12.5, "flops": 10.0, "gemm_fraction": 0.5,
    }  # fmt: skip
    assert curve(finished / "none") == []
    assert curve(finished) == [(0, {"seconds": 0.1, "total": 3.0}), (1, {"seconds": 0.2}), (2, {"total": 1.0})]


@pytest.mark.filterwarnings("ignore")  # from MLflow's libraries
def test_mlflow_has_the_run(finished, tmp_path):
    mlflow = pytest.importorskip("mlflow", reason="MLflow is not installed: pip install -e '.[mlflow]'")
    uri = f"sqlite:///{tmp_path / 'mlflow.db'}"
    MLflow(uri, "ours", str(tmp_path / "pictures")).export(finished, read_record(finished))
    client = mlflow.MlflowClient(tracking_uri=uri)
    (run,) = client.search_runs([client.get_experiment_by_name("ours").experiment_id])
    assert (run.info.run_name, run.info.status) == (finished.name, "FINISHED")
    assert run.info.end_time - run.info.start_time == 12_500
    assert (run.data.tags["status"], run.data.params["renderer.steps"]) == ("ok", "50")
    assert run.data.metrics["metrics.chamfer_l2"] == 0.002
    assert [item.path for item in client.list_artifacts(run.info.run_id)] == ["summary.png"]
    assert list((tmp_path / "pictures").rglob("summary.png"))
    history = client.get_metric_history(run.info.run_id, "curve.total")
    assert sorted((point.step, point.value) for point in history) == [(0, 3.0), (2, 1.0)]


@pytest.mark.filterwarnings("ignore")  # from TensorBoard's libraries
def test_tensorboard_has_the_run(finished, tmp_path):
    pytest.importorskip("tensorboard", reason="TensorBoard is not installed: pip install -e '.[tensorboard]'")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    TensorBoard(str(tmp_path / "tb")).export(finished, read_record(finished))
    events = EventAccumulator(str(tmp_path / "tb" / finished.name)).Reload()
    assert [(e.step, e.value) for e in events.Scalars("curve/total")] == [(0, 3.0), (2, 1.0)]
    assert events.Scalars("metrics/chamfer_l2")[0].value == pytest.approx(0.002)


def test_a_tracker_that_is_not_installed_is_an_error_before_the_run(monkeypatch):
    monkeypatch.setattr(exports, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=re.escape(f": {install_command('mlflow')}")):
        MLflow("sqlite:///x.db", "e", "a")


def test_a_tracker_that_fails_is_noted_and_costs_no_run_and_a_reused_run_is_not_exported_again(isolated, monkeypatch):
    exported = []

    def fail(self, folder, record):
        exported.append(folder)
        raise ConnectionError("the server\nis away")

    monkeypatch.setattr(exports, "find_spec", lambda name: True)
    monkeypatch.setattr(TensorBoard, "export", fail)
    for _ in range(2):
        _, out, _ = isolated(*FAILING, "+renderer.how=not", "isolation=off", "tracker=tensorboard")
        record = record_of(out)
        assert record["notes"][-1] == "not exported to the tracker: the server is away"
        assert record["metrics"] and len(exported) == 1
