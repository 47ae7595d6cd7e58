"""Speed against accuracy: the runs of each setting of each renderer, aligned by shape and seed."""

import math
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from bench.report import statistics
from bench.report.experiments import Experiment, error, family, measured, row_name, setting

SEED = 0  # of the bootstrap
TARGET = 1e-3  # Chamfer distance (squared scene units) whose time is asked for
SCALE = 1000.0
LEAST = 1e-9  # an error below this cannot be told from none, and its logarithm would be without bounds


@dataclass(frozen=True)
class Trial:
    """A task of which the chart is made: what it calls error, cost and evaluations."""

    task: str
    title: str
    error: str
    heading: str


TRIALS = (
    Trial("completion", "completing a shape", "chamfer_l2", "Chamfer × 1000 (scene units²)"),
    Trial("ablation", "rendering an image", "error_p95", "depth error, 95th percentile × 1000 (scene units)"),
)


@dataclass(frozen=True, eq=False)
class Setting:
    """All runs of one setting in one trial, aligned with those of the others: a group of seeds for each shape."""

    name: str
    renderer: str
    trial: Trial
    records: list[dict[str, Any]]
    keys: list[Hashable]  # the shapes of all settings of the trial

    @cached_property
    def errors(self) -> list[np.ndarray]:
        """Of each shape; infinite where a run did not end ok or is missing."""
        return self._groups(lambda r: SCALE * max(error(r, self.trial.error), LEAST))

    @cached_property
    def costs(self) -> list[np.ndarray]:
        """Seconds of each shape: of the loop, or of one rendering. Infinite as the errors."""
        return self._groups(seconds)

    @cached_property
    def evaluations(self) -> list[np.ndarray]:
        """Field values asked for, of each shape; infinite as the errors."""
        return self._groups(evaluations)

    @property
    def missing(self) -> int:
        """Runs that others have and this setting lacks."""
        return len(set(self.keys) - {_run_key(record) for record in self.records})

    @property
    def failed(self) -> int:
        """Runs that did not end ok."""
        return sum(record["status"] != "ok" for record in self.records)

    @property
    def point(self) -> tuple[float, float]:
        """Median seconds and median error."""
        return tuple(float(statistics.median(np.concatenate(groups))) for groups in (self.costs, self.errors))

    def _groups(self, value: Any) -> list[np.ndarray]:
        found: dict[Hashable, float] = {}
        for record in self.records:
            number = value(record) if record["status"] == "ok" else None
            sound = number is not None and not math.isnan(number)
            found[_run_key(record)] = float(number) if sound else math.inf
        shapes = list(dict.fromkeys(shape for shape, _ in self.keys))
        return [np.array([found.get(key, math.inf) for key in self.keys if key[0] == shape]) for shape in shapes]


@dataclass(frozen=True)
class Placed:
    """A setting in the chart of error against time.

    Args:
        row: the setting.
        x, y: where it is drawn: its median seconds and error, or the edge where one is infinite.
        lost: whether one is.
        dominated: whether another setting is no worse in both and better in one.
        chance: the probability of being on the front.
    """

    row: Setting
    x: float
    y: float
    lost: bool
    dominated: bool
    chance: float

    @property
    def on_front(self) -> bool:
        """Whether no other setting beats it."""
        return not (self.lost or self.dominated)

    @property
    def label(self) -> str:
        """The setting without its renderer's name, and the probability."""
        name = self.row.name.removeprefix(f"{self.row.renderer}, ")
        return name if self.lost else f"{name} ({self.chance:.2f})"


def front_line(panel: list[Placed]) -> list[Placed]:
    """The points on the front, from the fastest to the best."""
    return sorted((point for point in panel if point.on_front), key=lambda point: point.x)


def settings(experiment: Experiment, trial: Trial) -> list[Setting]:
    """The settings of a trial, in the order in which they started.

    Renderings must be of one size to be compared: of that of most of them.
    """
    own = [record for record in experiment.records if record["task"] == trial.task]
    if trial.task == "ablation" and own:
        size = Counter(map(resolution, own)).most_common(1)[0][0]
        own = [record for record in own if resolution(record) == size]
    keys = sorted({_run_key(record) for record in own}, key=str)
    rows: dict[str, list[dict[str, Any]]] = {}
    for record in own:
        rows.setdefault(row_name(record), []).append(record)
    return [Setting(name, records[0]["renderer"], trial, records, keys) for name, records in rows.items()]


def own(rows: list[Setting]) -> list[Setting]:
    """The setting that bears each renderer's name; all of a renderer where none does."""
    names = {row.name for row in rows}
    return [row for row in rows if row.name == row.renderer or row.renderer not in names]


def resolution(record: dict[str, Any]) -> Any:
    """Pixels a side that were asked for."""
    return setting(record["config"], "view", "resolution")


def left_out(experiment: Experiment) -> str:
    """How many renderings of another size are not shown, as a sentence; empty where none is."""
    renderings = sum(record["task"] == "ablation" for record in experiment.records)
    count = renderings - sum(len(row.records) for row in settings(experiment, TRIALS[1]))
    return f"Not shown: {count} renderings of another size." if count else ""


def sizes(experiment: Experiment) -> str:
    """The sizes of the images of each trial, as a sentence."""
    told = []
    for trial in TRIALS:
        found = Counter(resolution(r) for row in settings(experiment, trial) for r in row.records)
        if found:
            listed = ", ".join(f"{size}×{size} ({count} runs)" for size, count in found.most_common())
            told.append(f"{trial.title} {listed}")
    return f"Pixels: {'; '.join(told)}."


def seconds(record: dict[str, Any]) -> float | None:
    """What a run cost: the loop of an optimisation, or one rendering without gradient."""
    if record["task"] == "ablation":
        return measured(record, "forward_seconds")
    spent = [record["seconds"].get(name) for name in ("forward", "backward")]
    return None if None in spent else sum(spent)


def evaluations(record: dict[str, Any]) -> float | None:
    """Field values that a run asked for, in the loop or in one rendering."""
    return measured(record, "queries") if record["task"] == "ablation" else record["evaluations"].get("value")


def _run_key(record: dict[str, Any]) -> tuple[Hashable, Hashable]:
    """The shape and the seed of a run."""
    return shape_of(record), record["seed"]


def shape_of(record: dict[str, Any]) -> tuple[str, Any]:
    """The shape of a run."""
    return family(record), record["config"].get("index")
