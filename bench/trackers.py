"""Exports finished runs to experiment trackers; never during a run, and a failed export loses no run."""

import math
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from bench.records.names import flat
from bench.records.read import curve_lines
from bench.records.record import NUMERIC, as_number, started
from datasets.extras import install_command

METRICS, PARAMETERS, LONGEST = 1000, 100, 500  # most of them in a call of MLflow; characters of a parameter's value


@runtime_checkable
class Tracker(Protocol):
    """Exports finished runs to an experiment tracker."""

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Exports the run of a folder, with its record as `bench.records.record.read_record` gives it."""
        ...


class Nothing:
    """The tracker that exports nothing."""

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Does nothing."""


@dataclass(frozen=True)
class MLflow:
    """Exports to an MLflow server, or a database; pictures go to the folder that its experiment was made with."""

    uri: str
    experiment: str
    artifacts: str

    def __post_init__(self) -> None:
        _check_installed("mlflow", f"MLflow: {install_command('mlflow')}")

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Makes a run in MLflow; its status is FINISHED where the run ended ok, else FAILED."""
        from mlflow import MlflowClient, entities  # slow to import, and needed only here

        client = MlflowClient(tracking_uri=self.uri)
        known = client.get_experiment_by_name(self.experiment)
        place = Path(self.artifacts).resolve().as_uri()
        made = known.experiment_id if known else client.create_experiment(self.experiment, artifact_location=place)
        begun = int(started(record).timestamp() * 1000)
        tags = {"mlflow.runName": record["id"], "status": record["status"], "reason": record["reason"]}
        run = client.create_run(made, start_time=begun, tags=tags).info.run_id
        now = begun + int(1000 * record["seconds"].get("total", 0.0))
        points = [entities.Metric(name, value, now, 0) for name, value in values(record).items()]
        for iteration, line in curve(folder):
            at = begun + int(1000 * line.get("seconds", 0.0))
            points += [entities.Metric(f"curve.{name}", value, at, iteration) for name, value in line.items()]
        parameters = [entities.Param(name, text[:LONGEST]) for name, text in settings(record["config"]).items()]
        for first in range(0, len(points), METRICS):
            client.log_batch(run, metrics=points[first : first + METRICS])
        for first in range(0, len(parameters), PARAMETERS):
            client.log_batch(run, params=parameters[first : first + PARAMETERS])
        for path in sorted(folder.glob("*.png")):
            client.log_artifact(run, str(path))
        client.set_terminated(run, "FINISHED" if record["status"] == "ok" else "FAILED", end_time=now)


@dataclass(frozen=True)
class TensorBoard:
    """Exports to an event file in a folder of the run's name, in `folder`."""

    folder: str

    def __post_init__(self) -> None:
        _check_installed("tensorboard", f"TensorBoard: {install_command('tensorboard')}")

    def export(self, folder: Path, record: dict[str, Any]) -> None:
        """Writes the curve, the final values and the settings of the run."""
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
    """A configuration as dotted keys and strings."""
    return {key: str(value) for key, value in flat(config).items()}


def values(record: dict[str, Any]) -> dict[str, float]:
    """All finite numbers of a record, such as `metrics.chamfer_l2`."""
    return _finite(flat({name: record[name] for name in NUMERIC}))


def curve(folder: Path) -> list[tuple[int, dict[str, float]]]:
    """The lines of `curve.jsonl` as iteration and finite numbers by name; empty where there is no curve."""
    return [(line.pop("iteration"), _finite(line)) for line in curve_lines(folder) or () if line]


def _finite(found: dict[str, Any]) -> dict[str, float]:
    numbers = {name: as_number(value) for name, value in found.items()}
    return {name: float(x) for name, x in numbers.items() if x is not None and math.isfinite(x)}
