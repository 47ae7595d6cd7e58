"""A page of one condition that takes several values: medians of some metrics for each row, and ratios to one value."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from bench.records import format
from bench.report.data import statistics
from bench.report.data.runs import Runs
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import Column, ends, text

SHAPE = ["family", "solid", "seed"]
NOTE = (
    "Values are medians over shapes. The figure and the CSV have intervals of the sign test. A ratio is the median of "
    "the ratios on the same shapes, not the ratio of medians. The answer calls a ratio significant by the sign test "
    "with Holm's correction over all its ratios."
)
Line = dict[str, Any]


@dataclass(frozen=True)
class Measure:
    """A metric of a page: its column of a run, its heading, a factor, and the value of a run without it."""

    key: str
    heading: str
    factor: float = 1.0
    failed: float = np.inf  # nan leaves the run out


@dataclass(frozen=True)
class ConditionCurves:
    """A page over the values of a condition. A run that ended without progress counts with its result."""

    condition: str  # key of the configuration
    heading: str  # of the condition
    first: float  # the value that the verdict and the ratios compare with
    compared: float  # the value of the verdict
    measures: tuple[Measure, ...]  # ratios and the verdict are of the first, whose `failed` is a number
    title: str
    question: str
    verdict: str  # begins the sentence with the ratios
    notes: Callable[[Runs], list[str]]
    also_compared: tuple[float, ...] = ()  # further values of the verdict, without a `reference`
    absent: float = 0.0  # the value of the condition in runs without the key
    reference: str = ""  # preset of the row that the verdict compares with at `compared`; empty: each row at `first`
    leading: str = ""  # begins a sentence on the medians of the first measure at the ends of the condition; empty: none
    only_in_table: tuple[str, ...] = ()  # presets that the figure leaves out, and the verdict without a `reference`

    def __call__(self, runs: Runs) -> Result:
        runs = runs.executed
        values = runs.number(f"config.{self.condition}").fillna(self.absent)
        metrics = {each.key: each.factor * runs.number(each.key).fillna(each.failed) for each in self.measures}
        frame = runs.frame[[*SHAPE, "row", "preset", "status"]].assign(
            value=values, cost=runs.number("evaluations_cost"), **metrics
        )
        lines = self._lines(frame)
        compared = self._against_reference(frame) if self.reference else self._over_first(lines)
        return Result(
            runs,
            self.title,
            f"{self.measures[0].heading}, over {self.heading.lower()}.",
            question=self.question,
            verdict=" ".join(filter(None, [self._medians(lines), self._verdict(compared)])),
            interval="95 % intervals over shapes (of the sign test)",
            estimates=[line["estimates"][self.measures[0].key] for line in lines],
            remarks=[*self.notes(runs), NOTE],
            columns=self._columns(),
            lines=lines,
            figure=chart.draw([self._panel(lines, each) for each in self.measures], 3.4, legend=2),
        )

    def _columns(self) -> tuple[Column, ...]:
        first = self.measures[0]
        return (
            *(text("name", "Method"), Column("value", self.heading, show="{:g}".format), Column("shapes", "Shapes")),
            *(Column(first.key, first.heading), *ends(first.key, lambda line: line["estimates"][first.key])),
            *(Column("ratio", f"Median ratio to that at {self.first:g}"), *ends("ratio", lambda line: line["gain"])),
            *(Column(each.key, each.heading) for each in self.measures[1:]),
            Column("cost", "Field evaluations"),
            text("failed", "Not ok"),
        )

    def _lines(self, frame: pd.DataFrame) -> list[Line]:
        lines = []
        for (name, preset), row in frame.groupby(["row", "preset"], sort=False):
            groups = {value: group.set_index(SHAPE).sort_index() for value, group in row.groupby("value")}
            for value, group in groups.items():
                measured = {each.key: group[each.key].dropna() for each in self.measures}
                groups_of = {key: statistics.shape_groups(of_runs) for key, of_runs in measured.items() if len(of_runs)}
                estimates = {key: statistics.typical(of_shapes) for key, of_shapes in groups_of.items()}
                gain = None if value == self.first else self._gain(group, groups.get(self.first))
                lines.append(
                    {
                        **{"name": name, "preset": preset, "shapes": len(group)},
                        "value": int(value) if value == int(value) else value,
                        **{key: estimate.value for key, estimate in estimates.items()},
                        **{"estimates": estimates, "ratio": gain and gain.value, "gain": gain},
                        "cost": format.number(group.cost.median()),
                        "failed": f"{(group.status != 'ok').sum()} of {len(group)}",
                    }
                )
        return lines

    def _gain(self, group: pd.DataFrame, first: pd.DataFrame | None) -> statistics.Interval | None:
        """The ratio of the first measure, on common shapes."""
        key = self.measures[0].key
        return None if first is None else statistics.common_ratio(group[key], first[key])

    def _over_first(self, lines: list[Line]) -> dict[str, statistics.Interval]:
        """The ratio of each row of the figure at the compared values to the row at the first value."""
        values = (self.compared, *self.also_compared)
        compared = [line for line in lines if line["value"] in values and line["gain"] is not None]
        form = "{name} at {value:g}" if self.also_compared else "{name}"
        return {form.format(**line): line["gain"] for line in compared if line["preset"] not in self.only_in_table}

    def _against_reference(self, frame: pd.DataFrame) -> dict[str, statistics.Interval]:
        """The ratio of each other row to the reference row, at the compared value."""
        rows = {names: group for names, group in frame[frame.value == self.compared].groupby(["row", "preset"])}
        groups = {names: group.set_index(SHAPE).sort_index() for names, group in rows.items()}
        reference = next((group for (_, preset), group in groups.items() if preset == self.reference), None)
        gains = {
            name: self._gain(group, reference) for (name, preset), group in groups.items() if preset != self.reference
        }
        return {name: gain for name, gain in gains.items() if gain is not None}

    def _verdict(self, ratios: dict[str, statistics.Interval]) -> str:
        if not ratios:
            return f"No ratio at {self.heading.lower()} {self.compared:g}: no row has it with a row to compare it with."
        verdicts = dict(zip(ratios, statistics.ratio_verdicts([*ratios.values()]), strict=True))
        differ = [name for name, verdict in verdicts.items() if verdict is statistics.Verdict.DIFFERS]
        parts = [f"*{format.number(ratios[name].value)}* ({name})" for name in differ]
        if len(differ) < len(ratios):
            undecided = statistics.Verdict.NOT_DECIDABLE in verdicts.values()
            reason = "undecided: too few shapes" if undecided else "not significantly different from 1"
            if differ:
                others = len(ratios) - len(differ)
                parts.append(f"{format.plural(others, 'other ratio')} {'is' if others == 1 else 'are'} {reason}")
            else:
                parts = [f"*{format.number(ratio.value)}* ({name}), {reason}" for name, ratio in ratios.items()]
        shapes = sorted({len(ratio.points) for ratio in ratios.values()})
        return f"{self.verdict}: {'; '.join(parts)}; n = {' or '.join(map(str, shapes))} shapes."

    def _medians(self, lines: list[Line]) -> str:
        """The least and the largest median at both ends of the condition, with their rows; empty if unwanted."""
        shown = [line for line in lines if line["preset"] not in self.only_in_table] if self.leading else []
        if not shown:
            return ""
        key, values, texts = self.measures[0].key, [line["value"] for line in shown], list[str]()
        for value in sorted({min(values), max(values)}):
            at_value = sorted((line for line in shown if line["value"] == value), key=lambda line: line[key])
            ends = [f"*{format.number(line[key])}* ({line['name']})" for line in (at_value[0], at_value[-1])]
            texts.append(f"{' to '.join(ends)} at {value:g}")
        return f"{self.leading}: {', and '.join(texts)} {self.heading.lower()}."

    def _panel(self, lines: list[Line], measure: Measure) -> chart.Panel:
        rows: dict[tuple[str, str], list[Line]] = {}
        for line in lines:
            if line["preset"] not in self.only_in_table and measure.key in line["estimates"]:
                rows.setdefault((line["name"], line["preset"]), []).append(line)
        values = sorted({line["value"] for line in lines})
        curves = [
            chart.curve(
                *row,
                [values.index(line["value"]) for line in points],
                [line["estimates"][measure.key] for line in points],
            )
            for row, points in rows.items()
        ]
        ticks = [f"{value:g}" for value in values]
        return chart.panel_data("", self.heading.lower(), measure.heading, curves, ticks=ticks)
