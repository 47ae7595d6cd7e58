"""Speed and accuracy: the runs of each setting of each renderer, aligned by shape and seed."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from bench.report.data import statistics
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import (
    SCALE,
    Record,
    Row,
    RunKey,
    base_renderer,
    by_shape,
    error,
    grouped,
    loop_seconds,
    measured,
    row_of,
    run_key,
    setting,
    value_evaluations,
)

SEED = 0  # of the bootstrap
TARGET = 1e-3  # Chamfer distance (squared scene units); the time to reach it is measured
LEAST = 1e-9  # smaller errors are raised to this, so that their logarithms are bounded
VARIES = ("dataset", "task", "view", "split")


@dataclass(frozen=True)
class Trial:
    """A task of the chart: its runs, its error metric, and functions that read its cost and evaluations."""

    selection: Selection
    title: str
    error: str
    heading: str
    seconds: Callable[[Record], float | None]
    evaluations: Callable[[Record], float | None]


COMPLETION = Trial(
    Selection("speed_completion", ("completion",), VARIES),
    "completing a shape",
    "chamfer_l2",
    "Chamfer × 1000 (scene units²)",
    loop_seconds,
    value_evaluations,
)


def _queries(record: Record) -> float | None:
    """The number of field values of one rendering, coarse ones included; None where the record does not have it."""
    queries = measured(record, "queries")
    return None if queries is None else queries + (measured(record, "coarse_queries") or 0)


RENDERING = Trial(
    Selection("speed_rendering", ("ablation",), VARIES),
    "rendering an image",
    "error_p95",
    "depth error, 95th percentile × 1000 (scene units)",
    lambda record: measured(record, "forward_seconds"),  # of one rendering without gradient
    _queries,
)
TRIALS = (COMPLETION, RENDERING)
MAIN = {"dvr": "dvr_early_stop"}  # presets that stand for a renderer whose own preset is not among the settings


@dataclass(frozen=True, eq=False)
class Setting:
    """All runs of one setting in one trial, aligned with those of other settings: a group of seeds per shape."""

    row: Row
    renderer: str  # the renderer of which the setting is a variant
    trial: Trial
    records: list[Record]
    keys: list[RunKey]  # of all settings of the trial
    alike: tuple[Record, ...] = ()  # the runs of all settings that compute the same as this one, including its own

    @property
    def name(self) -> str:
        """The name of its row."""
        return self.row.name

    @cached_property
    def errors(self) -> list[np.ndarray]:
        """Errors per shape; infinite where a run did not end ok or is missing."""
        return self._groups(lambda record: SCALE * max(error(record, self.trial.error), LEAST))

    @cached_property
    def costs(self) -> list[np.ndarray]:
        """Seconds per shape, of the loop or of one rendering; infinite where a run did not end ok or is missing."""
        return self._groups(self.trial.seconds)

    @cached_property
    def evaluations(self) -> list[np.ndarray]:
        """Numbers of field values per shape; infinite where a run did not end ok or is missing."""
        return self._groups(self.trial.evaluations)

    @cached_property
    def middle(self) -> statistics.Interval:
        """The interquartile mean of the errors with its interval."""
        return statistics.bootstrap(self.errors, statistics.interquartile_mean, seed=SEED)

    @property
    def missing(self) -> int:
        """The number of runs that other settings have and this one lacks."""
        return len(set(self.keys) - {run_key(record) for record in self.records})

    @property
    def failed(self) -> int:
        """The number of runs that did not end ok."""
        return sum(record["status"] != "ok" for record in self.records)

    @property
    def point(self) -> tuple[float, float]:
        """Median seconds and median error."""
        return tuple(float(statistics.median(statistics.flat(groups))) for groups in (self.costs, self.errors))

    def _groups(self, value: Callable[[Record], float | None]) -> list[np.ndarray]:
        def sound(record: Record) -> float:
            number = value(record) if record["status"] == "ok" else None
            return math.inf if number is None or math.isnan(number) else float(number)

        found = {key: [sound(record) for record in runs] for key, runs in grouped(self._pooled, run_key).items()}
        return by_shape({key: float(np.median(found.get(key, [math.inf]))) for key in self.keys})

    @property
    def _pooled(self) -> list[Record]:
        """Its runs and, where it has any, those of the settings that are alike, so that equal settings are equal."""
        return list(self.alike) or self.records


@dataclass(frozen=True)
class Placed:
    """A setting's point in the chart of error over time.

    Args:
        row: the setting.
        x, y: where it is drawn: its median seconds and error, or the edge of the chart where one is infinite.
        infinite: whether one is infinite.
        dominated: whether another setting is no worse in both and better in one.
        chance: the probability of being on the front; nan where a single run was made of each.
    """

    row: Setting
    x: float
    y: float
    infinite: bool
    dominated: bool
    chance: float

    @property
    def on_front(self) -> bool:
        """Whether both medians are finite and no other setting dominates it."""
        return not (self.infinite or self.dominated)

    @property
    def label(self) -> str:
        """The setting without its renderer's name, and the probability where there is one."""
        name, prefix = self.row.name, f"{self.row.renderer}, "
        name = name[len(prefix) :] if name.lower().startswith(prefix) else name
        return name if self.infinite or math.isnan(self.chance) else f"{name} ({self.chance:.2f})"


def front_line(panel: list[Placed]) -> list[Placed]:
    """The points on the front, from the fastest to the best."""
    return sorted((point for point in panel if point.on_front), key=lambda point: point.x)


def trials(*experiments: Experiment | None) -> list[list[Setting]]:
    """The settings of each of `TRIALS`, none where it has no experiment."""
    return [settings(experiment, trial) for experiment, trial in zip(experiments, TRIALS, strict=True)]


def settings(experiment: Experiment | None, trial: Trial) -> list[Setting]:
    """The settings of a trial, in the order in which they started.

    Only renderings of the most frequent size are compared.
    """
    if experiment is None:
        return []
    compared = _compared(experiment, trial)
    keys = sorted(set(map(run_key, compared)), key=str)
    rows = grouped(compared, row_of)
    return _with_alike([Setting(row, base_renderer(runs[0]), trial, runs, keys) for row, runs in rows.items()])


def _with_alike(rows: list[Setting]) -> list[Setting]:
    """The settings, of which those that compute the same share their runs: else noise in the times would rank them."""
    groups: list[list[Setting]] = []
    for row in rows:
        found = next((group for group in groups if _same(row, group[0])), None)
        groups.append([row]) if found is None else found.append(row)
    runs = {one.row: tuple(record for other in group for record in other.records) for group in groups for one in group}
    return [replace(row, alike=runs[row.row]) for row in rows]


def _same(one: Setting, other: Setting) -> bool:
    """Whether two settings compute the same: equal errors after equal numbers of field values on all shapes.

    They then have an equal configuration, or differ in what their trial does not use.
    """
    outcomes = [np.array([statistics.flat(row.errors), statistics.flat(row.evaluations)]) for row in (one, other)]
    return one.renderer == other.renderer and np.array_equal(*outcomes) and bool(np.isfinite(outcomes[0]).any())


def _compared(experiment: Experiment, trial: Trial) -> list[Record]:
    """The records of the most frequent size; all records where the trial is not of renderings."""
    if trial is not RENDERING:
        return experiment.records
    size = Counter(map(resolution, experiment.records)).most_common(1)[0][0]
    return [record for record in experiment.records if resolution(record) == size]


def main_settings(rows: list[Setting]) -> list[Setting]:
    """For each renderer the setting that stands for it, its own preset or that of `MAIN`; all where there is none."""
    presets = {row.row.preset for row in rows}

    def stands_for_it(row: Setting) -> bool:
        mains = {row.renderer, MAIN.get(row.renderer, row.renderer)}
        return row.row.preset in mains or not mains & presets

    return [row for row in rows if stands_for_it(row)]


def resolution(record: Record) -> int | None:
    """Pixels per side that were requested."""
    return setting(record["config"], "view", "resolution")


def left_out(experiment: Experiment | None) -> str:
    """The number of renderings of other sizes, which are not shown, as a sentence; empty where there are none."""
    count = len(experiment.records) - len(_compared(experiment, RENDERING)) if experiment is not None else 0
    return f"Not shown: {count} renderings of another size." if count else ""


def sizes(*trials: list[Setting]) -> str:
    """The sizes of the images of each trial, as a sentence."""
    each = []
    for rows in filter(None, trials):
        found = Counter(resolution(record) for row in rows for record in row.records)
        listed = ", ".join(f"{size}×{size} ({count} runs)" for size, count in found.most_common())
        each.append(f"{rows[0].trial.title} {listed}")
    return f"Pixels: {'; '.join(each)}."
