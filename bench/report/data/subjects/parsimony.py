"""The runs of the parsimony experiment, one per scene, with their candidates and the savings of `field=auto`."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePath
from typing import Any

from bench.pictures.size_chart import AXES, Candidates
from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import SCALE, Record, family, grouped, index, measured, row_of, setting

PARSIMONY = Selection("parsimony", ("capacity",), ("dataset",), setup=("scenes", "pixels", "machine"))
NETWORK = "network_8x512"  # the papers' network: that of DeepSDF and DIST, without a code
COSTS = ("seconds", "flops", "evaluations")
REACHED, NOT_REACHED, FAILED, NOT_FITTED = "reached", "not reached", "failed", "not fitted"
SETTINGS = {  # settings that captions name
    "fitted": ("models", "views", "fitted"),
    "held_out": ("models", "views", "held_out"),
    "share": ("models", "views", "share"),
    "seeds": ("task", "checks", "seeds"),
    "drawn": ("task", "checks", "drawn"),
    "iterations": ("models", "fit", "iterations"),
}
NAMING: tuple[tuple[Callable[[Record], Any], str], ...] = (  # parts of a scene's name, where scenes differ in them
    (lambda record: row_of(record).name, "{}"),
    (index, "shape {}"),
    (lambda record: record["seed"], "seed {}"),
)


SIZES = ("stored", "free", "bytes")


@dataclass(frozen=True)
class SceneRun:
    """A run under the name of its scene; it has no candidates and no numbers where it did not end ok."""

    name: str
    record: Record
    candidates: Candidates

    @property
    def ok(self) -> bool:
        """Whether it ended ok and has a recommended and a best candidate."""
        return self.record["status"] == "ok" and None not in (self.candidates.chosen, self.candidates.best)

    @property
    def status(self) -> str:
        """The outcome for readers."""
        return self.record["status"].replace("_", " ") if self.record["status"] != "ok" else "no field recommended"

    def number(self, name: str) -> int | float | None:
        """The value of a metric; None where there is no such number, or the run did not end ok."""
        return measured(self.record, name) if self.ok else None

    def get(self, name: str) -> int | float | str | None:
        """One of `ratios`, or the value of a metric; None where there is none, or the run did not end ok."""
        if name in self.ratios:
            return self.ratios[name]
        value = self.record["metrics"].get(name) if self.ok else None
        return value if isinstance(value, str) else self.number(name)

    def failure(self, name: str) -> str:
        """The status of a failed fit; empty for others."""
        return (self.get(f"{name}.failed") or "").partition(":")[0]

    @property
    def state(self) -> str:
        """Whether the papers' network reached the error of field=auto; empty where there is no such error."""
        network = self.candidates.result(NETWORK)
        if self.number("auto.error") is None:
            return ""
        if network is None:
            return NOT_FITTED
        if network.numbers.get("seconds_at_auto") is not None:
            return REACHED
        return FAILED if network.error is None else NOT_REACHED

    @cached_property
    def network(self) -> dict[str, float | None]:
        """The network's costs until it reached that error, or of its whole fit where it did not."""
        end = "_at_auto" if self.state == REACHED else ""
        fitted = self.state not in ("", NOT_FITTED)
        return {cost: self.number(f"{NETWORK}.{cost}{end}") if fitted else None for cost in COSTS}

    @cached_property
    def ratios(self) -> dict[str, float | None]:
        """The network's costs, and what field=auto and pixel precision save, by their names in the CSV.

        The ratios of costs are those of the network over those of `field=auto`, lower bounds where the error was not
        reached. Numbers of the fit at pixel precision are over those of the plain fit; None where a fit failed. The
        last is the share of evaluations that rendering held-out rays at pixel precision saves.
        """
        bound = self.network if self.state in (REACHED, NOT_REACHED) else dict.fromkeys(COSTS)
        plain = self.candidates.chosen.numbers if self.number("frugal.error") is not None else {}
        frugal = ("evaluations", "seconds", "error")
        share = over(self.number("precision.evaluations_auto"), self.number("precision.evaluations"))
        return {
            **{f"network.{cost}": self.network[cost] for cost in COSTS},
            **{f"ratio.{cost}": over(bound[cost], self.number(f"auto.{cost}")) for cost in COSTS},
            **{f"frugal_over_plain.{name}": over(self.number(f"frugal.{name}"), plain.get(name)) for name in frugal},
            "precision.saved": None if share is None else 1 - share,
        }

    @property
    def errors(self) -> tuple[float | None, float | None]:
        """The errors of the recommended candidate's plain fit and its fit at pixel precision, in half pixels."""
        errors = (self.number(name) for name in ("recommended_error", "frugal.error"))
        return tuple(None if error is None else error / self.candidates.footprint for error in errors)


def scene_runs(experiment: Experiment) -> list[SceneRun]:
    """All runs, sorted by the size of the recommended candidate, then by name; those that did not end ok come last.

    A mesh has the name of its file, unless two scenes would have the same name.
    """
    families = {family(record) for record in experiment.records}
    stems = {name: PurePath(name).stem for name in families}
    short = stems if len(set(stems.values())) == len(families) else {name: name for name in families}
    naming = [(part, words) for part, words in NAMING if len({part(record) for record in experiment.records}) > 1]
    runs = []
    for record in experiment.records:
        name = ", ".join([short[family(record)], *(words.format(part(record)) for part, words in naming)])
        runs.append(SceneRun(name, record, Candidates.of(record["metrics"] if record["status"] == "ok" else {})))
    size = f"recommended_{measure_of(runs)}"
    return sorted(runs, key=lambda run: (not run.ok, run.number(size) or 0, run.name))


def measure_of(runs: list[SceneRun]) -> str:
    """The measure of size by which the runs chose; where they differ, "stored", which all of them have."""
    measures = {run.candidates.measure for run in runs if run.ok}
    return measures.pop() if len(measures) == 1 else "stored"


def measure_note(runs: list[SceneRun]) -> str:
    """By which measure of size the choices are made."""
    scenes = grouped((run for run in runs if run.ok), lambda run: run.candidates.measure)
    if len(scenes) < 2:
        return f"The size of a field is its {AXES[measure_of(runs)]}."
    parts = (f"{AXES[measure]} for {', '.join(run.name for run in some)}" for measure, some in scenes.items())
    return f"The size by which the choice is made is not the same for all scenes: {'; '.join(parts)}."


def named_settings(experiment: Experiment) -> dict[str, float]:
    """The settings that captions name; nan where the configuration lacks one."""
    requested = experiment.requested()
    found = {name: setting(requested, *path) for name, path in SETTINGS.items()}
    known = {name: math.nan if value is None else value for name, value in found.items()}
    return {**known, "percent": 100 * known["share"]}


def failures(runs: list[SceneRun], fits: Callable[[SceneRun], dict[str, str | None]]) -> list[str]:
    """A line for each failed fit: the scene, the fit and the reason.

    Args:
        runs: all runs.
        fits: gives the reasons of failure of a run's fits, by their names; None or empty for a fit that succeeded.
    """
    return [f"{run.name}, {fit}: {reason}" for run in runs for fit, reason in fits(run).items() if reason]


def spread(value: float | None, error: float | None) -> str:
    """A mean with its standard error, times 1000."""
    mean = format.number(value, SCALE)
    return mean if value is None or error is None else f"{mean} ± {format.number(error, SCALE)}"


def factor(x: float | None, *, above: bool = False) -> str:
    """A ratio as text, such as 0.43× or 184k×; > 45× where `above` says that it is a lower bound."""
    if x is None or math.isnan(x):
        return format.MISSING
    return f"{'> ' if above else ''}{format.count(x) if abs(x) >= 1000 else format.number(x)}×"


def over(first: float | None, second: float | None) -> float | None:
    """The ratio of the two; None where one is missing, or the second is 0."""
    return None if first is None or not second else first / second
