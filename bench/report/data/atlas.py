"""The results of the stress test as a grid of axes and renderers."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Record, Row, measured, row_of, setting
from bench.report.data.statistics import wilson

STABILITY = Selection("stability", ("stability",), ("stress",), ("stress",))


@dataclass(frozen=True)
class Cell:
    """The result of a renderer on an axis."""

    record: Record

    @property
    def known(self) -> bool:
        """Whether its search finished."""
        sweep = setting(self.record["config"], "task", "stress", "sweep")
        return self.record["status"] == "ok" and self.level is not None and isinstance(sweep, dict)

    @property
    def unsupported(self) -> bool:
        """Whether the renderer lacks a setting or a gradient that the axis needs."""
        return self.record["status"] == "unsupported"

    @property
    def level(self) -> float | None:
        """The breakdown on a scale from 0, the mild end of the sweep, to 1, the severe end, or beyond these."""
        return measured(self.record, "level")

    @property
    def shade(self) -> float:
        """The level clipped to 0 to 1; nan where there is none."""
        return min(max(self.level, 0.0), 1.0) if self.known and self.level is not None else math.nan

    @property
    def at_once(self) -> bool:
        """Whether it breaks at the mildest severity, or before it."""
        return self.known and self.level is not None and self.level < 0

    @property
    def never(self) -> bool:
        """Whether it does not break within the sweep."""
        return self.known and self.level is not None and self.level > 1

    @property
    def ends(self) -> tuple[float, float]:
        """The mild and the severe end of the sweep."""
        sweep = setting(self.record["config"], "task", "stress", "sweep")
        return float(sweep["mild"]), float(sweep["severe"])

    @property
    def log(self) -> bool:
        """Whether levels are linear in the logarithm of the severity."""
        return bool(setting(self.record["config"], "task", "stress", "sweep", "log"))

    def place(self, severity: float) -> float:
        """The level of a severity."""
        mild, severe = self.ends
        if self.log:
            return math.log(severity / mild) / math.log(severe / mild)
        return (severity - mild) / (severe - mild)

    def covers(self, severity: float) -> bool:
        """Whether a severity lies in the breakdown's interval, or beyond the same end of the sweep as the breakdown."""
        low, high = (measured(self.record, f"level_{end}") for end in ("low", "high"))
        if low is None or high is None:
            return False
        level = self.place(severity)
        return low <= level <= high or (self.at_once and level < 0) or (self.never and level > 1)

    @property
    def falls(self) -> bool:
        """Whether the share of successful trials is no larger at the severe end than at the mild one."""
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

    def full(self) -> str:
        """The breakdown with its interval, or the count of failures at an end of the sweep."""
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
        ends = [format.number(end) if end is not None else "beyond" for end in (low, high)]
        return f"{self.short()} ({' to '.join(ends)})"

    def _count(self, end: str) -> str:
        """The number of failed trials at an end of the sweep, with Wilson's interval."""
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
    """All cells as `cells[axis, row]`, with axes sorted by group and rows in the order of their runs."""

    axes: list[str]
    rows: list[Row]
    cells: dict[tuple[str, Row], Cell]

    def on(self, axis: str) -> Iterable[tuple[Row, Cell]]:
        """The rows that have a cell on an axis, each with its cell."""
        return [(row, self.cells[axis, row]) for row in self.rows if (axis, row) in self.cells]

    def of(self, row: Row) -> list[tuple[str, Cell]]:
        """The axes on which a row has a cell, each with its cell."""
        return [(axis, self.cells[axis, row]) for axis in self.axes if (axis, row) in self.cells]

    def stress(self, axis: str, *path: str) -> str:
        """A setting of an axis, such as its group, its measure or the unit of its severities."""
        _, cell = next(iter(self.on(axis)))
        return str(setting(cell.record["config"], "task", "stress", *path))

    def group(self, axis: str) -> str:
        """The group of an axis."""
        return self.stress(axis, "group")

    def unit(self, axis: str) -> str:
        """The unit of an axis's severities."""
        return self.stress(axis, "sweep", "unit")


def atlas(experiment: Experiment) -> Atlas:
    """The grid of an experiment's records with the seed that was requested last; groups in the order of their runs."""
    records = experiment.of_newest_scene().records
    cells = {(record["dataset"], row_of(record)): Cell(record) for record in records}
    rows = list(dict.fromkeys(row for _, row in cells))
    grid = Atlas(list(dict.fromkeys(axis for axis, _ in cells)), rows, cells)
    groups = list(dict.fromkeys(map(grid.group, grid.axes)))
    return Atlas(sorted(grid.axes, key=lambda axis: groups.index(grid.group(axis))), rows, cells)


def title(axis: str) -> str:
    """An axis's name, in words."""
    return axis.replace("_", " ")
