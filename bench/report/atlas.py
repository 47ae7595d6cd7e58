"""The runs of the stability atlas as a grid of axes and renderers, and what each cell says."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from bench.report import format
from bench.report.experiments import Experiment, measured, row_name, setting
from bench.report.statistics import wilson

GROUPS = ("geometry", "viewing", "field", "observation", "optimisation")


@dataclass(frozen=True)
class Cell:
    """A renderer on an axis."""

    record: dict[str, Any]

    @property
    def known(self) -> bool:
        """Whether its search came to an end."""
        sweep = setting(self.record["config"], "task", "stress", "sweep")
        return self.record["status"] == "ok" and self.level is not None and isinstance(sweep, dict)

    @property
    def unsupported(self) -> bool:
        """Whether the renderer lacks what the axis asks for."""
        return self.record["status"] == "unsupported"

    @property
    def level(self) -> float | None:
        """The breakdown from 0, the mild end of the sweep, to 1, the severe one; below or above where it is beyond."""
        return measured(self.record, "level")

    @property
    def shade(self) -> float:
        """The level within 0 and 1; nan where there is none."""
        return min(max(self.level, 0.0), 1.0) if self.known and self.level is not None else math.nan

    @property
    def at_once(self) -> bool:
        """Whether it breaks at the mildest severity, or before it."""
        return self.known and self.level is not None and self.level < 0

    @property
    def never(self) -> bool:
        """Whether it does not break within the sweep."""
        return self.known and self.level is not None and self.level > 1

    def severity(self, level: float) -> float:
        """The severity at a level of the sweep."""
        sweep = setting(self.record["config"], "task", "stress", "sweep")
        mild, severe = float(sweep["mild"]), float(sweep["severe"])
        if sweep["log"]:
            return mild * (severe / mild) ** level
        return mild + level * (severe - mild)

    def place(self, severity: float) -> float:
        """The level of a severity."""
        ends = self.severity(0.0), self.severity(1.0)
        if setting(self.record["config"], "task", "stress", "sweep", "log"):
            return math.log(severity / ends[0]) / math.log(ends[1] / ends[0])
        return (severity - ends[0]) / (ends[1] - ends[0])

    def covers(self, severity: float) -> bool:
        """Whether a severity lies in the breakdown's interval, or as the breakdown beyond an end of the sweep."""
        low, high = (measured(self.record, f"level_{end}") for end in ("low", "high"))
        if low is None or high is None:
            return False
        level = self.place(severity)
        return low <= level <= high or (self.at_once and level < 0) or (self.never and level > 1)

    @property
    def falls(self) -> bool:
        """Whether no larger share of the trials succeeded at the severe end than at the mild one."""
        shares = []
        for end in ("mild", "severe"):
            n = measured(self.record, f"{end}_trials") or 0
            shares.append((measured(self.record, f"{end}_successes") or 0) / n if n else 0.0)
        return shares[1] <= shares[0]

    def short(self) -> str:
        """The breakdown in a few characters."""
        if not self.known:
            return format.MISSING if self.unsupported else self.record["status"]
        if not self.falls:
            return "rises"
        if self.at_once or self.never:
            return "at once" if self.at_once else "none"
        return format.number(measured(self.record, "breakdown"))

    def told(self) -> str:
        """The breakdown with its interval, or the count behind what is said of an end of the sweep."""
        if not self.known:
            return self.short()
        if not self.falls:
            return f"success rises with severity (mild: {self._count('mild')}; severe: {self._count('severe')})"
        low, high = (measured(self.record, f"breakdown_{end}") for end in ("low", "high"))
        if self.at_once:
            reach = f", up to {format.number(high)}" if high is not None else ""
            return f"at once ({self._count('mild')}{reach})"
        if self.never:
            reach = f", from {format.number(low)}" if low is not None else ""
            return f"none ({self._count('severe')}{reach})"
        told = [format.number(end) if end is not None else "beyond" for end in (low, high)]
        return f"{self.short()} ({' to '.join(told)})"

    def _count(self, end: str) -> str:
        """How many trials failed at an end of the sweep, with Wilson's interval."""
        n = int(measured(self.record, f"{end}_trials") or 0)
        if not n:
            return "not tried"
        failed = n - int(measured(self.record, f"{end}_successes") or 0)
        rate = wilson(failed, n)
        return f"{failed} of {n} failed, {100 * rate.low:.0f}-{100 * rate.high:.0f} %"

    def failures(self) -> dict[str, int]:
        """Failed trials by kind."""
        prefix = "failed_"
        return {
            name.removeprefix(prefix).replace("_", " "): int(count)
            for name, count in self.record["metrics"].items()
            if name.startswith(prefix)
        }


@dataclass(frozen=True)
class Atlas:
    """All cells: `cells[axis, row]`, with axes in the order of their groups and rows in that of their runs."""

    axes: list[str]
    rows: list[str]
    cells: dict[tuple[str, str], Cell]

    def on(self, axis: str) -> Iterable[tuple[str, Cell]]:
        """The rows that have a cell on an axis, each with it."""
        return [(row, self.cells[axis, row]) for row in self.rows if (axis, row) in self.cells]

    def of(self, row: str) -> list[Cell]:
        """A row's cells."""
        return [self.cells[axis, row] for axis in self.axes if (axis, row) in self.cells]

    def any_on(self, axis: str) -> Cell:
        """One of an axis's cells, for what they share."""
        return next(cell for _, cell in self.on(axis))

    def group(self, axis: str) -> str:
        """Under which an axis is shown."""
        return str(setting(self.any_on(axis).record["config"], "task", "stress", "group"))

    def unit(self, axis: str) -> str:
        """Of an axis's severities."""
        return str(setting(self.any_on(axis).record["config"], "task", "stress", "sweep", "unit"))

    def measure(self, axis: str) -> str:
        """What is judged on an axis."""
        return str(setting(self.any_on(axis).record["config"], "task", "stress", "measure"))


def atlas(experiment: Experiment) -> Atlas:
    """The grid of an experiment's records, of the seed that was asked for last."""
    records = experiment.of_newest_scene().records
    cells = {(record["dataset"], row_name(record)): Cell(record) for record in records}
    rows = list(dict.fromkeys(row for _, row in cells))
    axes = list(dict.fromkeys(axis for axis, _ in cells))
    grid = Atlas(axes, rows, cells)
    places = {group: place for place, group in enumerate(GROUPS)}
    return Atlas(sorted(axes, key=lambda axis: places.get(grid.group(axis), len(GROUPS))), rows, cells)


def title(axis: str) -> str:
    """An axis's name, in words."""
    return axis.replace("_", " ")
