"""The results of the stress test as a grid of axes and renderers."""

import math
from dataclasses import dataclass, field
from typing import Any

from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Record, Row, measured, row_of, setting
from bench.report.data.statistics import clopper_pearson

STABILITY = Selection("stability", ("stability",), ("stress",), ("stress",), setup=("machine",))
FAILED = "failed_"  # beginning of the metrics that count failed trials by kind


@dataclass(frozen=True)
class Cell:
    """The result of a renderer on an axis; without a record where it was not run there."""

    record: Record = field(default_factory=dict)

    def number(self, name: str) -> int | float | None:
        """The value of a metric; None where there is none."""
        return measured(self.record, name) if self.record else None

    def stress(self, *path: str) -> Any:
        """A setting of the axis."""
        return setting(self.record, "config", "task", "stress", *path)

    @property
    def known(self) -> bool:
        """Whether its search finished."""
        return self.record.get("status") == "ok" and self.level is not None and isinstance(self.stress("sweep"), dict)

    @property
    def unsupported(self) -> bool:
        """Whether the renderer lacks a setting or a gradient that the axis needs."""
        return self.record.get("status") == "unsupported"

    @property
    def level(self) -> float | None:
        """The breakdown on a scale from 0, the mild end of the sweep, to 1, the severe end, or beyond these."""
        return self.number("level")

    @property
    def shade(self) -> float:
        """The level clipped to 0 to 1; nan where there is none."""
        return min(max(self.level, 0.0), 1.0) if self.known else math.nan

    @property
    def at_once(self) -> bool:
        """Whether it breaks at the mildest severity, or before it."""
        return self.known and self.level < 0

    @property
    def never(self) -> bool:
        """Whether it does not break within the sweep."""
        return self.known and self.level > 1

    @property
    def ends(self) -> tuple[float, float]:
        """The mild and the severe end of the sweep."""
        return float(self.stress("sweep", "mild")), float(self.stress("sweep", "severe"))

    @property
    def log(self) -> bool:
        """Whether levels are linear in the logarithm of the severity."""
        return bool(self.stress("sweep", "log"))

    @property
    def one_trial(self) -> bool:
        """Whether each level was tried once, since repeats of a trial cannot differ: there is no interval."""
        return self.stress("repeats") == 1

    @property
    def falls(self) -> bool:
        """Whether the share of successful trials is no larger at the severe end than at the mild one."""
        mild, severe = (successes / n if n else 0.0 for successes, n in map(self._trials, ("mild", "severe")))
        return severe <= mild

    def short(self) -> str:
        """The breakdown in a few characters; empty where the renderer was not run."""
        if not self.known:
            return format.MISSING if self.unsupported else self.record.get("status", "")
        if not self.falls:
            return "rises"
        if self.at_once or self.never:
            return "at once" if self.at_once else "none"
        return format.number(self.number("breakdown"))

    def full(self, unit: str = "") -> str:
        """The breakdown, in its unit where one is given, with its interval, or the failures at an end of the sweep."""
        if not self.known:
            return self.short()
        if not self.falls:
            return f"success rises with severity (mild: {self._count('mild')}; severe: {self._count('severe')})"
        unit = f" {unit}" if unit else ""
        low, high = self.number("breakdown_low"), self.number("breakdown_high")
        if self.one_trial and not (self.at_once or self.never):
            return f"{self.short()}{unit} (one trial)"
        if self.at_once:
            reach = f", up to {format.number(high)}{unit}" if high is not None else ""
            return f"at once ({self._count('mild')}{reach})"
        if self.never:
            reach = f", from {format.number(low)}{unit}" if low is not None else ""
            return f"none ({self._count('severe')}{reach})"
        ends = [format.number(end) if end is not None else "beyond" for end in (low, high)]
        return f"{self.short()}{unit} ({' to '.join(ends)})"

    def _trials(self, end: str) -> tuple[int, int]:
        """The numbers of successful and of all trials at an end of the sweep."""
        return int(self.number(f"{end}_successes") or 0), int(self.number(f"{end}_trials") or 0)

    def _count(self, end: str) -> str:
        """The number of failed trials at an end of the sweep; where there are repeats, the interval of their share."""
        successes, n = self._trials(end)
        if not n:
            return "not tried"
        if self.one_trial:
            return f"{n - successes} of {n} failed"
        rate = clopper_pearson(1 - successes / n, n)
        return f"{n - successes} of {n} failed, {100 * rate.low:.0f}-{100 * rate.high:.0f} %"

    def failures(self) -> dict[str, int]:
        """Failed trials by kind."""
        counts = {name: int(n) for name, n in self.record["metrics"].items() if name.startswith(FAILED)}
        return {name.removeprefix(FAILED).replace("_", " "): n for name, n in counts.items()}


@dataclass(frozen=True)
class Atlas:
    """All cells, with axes sorted by group and rows in the order of their runs."""

    axes: list[str]
    rows: list[Row]
    cells: dict[tuple[str, Row], Cell]

    def cell(self, axis: str, row: Row) -> Cell:
        """The cell of a row on an axis; one without a record where it was not run."""
        return self.cells.get((axis, row), Cell())

    def on(self, axis: str) -> list[tuple[Row, Cell]]:
        """The rows that were run on an axis, each with its cell."""
        return [(row, self.cells[axis, row]) for row in self.rows if (axis, row) in self.cells]

    def stress(self, axis: str, *path: str) -> str:
        """A setting of an axis, such as its group, its measure or the unit of its severities."""
        return str(self.on(axis)[0][1].stress(*path))

    def unit(self, axis: str) -> str:
        """The unit of an axis's severities."""
        return self.stress(axis, "sweep", "unit")


def atlas(experiment: Experiment) -> Atlas:
    """The grid of an experiment's records with the seed that was requested last; groups in the order of their runs."""
    cells = {(record["dataset"], row_of(record)): Cell(record) for record in experiment.of_newest_scene().records}
    grid = Atlas(list(dict.fromkeys(axis for axis, _ in cells)), list(dict.fromkeys(row for _, row in cells)), cells)
    groups = list(dict.fromkeys(grid.stress(axis, "group") for axis in grid.axes))
    grid.axes.sort(key=lambda axis: groups.index(grid.stress(axis, "group")))
    return grid


def title(axis: str) -> str:
    """An axis's name, in words."""
    return axis.replace("_", " ")
