"""The question that a table or figure answers, its verdict in a sentence and its chart, from its CSV alone."""

import math
import re
from dataclasses import dataclass
from typing import Any

import pandas as pd

from bench.records.format import number
from bench.report.data.statistics import median
from bench.report.write.chart import panel_data as chart_panel
from bench.report.write.chart import series

__all__ = ["Answer", "chart_panel", "presets_of", "ranked", "series"]


@dataclass(frozen=True)
class Answer:
    """What the first screen says of a page.

    Args:
        question: as a reader would ask it.
        verdict: one sentence with its number between asterisks; empty where the data do not say.
        chart: panels of series, as `chart_panel` makes them.
        atlas: a grid of cells, as the page `stability` makes it.
    """

    question: str
    verdict: str = ""
    chart: dict[str, Any] | None = None
    atlas: dict[str, Any] | None = None


@dataclass(frozen=True)
class Ranked:
    """Rows with their medians, the best first; `n` is the number of shapes."""

    rows: list[tuple[str, float]]
    n: int

    def said(self, what: str, *, scale: float = 1.0, unit: str = "", most: str = "lowest") -> str:
        """The median of the best row, the next and the last, in a sentence; empty without two rows."""
        if len(self.rows) < 2 or not math.isfinite(self.rows[0][1]):
            return ""
        shown = [f"{_short(value, scale)}{unit} ({name})" for name, value in self.rows]
        best = re.sub(r"^(\S+)", r"*\1*", shown[0])
        rest = f", and at the other end {shown[-1]}" if len(shown) > 2 else ""
        return f"The {most} median {what}: {best}, then {shown[1]}{rest}; {self.sample}."

    @property
    def sample(self) -> str:
        """The number of shapes as text."""
        return f"n = {self.n} shape{'s' if self.n != 1 else ''}"


def ranked(data: pd.DataFrame, metric: str, *, better: str = "lower", by: str = "row") -> Ranked:
    """The rows of runs by the median of a metric, in which a run that did not end ok is the worst.

    Rows with fewer runs than the others are left out: they are not of the same shapes.
    """
    sign = 1.0 if better == "lower" else -1.0
    values = (sign * data[metric]).where(data["status"] == "ok", math.inf).fillna(math.inf)
    groups = {name: own.to_numpy(float) for name, own in values.groupby(data[by], sort=False)}
    most = max(map(len, groups.values()), default=0)
    found = [(str(name), sign * float(median(own))) for name, own in groups.items() if len(own) == most]
    return Ranked(sorted(found, key=lambda item: sign * item[1]), shapes(data))


def at_fewest_points(data: pd.DataFrame) -> tuple[str, Ranked]:
    """The least number of observed points, which stands last, and the rows by their errors from these."""
    points = data["points"].astype(str)
    fewest = list(dict.fromkeys(points))[-1]
    return fewest, ranked(data[points == fewest], "chamfer_l2")


def shapes(data: pd.DataFrame) -> int:
    """The number of shapes of the runs."""
    keys = [key for key in ("family", "index") if key in data]
    return len(data[keys].drop_duplicates()) if keys else 1


def excluding(data: pd.DataFrame, names: list[str]) -> tuple[int, int]:
    """How many ratios of these columns have intervals (`_low`, `_high`) that exclude 1, and how many have one."""
    ends = [(row[f"{name}_low"], row[f"{name}_high"]) for _, row in data.iterrows() for name in names]
    known = [(low, high) for low, high in ends if not (math.isnan(low) or math.isnan(high))]
    return sum(not low <= 1 <= high for low, high in known), len(known)


def presets_of(data: pd.DataFrame, names: str = "row") -> dict[str, str]:
    """The preset of each row of a CSV, which decides its look; an older CSV has the renderer, or the name alone."""
    found = {str(name): str(name) for name in data[names]}
    for column in [each for each in ("renderer", "preset") if each in data and each != names]:
        known = data[data[column].notna()]
        found |= dict(zip(known[names].astype(str), known[column].astype(str), strict=True))
    return found


def _short(value: float, scale: float) -> str:
    return "∞" if not math.isfinite(value) else number(value, scale)
