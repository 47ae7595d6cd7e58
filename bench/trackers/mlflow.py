"""Exports runs to MLflow, with their settings, numbers, curves and pictures."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.records.record import started
from bench.trackers import curve, settings, values
from datasets.extras import install

METRICS, PARAMETERS = 1000, 100  # largest numbers that one call of log_batch takes
LONGEST = 500  # characters of a parameter's value


@dataclass(frozen=True)
class MLflow:
    """Exports to an MLflow tracking server or database.

    Args:
        uri: such as sqlite:///results/mlflow.db, or a server's address.
        experiment: name of MLflow's experiment.
        artifacts: folder for the pictures, used when the experiment is made.
    """

    uri: str
    experiment: str
    artifacts: str

    def __post_init__(self) -> None:
        if find_spec("mlflow") is None:  # checked before the run, not after it
            raise ValueError(f"tracker=mlflow needs MLflow: {install('mlflow')}")

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Makes a run in MLflow; its status is FINISHED where the run ended ok, else FAILED."""
        from mlflow import MlflowClient, entities  # slow to import, and needed only here

        client = MlflowClient(tracking_uri=self.uri)
        known = client.get_experiment_by_name(self.experiment)
        place = Path(self.artifacts).resolve().as_uri()
        experiment = (
            known.experiment_id if known else client.create_experiment(self.experiment, artifact_location=place)
        )
        begun = int(started(record).timestamp() * 1000)
        tags = {"mlflow.runName": record["id"], "status": record["status"], "reason": record["reason"]}
        run = client.create_run(experiment, start_time=begun, tags=tags).info.run_id
        now = begun + int(1000 * record["seconds"].get("total", 0.0))
        points = [entities.Metric(name, value, now, 0) for name, value in values(record).items()]
        for iteration, line in curve(folder):
            at = begun + int(1000 * line.get("seconds", 0.0))
            points += [entities.Metric(f"curve.{name}", value, at, iteration) for name, value in line.items()]
        parameters = [entities.Param(name, text[:LONGEST]) for name, text in settings(record["config"]).items()]
        for chunk in _chunks(points, METRICS):
            client.log_batch(run, metrics=chunk)
        for chunk in _chunks(parameters, PARAMETERS):
            client.log_batch(run, params=chunk)
        for path in sorted(folder.glob("*.png")):
            client.log_artifact(run, str(path))
        client.set_terminated(run, "FINISHED" if record["status"] == "ok" else "FAILED", end_time=now)


def _chunks(items: Sequence[Any], size: int) -> Iterator[Sequence[Any]]:
    for first in range(0, len(items), size):
        yield items[first : first + size]
