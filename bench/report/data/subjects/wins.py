"""Rows against each other: on how many of the runs that both have the one is better, and the ratio of their errors."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from bench.records import format
from bench.report.data import statistics
from bench.report.data.records import Row, RunKey, by_shape
from bench.report.data.statistics import Interval

NOTE = (
    "A cell is the number of pairs that the row to its left wins against the row above it, of how many, and below six "
    "shapes their number (n), else the probability that it wins, in per cent, with the interval of Clopper and Pearson "
    "for as many trials as there are shapes. A pair is of the same shape, view, seed and condition; lower is better; "
    "equal errors, and two failures, are half a win each."
)


@dataclass(frozen=True)
class Duel:
    """Two rows on the runs that both have: how many of these pairs the first wins, and the probability of it."""

    first: Row
    second: Row
    won: float
    pairs: int
    chance: Interval

    @property
    def line(self) -> dict[str, Any]:
        """Its numbers, as a line of a CSV."""
        numbers = {"won": self.won, "pairs": self.pairs, "shapes": len(self.chance.points) or None}
        ends = {"probability": self.chance.value, "low": self.chance.low, "high": self.chance.high}
        return {"row": self.first.name, "other": self.second.name, **numbers, **ends}

    def __str__(self) -> str:
        """The wins of how many pairs, and the probability with its interval or the number of shapes."""
        if not self.pairs:
            return format.MISSING
        count = f"{self.won:g} of {self.pairs}"
        shapes = f"{count} {self.chance.ends()}" if self.chance.points else count
        return f"{count}: {100 * self.chance.value:.0f} % {self.chance.ends(100)}" if self.chance.known else shapes


def duel(first: Row, second: Row, errors: Mapping[Row, Mapping[RunKey, float]]) -> Duel:
    """The wins of one row against another.

    Args:
        errors: of each row by shape, view, seed and further conditions; infinite for a run that failed.
    """
    common = [key for key in errors[first] if key in errors[second]]
    mine, others = (by_shape({key: errors[row][key] for key in common}) for row in (first, second))
    if not common:
        return Duel(first, second, 0.0, 0, Interval(math.nan, math.nan, math.nan))
    won = statistics.lower(statistics.flat(mine), statistics.flat(others))
    return Duel(first, second, won, len(common), statistics.wins(mine, others))


@dataclass(frozen=True)
class Gap:
    """The ratio of two rows' errors, and on how many of the shapes that both have the first is better, ties half."""

    ratio: Interval
    better: float
    shapes: int

    def __str__(self) -> str:
        """The ratio with its interval, and the shapes."""
        return f"{self.ratio}; {self.better:g} of {self.shapes}"


def gap(first: statistics.Groups, second: statistics.Groups) -> Gap | None:
    """The gap between two rows on the same shapes, by the geometric means of their errors; None without a shape."""
    if not first:
        return None
    return Gap(
        statistics.geometric_ratio(first, second),
        statistics.lower(*map(statistics.shape_medians, (first, second))),
        len(first),
    )


def excluding_one(ratios: Sequence[tuple[str, Interval]], of: str, *, said: str = "The interval") -> list[str]:
    """A sentence with how many of the known ratios have an interval that excludes 1, and which; none without any."""
    known = [(name, ratio) for name, ratio in ratios if ratio.known]
    sure = [name for name, ratio in known if ratio.excludes(1)]
    named = f": {'; '.join(sure)}" if sure else ""
    return [f"{said} excludes 1 for {len(sure)} of {len(known)} ratios {of}{named}."] if known else []


def duels(errors: Mapping[Row, Mapping[RunKey, float]]) -> list[Duel]:
    """Each row against each other row, in the order of the rows."""
    return [duel(first, second, errors) for first in errors for second in errors if first != second]


def table(found: list[Duel]) -> pd.DataFrame:
    """The wins as a readable table, rows against rows."""
    rows = list(dict.fromkeys(one.first for one in found))
    words = {(one.first, one.second): str(one) for one in found}
    cells = [[row.name, *(words.get((row, other), "") for other in rows)] for row in rows]
    return pd.DataFrame(cells, columns=["Row wins against", *(row.name for row in rows)])
