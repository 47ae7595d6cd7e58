"""The stress test as curves: the share of successful trials over the severity."""

import math

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data import curves
from bench.report.data.experiments import Experiment
from bench.report.data.records import Row, grouped
from bench.report.data.statistics import clopper_pearson
from bench.report.data.subjects.atlas import STABILITY, Atlas, Cell, atlas, title
from bench.report.write import chart
from bench.report.write.answer import Answer, chart_panel, presets_of, series
from bench.report.write.result import Result
from bench.report.write.table import PRESET, Column, text, to_data

PLACE = 140
READS = (STABILITY,)
PANELS = 4  # in a line of the figure
SHARES = ("level", "severity", "successes", "trials", "share", "low", "high")
COLUMNS = (text("axis"), text("row"), PRESET, *(Column(name) for name in SHARES))
NOTES = (
    "Curves are logistic, with the most probable breakdown and width. Dots are shares of the trials at a severity; the "
    "CSV has their number and intervals (Clopper and Pearson). Renderers are shifted a little upwards, so that none "
    "hides another. An axis with one trial a level, where repeats could not differ, has no intervals.",
)
Shares = dict[tuple[str, Row], pd.DataFrame]


def make(experiment: Experiment) -> Result:
    """Makes the page, with a panel per axis and a line per renderer."""
    grid = atlas(experiment)
    shares = {key: _shares(experiment, cell) for key, cell in grid.cells.items() if cell.known}
    lines = [
        {"axis": axis, "row": row.name, "preset": row.preset, **share}
        for (axis, row), table in shares.items()
        for share in table.astype(object).to_dict("records")
    ]
    return Result(
        experiment,
        "Probability of success over severity.",
        "Probability of success over the severity, mild to severe from left to right.",
        n=f"{len(grid.axes)} axes and {len(grid.rows)} renderers",
        interval="bars at 50 %: 95 % credible intervals of the breakdowns",
        remarks=NOTES,
        data=to_data(COLUMNS, lines),
        figure=draw(grid, shares),
    )


@style.styled
def draw(grid: Atlas, shares: Shares) -> Figure:
    """Draws panels in four columns, with one legend."""
    lines = -(-len(grid.axes) // PANELS)
    figure, panels = chart.sheet(1.35 * lines + 1.0, lines, PANELS)
    for panel, axis in zip(panels.flat, grid.axes, strict=False):
        _panel(panel, grid, axis, shares)
    for panel in panels.flat[len(grid.axes) :]:
        panel.set_visible(False)
    style.legend_below(figure, *panels.flat)
    return figure


def _panel(panel: Axes, grid: Atlas, axis: str, shares: Shares) -> None:
    drawn = [(row, cell, shares[axis, row]) for row, cell in grid.on(axis) if len(shares.get((axis, row), ()))]
    for place, (row, cell, table) in enumerate(drawn):
        _curve(panel, row, cell, table, 0.7 * (place - (len(drawn) - 1) / 2))
    panel.set_title(title(axis), fontsize=7, pad=2)
    if not drawn:
        chart.say(style.bare(panel), "no run")
        return
    sweep = drawn[0][1]
    mild, severe = sweep.ends
    if sweep.log:
        panel.set_xscale("log")
        reach = (severe / mild) ** 0.05
        panel.set_xlim(mild / reach, severe * reach)
    else:
        panel.set_xlim(mild - 0.05 * (severe - mild), severe + 0.05 * (severe - mild))
    panel.set_xlabel(grid.unit(axis), fontsize=5.5, labelpad=1)
    panel.set_ylim(-12, 112)
    panel.set_yticks([0, 50, 100], ["0 %", "50 %", "100 %"])
    panel.tick_params(labelsize=5.5)
    panel.minorticks_off()


def _curve(panel: Axes, row: Row, cell: Cell, table: pd.DataFrame, above: float) -> None:
    """Draws a renderer's shares, curve and interval, shifted up by some per cent so that equal curves can be seen."""
    colour = style.look(row.preset).colour
    chart.points(panel, row.preset, table["severity"], 100 * table["share"] + above, ms=1.5, alpha=0.5)
    levels, along = np.linspace(0, 1, 200), (np.geomspace if cell.log else np.linspace)(*cell.ends, 200)
    apart = (levels - cell.level) / (cell.number("width") or 0.01)
    chance = 1 / (1 + np.exp(np.clip(apart, -50, 50)))
    chart.line(panel, row.preset, along, 100 * chance + above, marker="", lw=1, label=row.name)
    ends = [cell.number(f"level_{end}") for end in ("low", "high")]
    if None not in ends:
        panel.plot(np.interp(ends, levels, along), [50 + 4 * above] * 2, color=colour, lw=2, solid_capstyle="butt")


def _shares(experiment: Experiment, cell: Cell) -> pd.DataFrame:
    """Successes, trials, their share and its interval for each level that was tried, mild to severe.

    With one trial per level there is no interval.
    """
    lines = curves.lines(experiment.folder(cell.record)) or []
    trials = [t for t in lines if all(isinstance(t.get(name), int | float) for name in ("level", "severity"))]
    rows = []
    for level, tried in sorted(grouped(trials, lambda trial: float(trial["level"])).items()):
        severity, successes = float(tried[0]["severity"]), sum(bool(trial.get("success")) for trial in tried)
        if math.isfinite(severity):
            rate = clopper_pearson(successes / len(tried), len(tried))
            ends = [math.nan, math.nan] if cell.one_trial else [rate.low, rate.high]
            rows.append([level, severity, successes, len(tried), rate.value, *ends])
    return pd.DataFrame(rows, columns=SHARES)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The shares of successes over the severity, a panel per axis."""
    panels, presets = [], presets_of(data)
    for axis, found in data.groupby("axis", sort=False):
        lines = [
            series(row, presets[row], own["severity"], 100 * own["share"], dash="-", size=5, text=_said(own))
            for row, own in found.sort_values("level").groupby("row", sort=False)
        ]
        panels.append(chart_panel(title(axis), "severity", "successes (%)", lines, height=300, axis=axis))
    return Answer("", chart={"panels": panels})


def _said(shares: pd.DataFrame) -> list[str]:
    return [f"{s.successes:.0f} of {s.trials:.0f} succeed at {format.number(s.severity)}" for s in shares.itertuples()]
