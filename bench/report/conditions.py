"""Runs of shape from many views under conditions of which one varies at a time: medians, and their figure."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from matplotlib.figure import Figure

from bench.report.data.records import ONE_WAY, SCALE, Record, by_shape, error, family, grouped, row_of, run_key, setting
from bench.report.data.statistics import Interval, bootstrap, median
from bench.report.write import chart
from bench.report.write.table import FAMILY, IDENTITY, Column, configured, estimate, metrics, text

BELOW = "median Chamfer distance from truth to prediction (squared scene units, times 1000)"
LABEL = "Chamfer × 1000, truth to\nprediction (scene units²)"
INTERVALS = "95 % bootstrap intervals over {shapes and seeds}"
MEDIAN = estimate("error", "Median")
NAMED = (text("family", "Family"), text("method", "Method"), text("condition", "Condition"))


@dataclass(frozen=True)
class Condition:
    """A setting of the task that varies.

    Args:
        key: its name in the task.
        label: with its unit.
        neutral: its value where another varies.
    """

    key: str
    label: str
    neutral: float

    def of(self, record: Record) -> float:
        """Its value in a run."""
        return float(setting(record["config"], "task", self.key))


def run_columns(conditions: Sequence[Condition], *others: str) -> tuple[Column, ...]:
    """The columns of the CSV, with these conditions and other settings of the task."""
    keys = (*(configured(one.key, "task", one.key) for one in conditions), *IDENTITY)
    return (FAMILY, *keys, *(configured(key, "task", key) for key in others), *metrics(ONE_WAY, "chamfer_l2"))


def middle(records: Sequence[Record]) -> Interval:
    """The median error x 1000 over shapes and seeds, in which a run that failed is infinite."""
    return bootstrap(by_shape({run_key(run): SCALE * error(run, ONE_WAY) for run in records}), median)


def lines_of(records: Sequence[Record], conditions: Sequence[Condition]) -> list[dict[str, Any]]:
    """A line per family, row, condition and its value, with all other conditions at their neutral values.

    Each has family, method, preset, the condition as text, the place of the condition, its value `at`, its `runs` and
    their median `error`.
    """
    lines = []
    for place, one in enumerate(conditions):
        alone = [r for r in records if all(other.of(r) == other.neutral for other in conditions if other != one)]
        for (name, row, at), own in grouped(alone, lambda r, one=one: (family(r), row_of(r), one.of(r))).items():
            told = {"family": name, "method": row.name, "preset": row.preset, "condition": f"{one.label}: {at:g}"}
            lines.append(told | {"key": one.key, "place": place, "at": at, "runs": own, "error": middle(own)})
    return sorted(lines, key=lambda line: (line["family"], line["method"], line["key"], line["at"]))


def draw(lines: Sequence[dict[str, Any]], conditions: Sequence[Condition], success: float) -> Figure:
    """Draws a row of panels per family: the error over the value of each condition, a line per method.

    `success` is the largest error of a run that counts as one, drawn as a line. What is infinite is drawn at the edge.
    """
    of_family, panels = grouped(lines, lambda line: line["family"]), []
    for (name, own), (place, one) in product(of_family.items(), enumerate(conditions)):
        of_row = grouped([x for x in own if x["place"] == place], lambda line: (line["method"], line["preset"]))
        drawn = [chart.curve(*row, [x["at"] for x in of], [x["error"] for x in of]) for row, of in of_row.items()]
        if drawn:
            drawn.append(chart.level("success: below", [x["at"] for x in own if x["place"] == place], success))
        panels.append(chart.panel_data(name, one.label, LABEL, drawn))
    return chart.draw(panels, 2.1 * len(of_family) + 0.5, len(of_family), legend=3, sharey="row")
