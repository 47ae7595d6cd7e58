"""Error over time and over field values as shapes are completed, and the time to a target error."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from bench.pictures import style
from bench.records import format
from bench.report.data.curves import HISTORY, history_of, spearman
from bench.report.data.records import SCALE, Record, Row, base_renderer, family, index, loop_seconds, median_of_known
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import FEWEST_SHAPES
from bench.report.write import chart
from bench.report.write.chart import panel_data, series
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, Column, text, to_table

PLACE = 90
READS = (Selection("speed_completion"),)
TARGET = 1e-3  # Chamfer distance (squared scene units); the time to reach it is measured
MAIN = {"dvr": "dvr_early_stop"}  # presets that stand for a renderer whose own preset is not among the settings
ALONG = {"seconds": "time (seconds)", "value_evaluations": "field values"}
ERROR = "Chamfer × 1000 (scene units²)"
NOTES = (
    "Left and middle: medians over the runs of each renderer's main setting; a run that did not end ok is infinite "
    "after its end.",
    f"Right: the share of runs not yet at {SCALE * TARGET:g} × 10⁻³ (Kaplan and Meier); a run that ended above it is "
    "censored, one that failed remains to the end.",
    "The table has all settings, and the median time of the runs that reached the target.",
    "ρ is the median over runs of Spearman's rank correlation of loss and Chamfer distance over a run's checkpoints.",
)
Reached = tuple[float, bool]  # seconds, and whether the target was reached then


@dataclass(frozen=True)
class Setting:
    """The runs of a setting of a renderer, their errors over time, and when each reached the target."""

    name: str
    preset: str
    renderer: str
    records: list[Record]
    histories: list[pd.DataFrame]
    times: list[Reached]

    def get(self, key: str) -> Any:
        """A value of its line in the table."""
        reached = [time for time, hit in self.times if hit]
        if key == "median":
            return median_of_known(reached)
        if key == "rank":
            return median_of_known(spearman(history.dropna()) for history in self.histories)
        return {"setting": self.name, "runs": len(self.times), "reached": len(reached)}[key]


def make(runs: Runs) -> Result:
    """A line per setting: its runs, how many reached the target, and their median time."""
    rows = [_setting(runs, row, own) for row, own in runs.rows().items()]
    data = [
        history.assign(**{column.key: column.of(record) for column in (*IDENTITY, FAMILY)})
        for row in rows
        for record, history in zip(row.records, row.histories, strict=True)
    ]
    few = runs.frame.groupby(["family", "solid"]).ngroups < FEWEST_SHAPES
    return Result(
        runs,
        "Error over time and over field values.",
        "Chamfer distance over seconds and over field values, and the share of runs that have not reached the target.",
        question="How fast does the error fall?",
        verdict=_verdict(rows),
        interval="thin lines are the runs, fewer than six shapes" if few else "bands are the quartiles of the runs",
        remarks=NOTES,
        data=pd.concat(data)[[*(column.key for column in (*IDENTITY, FAMILY)), *HISTORY]],
        table=to_table(COLUMNS, rows),
        figure=draw(rows, few=few),
        chart={
            "panels": [_panel(rows, along) for along in ALONG],
            "note": "A line is a run, which a click opens.",
        },
    )


COLUMNS = (
    *(text("setting", "Setting"), text("runs", "Runs"), text("reached", "Reached")),
    *(Column("median", "Median time to it", show=format.seconds), Column("rank", "ρ of loss and error")),
)


def _setting(runs: Runs, row: Row, records: list[Record]) -> Setting:
    histories = [history_of(runs, record) for record in records]
    times = [time_to(history, record) for history, record in zip(histories, records, strict=True)]
    return Setting(row.name, row.preset, base_renderer(records[0]), records, histories, times)


def time_to(history: pd.DataFrame, record: Record) -> Reached:
    """The time of a run's first checkpoint at the target, else of its end; infinite where it failed or was not run."""
    if record["status"] != "ok":
        return math.inf, False
    below = history[history["error"] <= SCALE * TARGET]
    if len(below):
        return float(below["seconds"].iloc[0]), True
    return loop_seconds(record) or 0.0, False


def _verdict(rows: list[Setting]) -> str:
    """The setting that reaches the target first, and how many do not; empty where none does."""
    medians = {row.name: float(np.median([time if hit else math.inf for time, hit in row.times])) for row in rows}
    first = min(rows, key=lambda row: medians[row.name])
    never = sum(map(math.isinf, medians.values()))
    rest = f"; {never} of {len(rows)} settings do not reach it on most shapes" if never else ""
    said = (
        f"{first.name} reaches an error of {SCALE * TARGET:g} (Chamfer × 1000) first, in "
        f"*{format.seconds(medians[first.name])}* (median of n = {len(first.times)} runs){rest}."
    )
    return said if never < len(rows) else ""


@style.styled
def draw(rows: list[Setting], *, few: bool) -> Figure:
    """Draws each renderer's main setting: the error over seconds and field values, and the runs not at the target."""
    presets = {row.preset for row in rows}
    mains = [{row.renderer, MAIN.get(row.renderer, row.renderer)} for row in rows]
    rows = [row for row, main in zip(rows, mains, strict=True) if row.preset in main or not main & presets]
    figure, (axes,) = chart.sheet(2.9, 1, 3)
    for axis, (along, label) in zip(axes, ALONG.items(), strict=False):
        drawn = []  # positions with finite medians: a logarithmic axis needs a point
        for row in rows:
            where, low, middle, high = band(row.histories, [r["status"] != "ok" for r in row.records], along)
            quartiles = None if few else (style.finite(low), style.finite(high))
            chart.line(axis, row.renderer, where, style.finite(middle), band=quartiles, marker="", label=row.name)
            for history in row.histories if few else []:
                chart.line(axis, row.renderer, history[along], history["error"], marker="", lw=0.5, alpha=0.5)
            drawn += [*where] if np.isfinite(middle).any() else []
        style.log_axis(axis, "x", drawn)
        style.log_axis(axis, "y", [x for row in rows for h in row.histories for x in h["error"]] if drawn else [])
        axis.set(xlabel=label, ylabel=ERROR)
    _survival(axes[2], rows)
    style.legend_below(figure, axes[0], columns=5)
    return figure


def _survival(axis: Axes, rows: list[Setting]) -> None:
    """Draws the share of each setting's runs not yet at the target; a tick is the end of a run that did not.

    The share is that of Kaplan and Meier (1958): a run that did not reach the target is censored at its end.
    """
    known = [time for row in rows for time, _ in row.times if math.isfinite(time)]
    latest = max(known, default=1.0)  # until then those that failed remain
    for row in rows:
        colour, hit = style.look(row.renderer).colour, np.array([hit for _, hit in row.times])
        ends = np.array([min(time, latest) for time, _ in row.times])
        left = stats.ecdf(stats.CensoredData(ends[hit], right=ends[~hit])).sf
        axis.step([0.0, *left.quantiles], [1.0, *left.probabilities], where="post", color=colour)
        ticks = [time for time, hit in row.times if not hit and math.isfinite(time)]
        axis.plot(ticks, left.evaluate(ticks), "|", color=colour, ms=6)
    axis.set(xlabel="time (seconds)", ylim=(-0.03, 1.03))
    axis.set_ylabel(f"share of runs\nnot yet at Chamfer × 1000 = {SCALE * TARGET:g}")
    style.log_axis(axis, "x", known)


def band(runs: Sequence[pd.DataFrame], failed: Sequence[bool], along: str) -> tuple[np.ndarray, ...]:
    """Positions along an axis, and the lower quartile, median and upper quartile of the runs' errors there.

    A run's error is that of its last checkpoint, infinite before the first and after the end of a failed run.
    """
    ends = [run[along].iloc[-1] for run in runs if len(run)]
    starts = [run[along][run[along] > 0].min() for run in runs if len(run) > 1]
    if not starts:
        return (np.empty(0),) * 4
    where = np.geomspace(min(starts), max(ends), 60)
    values = np.full((len(runs), len(where)), np.inf)
    for row, (run, over) in enumerate(zip(runs, failed, strict=True)):
        last = np.searchsorted(run[along].to_numpy(), where, side="right") - 1
        known = last >= 0
        values[row, known] = run["error"].to_numpy()[last[known]]
        if over and len(run):
            values[row, where > run[along].iloc[-1]] = np.inf
    low, high = (np.quantile(values, q, axis=0, method="nearest") for q in (0.25, 0.75))
    return where, low, np.median(values, axis=0), high


def _panel(rows: list[Setting], along: str) -> dict[str, Any]:
    """A line per run over seconds or field values; of the first setting of each renderer at first."""
    first = {row.renderer: row.name for row in reversed(rows)}
    lines = []
    for row in rows:
        for record, history in zip(row.records, row.histories, strict=True):
            one = history[history[along] > 0]
            scene = f"{family(record)} {index(record)}, seed {record['seed']}"
            costs = [
                f"{format.seconds(s)}, error × 1000 {format.number(e)}" for s, e in one[["seconds", "error"]].values
            ]
            look = {"text": [[scene, cost] for cost in costs], "link": [f"#/run/{record['folder']}"] * len(one)}
            look |= {"dash": "-", "size": 4} | ({} if first[row.renderer] == row.name else {"off": True})
            lines.append(series(row.name, record["renderer"], one[along], one["error"], **look))
    return panel_data("", ALONG[along], ERROR, lines, height=420)


PAGES = {"speed_curves": make}
