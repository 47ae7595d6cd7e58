"""The runs of the parsimony experiment, a scene each: named, ordered by what the scenes need, with their ladders."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from bench.report import format
from bench.report.experiments import Experiment, family, identity, measured, row_name, setting
from bench.report.ladder import Ladder

NETWORK = "network_8x512"  # the papers': DeepSDF's, without a code
SCALE = 1000.0
SETTINGS = {  # of a configuration, that captions tell
    "fitted": ("ladder", "views", "fitted"),
    "held_out": ("ladder", "views", "held_out"),
    "share": ("ladder", "views", "share"),
    "seeds": ("task", "checks", "seeds"),
    "drawn": ("task", "checks", "drawn"),
    "iterations": ("ladder", "fit", "iterations"),
}
TELLING: tuple[tuple[Callable[[dict[str, Any]], Any], str], ...] = (  # what names a scene where scenes differ in it
    (row_name, "{}"),
    (lambda record: record["config"].get("index"), "shape {}"),
    (lambda record: record["seed"], "seed {}"),
)


@dataclass(frozen=True)
class SceneRun:
    """A run, under the name of its scene; its ladder has no rungs where it did not end ok."""

    name: str
    record: dict[str, Any]
    ladder: Ladder

    @property
    def ok(self) -> bool:
        """Whether there is a recommended rung to speak of."""
        return self.record["status"] == "ok" and self.ladder.chosen is not None

    @property
    def status(self) -> str:
        """For readers: what became of it."""
        return self.record["status"].replace("_", " ") if self.record["status"] != "ok" else "no field recommended"

    @property
    def identity(self) -> dict[str, Any]:
        """The first columns of every CSV."""
        return {"scene": self.name, **identity(self.record)}

    def number(self, name: str) -> int | float | None:
        """A metric; None where there is no such number, or the run did not end ok."""
        return measured(self.record, name) if self.ok else None

    def word(self, name: str) -> str | None:
        """A metric that is a name; None as for numbers."""
        value = self.record["metrics"].get(name)
        return value if self.ok and isinstance(value, str) else None

    def in_footprints(self, error: float | None) -> float | None:
        """An error in scene units as a multiple of half a pixel."""
        return None if error is None else error / self.ladder.footprint


def scene_runs(experiment: Experiment) -> list[SceneRun]:
    """All runs, the smallest need first, then by name; those that did not end ok come last.

    A mesh goes by the name of its file, where no two scenes would have the same.
    """
    families = {family(record) for record in experiment.records}
    stems = {name: PurePath(name).stem for name in families}
    short = stems if len(set(stems.values())) == len(families) else {name: name for name in families}
    telling = [(part, told) for part, told in TELLING if len({part(record) for record in experiment.records}) > 1]
    runs = []
    for record in experiment.records:
        name = ", ".join([short[family(record)], *(told.format(part(record)) for part, told in telling)])
        runs.append(SceneRun(name, record, Ladder.of(record["metrics"] if record["status"] == "ok" else {})))
    return sorted(runs, key=lambda run: (not run.ok, run.number("recommended_parameters") or 0, run.name))


def asked(experiment: Experiment) -> dict[str, float]:
    """The settings that captions tell; nan where the configuration lacks one."""
    found = {name: setting(experiment.asked(), *path) for name, path in SETTINGS.items()}
    known = {name: math.nan if value is None else value for name, value in found.items()}
    return {**known, "percent": 100 * known["share"]}


def spread(value: float | None, error: float | None) -> str:
    """A mean with its standard error, times 1000."""
    told = format.number(value, SCALE)
    return told if value is None or error is None else f"{told} ± {format.number(error, SCALE)}"


def factor(x: float | None, *, above: bool = False) -> str:
    """A ratio such as 0.43×, 184k×, or, where more than that is all that is known, > 45×."""
    if x is None or math.isnan(x):
        return format.MISSING
    return f"{'> ' if above else ''}{format.count(x) if abs(x) >= 1000 else format.number(x)}×"


def over(first: float | None, second: float | None) -> float | None:
    """The ratio of the two; None where one is missing, or there is nothing to divide by."""
    return None if first is None or not second else first / second
