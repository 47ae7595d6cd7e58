"""The Pareto front of error and time."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data import statistics
from bench.report.data.experiments import Experiment, together
from bench.report.data.subjects.speed import (
    SEED,
    TRIALS,
    Placed,
    Setting,
    front_line,
    left_out,
    resolution,
    sizes,
    trials,
)
from bench.report.write import chart
from bench.report.write.answer import Answer, chart_panel, runs_of, series
from bench.report.write.caption import undefined
from bench.report.write.result import Result
from bench.report.write.table import Column, defined, shown, text, to_data, to_table

PLACE_FRONT = 80
READS = tuple(trial.selection for trial in TRIALS)
NOTE = "Filled points are on the front, hollow ones are dominated. A point opens the runs of its setting."
NOTES = (
    "Final error of a completion over the seconds of its loop, and depth error of one rendering (95th percentile over "
    "pixels, missed and spurious ones count as infinite) over its seconds. A run that did not end ok is infinite in "
    "both; so is a run that others have and a setting lacks.",
    "Filled points are on the front, hollow ones are dominated, and a cross at the edge is an infinite median. Below "
    "six shapes the small points are the medians of each shape.",
    "In brackets and in the last column: the probability of being on the front, over 2,000 bootstrap draws of {shapes "
    "and seeds}, the same for all settings. Settings that compute the same, as those that differ only in what an "
    "optimisation uses do when an image is rendered, share their times: the median of theirs on each shape.",
)


def make_front(completion: Experiment | None, rendering: Experiment | None) -> Result:
    """Makes the page, with a point per setting: its median error and seconds, and its probability on the front."""
    settings = trials(completion, rendering)
    panels = [place(rows) for rows in settings if rows]
    points = [point for panel in panels for point in panel]
    names = dict.fromkeys(name for point in points for name in _settings(point))
    columns = [*COLUMNS, *(Column(f"renderer.{name}", value=lambda p, n=name: _settings(p).get(n)) for name in names)]
    return Result(
        together(completion, rendering),
        "Error over time.",
        "Median error of each setting over its median time, over {shapes and seeds}.",
        interval="in the CSV, 95 % bootstrap intervals of interquartile means over {shapes and seeds}",
        estimates=[point.row.middle for point in points],
        remarks=(left_out(rendering), sizes(*settings), *NOTES, undefined(point.chance for point in points)),
        data=to_data([*columns, text("resolution", value=lambda point: resolution(point.row.records[0]))], points),
        table=to_table(columns, points),
        figure=draw(panels),
    )


def place(rows: list[Setting]) -> list[Placed]:
    """The points of a trial's settings; infinite values are placed beyond all finite ones."""
    points = np.array([row.point for row in rows])
    finite = np.isfinite(points)
    largest = np.where(finite, points, 0.0).max(axis=0)
    shown = np.where(finite, points, np.where(largest > 0, 1.5 * largest, 1.0))
    beaten = statistics.dominated(*points.T)
    chances = statistics.front([(row.costs, row.errors) for row in rows], seed=SEED)
    return [
        Placed(row, float(x), float(y), infinite=not sound, dominated=bool(inside), chance=chance)
        for row, (x, y), sound, inside, chance in zip(rows, shown, finite.all(axis=1), beaten, chances, strict=True)
    ]


@style.styled
def draw(panels: list[list[Placed]]) -> Figure:
    """Draws a panel per trial."""
    figure, (axes,) = chart.sheet(3.9, 1, len(panels))
    for axis, panel in zip(axes, panels, strict=True):
        _panel(axis, panel)
    for renderer in dict.fromkeys(point.row.renderer for panel in panels for point in panel):
        chart.points(axes[0], renderer, [], [], label=renderer)
    style.legend_below(figure, axes[0], columns=5)
    for axis, panel in zip(axes, panels, strict=True):
        named = [(point.label if point.on_front or point.infinite else "", point.x, point.y) for point in panel]
        chart.name_points(axis, named, size=5.5)
    return figure


def _panel(axis: Axes, panel: list[Placed]) -> None:
    for point in panel:
        how = {"marker": "x"} if point.infinite else {} if point.on_front else {"mfc": "none"}
        chart.points(axis, point.row.renderer, point.x, point.y, ms=5, **how)
        if not point.row.middle.known:
            shapes = [[float(statistics.median(statistics.flat([group]))) for group in groups] for groups in _of(point)]
            chart.points(axis, point.row.renderer, *map(style.finite, shapes), ms=2, alpha=0.5, zorder=1.5)
    line = front_line(panel)
    how = {"where": "post", "color": "#999999", "lw": 0.8, "zorder": 0}
    axis.step([point.x for point in line], [point.y for point in line], **how)
    trial = panel[0].row.trial
    for letter in ("x", "y"):
        style.log_axis(axis, letter, [getattr(point, letter) for point in panel])
    axis.margins(x=0.08, y=0.1)
    axis.set(xlabel="time (seconds)", ylabel=trial.heading, title=trial.title)


def _of(point: Placed) -> tuple[statistics.Groups, statistics.Groups]:
    """The seconds and the errors of a point, per shape."""
    return point.row.costs, point.row.errors


def _settings(point: Placed) -> dict[str, Any]:
    """The renderer's settings."""
    config = point.row.records[0]["config"].get("renderer") or {}
    return {name: value for name, value in config.items() if name[0] != "_"}


def _failed(point: Placed) -> str:
    missing = point.row.missing
    return f"{point.row.failed} of {len(point.row.records)}" + (f", {missing} missing" if missing else "")


COLUMNS = (  # of a point
    text("trial", "Trial", lambda point: point.row.trial.title),
    text("setting", "Setting", lambda point: point.row.name),
    text("renderer", value=lambda point: point.row.renderer),
    Column("seconds", "Time", lambda point: point.row.point[0], format.seconds),
    Column(
        "evaluations",
        "Evaluations",
        lambda p: float(statistics.median(statistics.flat(p.row.evaluations))),
        format.count,
    ),
    Column("error", "Error × 1000", lambda point: point.row.point[1]),
    Column("error_iqm", value=lambda point: point.row.middle.value),
    Column("error_low", value=lambda point: point.row.middle.low),
    Column("error_high", value=lambda point: point.row.middle.high),
    Column("failed", value=lambda point: point.row.failed),
    Column("runs", value=lambda point: len(point.row.records)),
    Column("missing", value=lambda point: point.row.missing),
    shown("Failed", _failed),
    Column("on_front", "P(on the front)", lambda point: point.chance, defined),
    Column("dominated", value=lambda point: point.dominated),
)


def answer_front(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The front of each trial, and its chart."""
    said, panels = [], []
    for title, found in data.groupby("trial", sort=False):
        front = found[~found["dominated"].astype(bool) & np.isfinite(found["seconds"])].sort_values("seconds")
        if len(front):
            ends = [
                f"{row['setting']} (*{format.seconds(row['seconds'])}*, error × 1000 {format.number(row['error'])})"
                for _, row in front.iterrows()
            ]
            rest = f" to {ends[-1]}" if len(ends) > 1 else ""
            said.append(f"{title}: {len(front)} of {len(found)} settings, {ends[0]}{rest}")
        heading = next((trial.heading for trial in TRIALS if trial.title == title), "error × 1000")
        panels.append(chart_panel(title, "time (seconds)", heading, _points(found, front), height=440))
    verdict = f"On the front of {said[0]}." if said else ""
    return Answer("What does accuracy cost in time?", verdict, {"panels": panels, "note": NOTE})


def _points(found: pd.DataFrame, front: pd.DataFrame) -> list[dict[str, Any]]:
    """A series per renderer of what is on the front, one of what is dominated, and the line of the front."""
    drawn = []
    finite = found[np.isfinite(found["seconds"]) & np.isfinite(found["error"])]
    for (renderer, dominated), own in finite.groupby(["renderer", "dominated"], sort=False):
        lines = [_hover(row) for _, row in own.iterrows()]
        links = [runs_of(str(row["setting"])) for _, row in own.iterrows()]
        hollow = {"hollow": True} if bool(dominated) else {}
        drawn.append(
            series(renderer, renderer, own["seconds"], own["error"], text=lines, link=links, size=11, **hollow)
        )
    line = {"colour": "#888888", "symbol": "", "dash": "-", "step": True, "quiet": True}
    return [*drawn, series("front", "", front["seconds"], front["error"], **line)]


def _hover(row: pd.Series) -> list[str]:
    """What the mouse is told of a setting."""
    failed = f"failed {row['failed']:.0f} of {row['runs']:.0f}"
    chance = "" if pd.isna(row["on_front"]) else f"on the front with probability {row['on_front']:.2f}"
    costs = f"{format.seconds(row['seconds'])}, error × 1000 {format.number(row['error'])}"
    return list(filter(None, [str(row["setting"]), costs, failed, chance]))
