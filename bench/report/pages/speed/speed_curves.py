"""Error over time and over field values, and the time to a target error."""

import math
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.curves import HISTORY, history_of, spearman
from bench.report.data.experiments import Experiment
from bench.report.data.records import SCALE, Record, Row, loop_seconds
from bench.report.data.statistics import FEWEST_SHAPES, kaplan_meier
from bench.report.data.subjects.speed import COMPLETION, TARGET, Setting, main_settings, settings, sizes
from bench.report.write import chart
from bench.report.write.answer import Answer, chart_panel, series
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, Column, text, through, to_data, to_table

PLACE = 90
READS = (COMPLETION.selection,)
ALONG = {"seconds": "time (seconds)", "value_evaluations": "field values"}
NOTES = (
    "Left and middle: Chamfer distance times 1000 during the optimisation, medians over the runs of each renderer's "
    "main setting; a run that did not end ok is infinite after its end.",
    f"Right: the share of runs not yet at {SCALE * TARGET:g} × 10⁻³ (Kaplan and Meier); a run that ended above it is "
    "censored, one that failed remains to the end. The table has all settings, and the median time of the runs that "
    "reached it.",
    "ρ is Spearman's rank correlation of loss and Chamfer distance over the checkpoints of a run, its median over "
    "runs.",
)
Reached = tuple[float, bool]  # seconds, and whether the target was reached then
Histories = dict[Row, list[pd.DataFrame]]  # of the runs of each setting
POINTS = (  # of a record and a point of its history
    *through(lambda line: line[0], *IDENTITY, FAMILY),
    *through(lambda line: line[1], *map(Column, HISTORY)),
)
COLUMNS = (
    *(text("setting", "Setting"), text("runs", "Runs"), text("reached", "Reached")),
    *(Column("median", "Median time to it", show=format.seconds), Column("rank", "ρ of loss and error")),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per setting: its runs, how many reached the target, and their median time."""
    rows = settings(experiment, COMPLETION)
    shown = {row.row: [history_of(experiment, record) for record in row.records] for row in rows}
    pairs = {row.row: list(zip(row.records, shown[row.row], strict=True)) for row in rows}
    times = {row: [time_to(history, record) for record, history in of_row] for row, of_row in pairs.items()}
    ranks = {row: [spearman(history.dropna()) for history in of_row] for row, of_row in shown.items()}
    points = [
        (record, point)
        for of_row in pairs.values()
        for record, history in of_row
        for point in history.astype(object).to_dict("records")
    ]
    return Result(
        experiment,
        "Error over time and over field values.",
        "Error over seconds and over field values, and the share of runs that have not reached the target.",
        interval=_bands(rows),
        remarks=(sizes(rows), *NOTES),
        data=to_data(POINTS, points),
        table=to_table(COLUMNS, [_line(row, times[row], ranks[row]) for row in times]),
        figure=draw(main_settings(rows), shown, times),
    )


def _bands(rows: list[Setting]) -> str:
    """What is drawn around the medians."""
    return "thin lines are the runs, fewer than six shapes" if _few(rows) else "bands are the quartiles of the runs"


def _few(rows: list[Setting]) -> bool:
    """Whether there are too few shapes for a band."""
    return len({run[0] for row in rows for run in row.keys}) < FEWEST_SHAPES


def _line(row: Row, times: list[Reached], ranks: list[float | None]) -> dict[str, Any]:
    reached = [time for time, hit in times if hit]
    median = float(np.median(reached)) if reached else None
    known = [rank for rank in ranks if rank is not None]
    numbers = {"median": median, "rank": float(np.median(known)) if known else None}
    return {"setting": row.name, "runs": len(times), "reached": len(reached), **numbers}


@style.styled
def draw(rows: list[Setting], shown: Histories, times: dict[Row, list[Reached]]) -> Figure:
    """Draws the error over seconds and over evaluations, and the share of runs that have not reached the target."""
    figure, (axes,) = chart.sheet(2.9, 1, 3)
    for axis, (along, label) in zip(axes, ALONG.items(), strict=False):
        everything = []  # positions with finite medians: a logarithmic axis needs a point
        for row in rows:
            where, low, middle, high = band(shown[row.row], [r["status"] != "ok" for r in row.records], along)
            quartiles = None if _few(rows) else (style.finite(low), style.finite(high))
            chart.line(axis, row.renderer, where, style.finite(middle), band=quartiles, marker="", label=row.name)
            for history in shown[row.row] if _few(rows) else []:
                chart.line(axis, row.renderer, history[along], history["error"], marker="", lw=0.5, alpha=0.5)
            everything += [*where] if np.isfinite(middle).any() else []
        errors = [x for row in rows for history in shown[row.row] for x in history["error"]]
        style.log_axis(axis, "x", everything)
        style.log_axis(axis, "y", errors if everything else [])
        axis.set(xlabel=label, ylabel=COMPLETION.heading)
    _survival(axes[2], {row: times[row.row] for row in rows})
    style.legend_below(figure, axes[0], columns=5)
    return figure


def _survival(axis: Axes, times: dict[Setting, list[Reached]]) -> None:
    """Draws the share of each row's runs that have not reached the target; a tick is the end of a run that did not."""
    known = [time for row in times.values() for time, _ in row if math.isfinite(time)]
    latest = max(known, default=1.0)
    for row, reached in times.items():
        colour = style.look(row.renderer).colour
        # Those with an infinite time, which failed, remain until `latest`.
        left = kaplan_meier([min(time, latest) for time, _ in reached], [hit for _, hit in reached])
        end = max(min(time, latest) for time, _ in reached)
        where, share = np.append(left.times, end), np.append(left.remaining, left.remaining[-1])
        axis.step(where, share, where="post", color=colour)
        ticks = [time for time, hit in reached if not hit and math.isfinite(time)]
        at = [left.remaining[np.searchsorted(left.times, time, side="right") - 1] for time in ticks]
        axis.plot(ticks, at, "|", color=colour, ms=6)
    axis.set(
        xlabel="time (seconds)",
        ylabel=f"share of runs\nnot yet at Chamfer × 1000 = {SCALE * TARGET:g}",
        ylim=(-0.03, 1.03),
    )
    style.log_axis(axis, "x", known)


def band(
    runs: list[pd.DataFrame], failed: list[bool], along: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Positions along an axis, and the quartiles of the runs' errors there.

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


def time_to(history: pd.DataFrame, record: Record) -> Reached:
    """The time of a run's first checkpoint at the target, else of its end; infinite where it failed or was not run.

    A failed run counts as one that never reaches the target.
    """
    if record["status"] != "ok":
        return math.inf, False
    below = history[history["error"] <= SCALE * TARGET]
    if len(below):
        return float(below["seconds"].iloc[0]), True
    return loop_seconds(record) or 0.0, False


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row that reaches the target first, and the curves of its runs."""
    keys = ["row", "family", "index", "seed"]
    reached = data[data["status"].eq("ok") & (data["error"] <= SCALE * TARGET)].groupby(keys)["seconds"].min()
    times = {
        row: [
            float(reached.get((row, *key), math.inf)) for key in own[keys[1:]].drop_duplicates().itertuples(index=False)
        ]
        for row, own in data.groupby("row", sort=False)
    }
    first = sorted((float(np.median(found)), row) for row, found in times.items())
    finite = [(seconds, row) for seconds, row in first if math.isfinite(seconds)]
    said = (
        f"{finite[0][1]} reaches an error of {SCALE * TARGET:g} (Chamfer × 1000) first, in "
        f"*{format.seconds(finite[0][0])}* (median)"
        if finite
        else ""
    )
    last = (
        f"; {len(first) - len(finite)} of {len(first)} settings do not reach it on most shapes"
        if len(finite) < len(first)
        else ""
    )
    return Answer(
        "How fast does the error fall?",
        f"{said}{last}." if said else "",
        {"panels": _panels(data), "note": "A line is a run, which a click opens."},
    )


def _panels(data: pd.DataFrame) -> list[dict[str, Any]]:
    """A line per run, over seconds and over field values; of the first setting of each renderer at first."""
    first = set(data.drop_duplicates("renderer")["row"])
    panels = []
    for along, label in (("seconds", "time in the loop (seconds)"), ("value_evaluations", "field values")):
        lines = []
        for (row, folder), own in data.groupby(["row", "folder"], sort=False):
            one = own[own[along] > 0]
            scene = f"{own['family'].iloc[0]} {own['index'].iloc[0]}, seed {own['seed'].iloc[0]}"
            words = [
                [scene, f"{format.seconds(r.seconds)}, error × 1000 {format.number(r.error)}"] for r in one.itertuples()
            ]
            off = {} if row in first else {"off": True}
            look = {"text": words, "link": [f"#/run/{folder}"] * len(one), "dash": "-", "size": 4, **off}
            lines.append(series(row, str(own["renderer"].iloc[0]), one[along], one["error"], **look))
        panels.append(chart_panel("", label, "Chamfer × 1000", lines, height=420))
    return panels
