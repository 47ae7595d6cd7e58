"""Exports of finished runs to MLflow and TensorBoard; see `bench.trackers.Tracker`."""

import math
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.records.record import NUMERIC_FIELDS, as_number, flat, started
from bench.records.results import curve_lines
from datasets.extras import install_command

MAX_METRICS_PER_CALL, MAX_PARAMETERS_PER_CALL, MAX_PARAMETER_CHARACTERS = 1000, 100, 500  # limits of MLflow


@dataclass(frozen=True)
class MLflow:
    """Exports to an MLflow server or database; pictures go to the artifact folder of the experiment."""

    uri: str
    experiment: str
    artifacts: str

    def __post_init__(self) -> None:
        _check_installed("mlflow", f"MLflow: {install_command('mlflow')}")

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        from mlflow import MlflowClient, entities  # slow to import, and needed only here

        client = MlflowClient(tracking_uri=self.uri)
        experiment = client.get_experiment_by_name(self.experiment)
        uri = Path(self.artifacts).resolve().as_uri()
        experiment_id = experiment.experiment_id if experiment else client.create_experiment(self.experiment, uri)
        start_ms = int(started(record).timestamp() * 1000)
        tags = {"mlflow.runName": record["id"], "status": record["status"], "reason": record["reason"]}
        run = client.create_run(experiment_id, start_time=start_ms, tags=tags).info.run_id
        end_ms = start_ms + int(1000 * record["seconds"].get("total", 0.0))
        points = [entities.Metric(name, value, end_ms, 0) for name, value in values(record).items()]
        for iteration, line in curve(folder):
            time_ms = start_ms + int(1000 * line.get("seconds", 0.0))
            points += [entities.Metric(f"curve.{name}", value, time_ms, iteration) for name, value in line.items()]
        texts = {name: text[:MAX_PARAMETER_CHARACTERS] for name, text in settings(record["config"]).items()}
        parameters = [entities.Param(name, text) for name, text in texts.items()]
        for index in range(0, len(points), MAX_METRICS_PER_CALL):
            client.log_batch(run, metrics=points[index : index + MAX_METRICS_PER_CALL])
        for index in range(0, len(parameters), MAX_PARAMETERS_PER_CALL):
            client.log_batch(run, params=parameters[index : index + MAX_PARAMETERS_PER_CALL])
        for path in sorted(folder.glob("*.png")):
            client.log_artifact(run, str(path))
        client.set_terminated(run, "FINISHED" if record["status"] == "ok" else "FAILED", end_time=end_ms)


@dataclass(frozen=True)
class TensorBoard:
    """Exports to an event file in a folder of the run's name, in `folder`."""

    folder: str

    def __post_init__(self) -> None:
        _check_installed("tensorboard", f"TensorBoard: {install_command('tensorboard')}")

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter  # slow to import, and needed only here

        with SummaryWriter(str(Path(self.folder) / record["id"])) as writer:
            for iteration, line in curve(folder):
                for name, value in line.items():
                    writer.add_scalar(f"curve/{name}", value, iteration)
            for name, value in values(record).items():
                writer.add_scalar(name.replace(".", "/"), value, 0)
            summary = {"status": record["status"], "reason": record["reason"], **settings(record["config"])}
            writer.add_text("settings", "\n".join(f"    {name}: {text}" for name, text in summary.items()))


def _check_installed(module: str, remedy: str) -> None:  # before the run, not after it
    if find_spec(module) is None:
        raise ValueError(f"tracker={module} needs {remedy}")


def settings(config: dict[str, Any]) -> dict[str, str]:
    return {key: str(value) for key, value in flat(config).items()}


def values(record: dict[str, Any]) -> dict[str, float]:
    """All finite numbers of a record, such as `metrics.chamfer_l2`."""
    return _finite(flat({name: record[name] for name in NUMERIC_FIELDS if name in record}))


def curve(folder: Path) -> list[tuple[int, dict[str, float]]]:
    """The lines of `curve.jsonl` as iteration and finite numbers by name; empty without a curve."""
    return [(line.pop("iteration"), _finite(line)) for line in curve_lines(folder) or () if line]


def _finite(values: dict[str, Any]) -> dict[str, float]:
    numbers = {name: as_number(value) for name, value in values.items()}
    return {name: float(x) for name, x in numbers.items() if x is not None and math.isfinite(x)}
