"""The Pareto front of error and time, with each setting's probability to be on it."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data import statistics
from bench.report.data.experiments import Experiment, together
from bench.report.data.speed import SEED, TRIALS, Placed, Setting, front_line, left_out, resolution, settings, sizes
from bench.report.write import interactive
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, shown, text, to_data, to_table

PLACE = 80
READS = tuple(trial.selection for trial in TRIALS)
NOTES = (
    "Final error of a completion over the seconds of its loop, and depth error of one rendering (95th percentile over "
    "pixels, missed and spurious ones count as infinite) over its seconds. A run that did not end ok is infinite in "
    "both; so is a run that others have and a setting lacks.",
    "Filled points are on the front, hollow ones are dominated, and a cross at the edge is an infinite median.",
    "In brackets and in the last column: the probability of being on the front, over 2,000 bootstrap draws of shapes "
    "and seeds, the same for all settings. Settings that differ only in what an optimisation uses have equal "
    "renderings; noise in the times decides between them.",
)


def make(completion: Experiment | None, rendering: Experiment | None) -> Result:
    """Makes the page, with a point per setting: its median error and seconds, and its probability on the front."""
    trials = [settings(runs, trial) for runs, trial in zip((completion, rendering), TRIALS, strict=True)]
    panels = [place(rows) for rows in trials if rows]
    points = [point for panel in panels for point in panel]
    names = dict.fromkeys(name for point in points for name in _settings(point))
    columns = [*COLUMNS, *(Column(f"renderer.{name}", value=lambda p, n=name: _settings(p).get(n)) for name in names)]
    return Result(
        title="Error over time.",
        **captioned(
            together(completion, rendering),
            "Median error of each setting over its median time, over shapes and seeds.",
            interval="in the CSV, 95 % bootstrap intervals of interquartile means over shapes and seeds",
            notes=(left_out(rendering), sizes(*trials), *NOTES),
        ),
        data=to_data([*columns, text("resolution", value=lambda point: resolution(point.row.records[0]))], points),
        table=to_table(columns, points),
        figure=draw(panels),
        page=interactive.front(panels),
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
    figure = Figure(figsize=(style.WIDTH, 3.9), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, panel in zip(axes, panels, strict=True):
        _panel(axis, panel)
    for renderer in dict.fromkeys(point.row.renderer for panel in panels for point in panel):
        look = style.look(renderer)
        axes[0].plot([], [], look.marker, color=look.colour, ls="none", label=renderer)
    style.legend_below(figure, axes[0], columns=5)
    return figure


def _panel(axis: Axes, panel: list[Placed]) -> None:
    middle = np.exp(np.mean(np.log([min(point.x for point in panel), max(point.x for point in panel)])))
    for number, point in enumerate(sorted(panel, key=lambda point: point.x)):
        look = style.look(point.row.renderer)
        how = {"color": look.colour, "mfc": look.colour if point.on_front else "none", "ls": "none", "ms": 5}
        axis.plot(point.x, point.y, "x" if point.infinite else look.marker, **how)
        words = {"textcoords": "offset points", "fontsize": 5.5}
        if point.infinite:
            axis.annotate(point.label, (point.x, point.y), (2, 4), rotation=30, **words)
        elif point.on_front:
            side = "left" if point.x < middle else "right"
            at = (4 if side == "left" else -4, 4 if number % 2 else -8)
            axis.annotate(point.label, (point.x, point.y), at, ha=side, **words)
    line = front_line(panel)
    how = {"where": "post", "color": "#999999", "lw": 0.8, "zorder": 0}
    axis.step([point.x for point in line], [point.y for point in line], **how)
    trial = panel[0].row.trial
    for letter in ("x", "y"):
        style.log_axis(axis, letter, [getattr(point, letter) for point in panel])
    axis.margins(x=0.08, y=0.1)
    axis.set(xlabel="time (seconds)", ylabel=trial.heading, title=trial.title)


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
        lambda p: float(statistics.median(np.concatenate(p.row.evaluations))),
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
    Column("on_front", "P(on the front)", lambda point: point.chance),
    Column("dominated", value=lambda point: point.dominated),
)
