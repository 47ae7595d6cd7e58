"""The stress test as curves: the share of successful trials over the severity, and theoretical predictions."""

import json
import math

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.atlas import STABILITY, Atlas, Cell, atlas, title
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, Row, measured
from bench.report.data.statistics import wilson
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, text, to_data

PLACE = 140
READS = (STABILITY,)
PANELS = 4  # in a line of the figure
SHARES = ("level", "severity", "successes", "trials", "share", "low", "high")
COLUMNS = (text("axis"), text("row"), *(Column(name) for name in SHARES))
NOTES = (
    "Curves are logistic, with the most probable breakdown and width. Dots are shares of the trials at a severity; the "
    "CSV has their number and Wilson's intervals. Renderers are shifted a little upwards, so that none hides another.",
    "A dashed line is the predicted breakdown of the renderer of its colour, a dotted one that of a second formula, as "
    "published: DIST, Eqs. 8 and 10.",
)
Shares = dict[tuple[str, Row], pd.DataFrame]


def make(experiment: Experiment) -> Result:
    """Makes the page, with a panel per axis and a line per renderer."""
    grid = atlas(experiment)
    shares = {key: _shares(experiment, cell.record) for key, cell in grid.cells.items() if cell.known}
    lines = [
        {"axis": axis, "row": row.name, **share}
        for (axis, row), table in shares.items()
        for share in table.astype(object).to_dict("records")
    ]
    return Result(
        title="Probability of success over severity.",
        **captioned(
            experiment,
            "Probability of success over the severity, mild to severe from left to right.",
            n=f"{len(grid.axes)} axes and {len(grid.rows)} renderers",
            interval="bars at 50 %: 95 % credible intervals of the breakdowns",
            notes=NOTES,
            parts=("machine",),
        ),
        data=to_data(COLUMNS, lines),
        figure=draw(grid, shares),
    )


@style.styled
def draw(grid: Atlas, shares: Shares) -> Figure:
    """Draws panels in four columns, with one legend."""
    lines = -(-len(grid.axes) // PANELS)
    figure = Figure(figsize=(style.WIDTH, 1.35 * lines + 1.0), layout="constrained")
    panels = np.atleast_2d(figure.subplots(lines, PANELS, squeeze=False)).ravel()
    for panel, axis in zip(panels, grid.axes, strict=False):
        _panel(panel, grid, axis, shares)
    for panel in panels[len(grid.axes) :]:
        panel.set_visible(False)
    style.legend_below(figure, *panels)
    return figure


def _panel(panel: Axes, grid: Atlas, axis: str, shares: Shares) -> None:
    drawn = [(row, cell, shares[axis, row]) for row, cell in grid.on(axis) if len(shares.get((axis, row), ()))]
    for place, (row, cell, table) in enumerate(drawn):
        _curve(panel, row, cell, table, 0.7 * (place - (len(drawn) - 1) / 2))
    panel.set_title(title(axis), fontsize=7, pad=2)
    if not drawn:
        style.bare(panel)
        panel.text(0.5, 0.5, "no run", ha="center", va="center", transform=panel.transAxes)
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
    look = style.look(row.preset)
    panel.plot(table["severity"], 100 * table["share"] + above, look.marker, color=look.colour, ms=1.5, alpha=0.5)
    levels, along = np.linspace(0, 1, 200), (np.geomspace if cell.log else np.linspace)(*cell.ends, 200)
    apart = (levels - (cell.level or 0.0)) / (measured(cell.record, "width") or 0.01)
    chance = 1 / (1 + np.exp(np.clip(apart, -50, 50)))
    panel.plot(along, 100 * chance + above, color=look.colour, lw=1, ls=look.line, label=row.name)
    if None not in [measured(cell.record, f"level_{end}") for end in ("low", "high")]:
        ends = [np.interp(measured(cell.record, f"level_{end}"), levels, along) for end in ("low", "high")]
        panel.plot(ends, [50 + 4 * above] * 2, color=look.colour, lw=2, solid_capstyle="butt")
    for name, line in (("predicted", "--"), ("predicted_1", ":")):
        if (predicted := measured(cell.record, name)) is not None:
            panel.axvline(predicted, color=look.colour, ls=line, lw=0.6)


def _shares(experiment: Experiment, record: Record) -> pd.DataFrame:
    """Successes, trials, their share and its interval for each level that was tried, mild to severe."""
    counts: dict[float, list[float]] = {}
    try:
        text = (experiment.folder(record) / "curve.jsonl").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    for line in text.splitlines():
        try:
            trial = json.loads(line)
            entry = counts.setdefault(float(trial["level"]), [float(trial["severity"]), 0, 0])
        except (ValueError, KeyError, TypeError):
            continue
        entry[1] += bool(trial.get("success"))
        entry[2] += 1
    rows = []
    for level, (severity, successes, n) in sorted(counts.items()):
        if math.isfinite(severity):
            rate = wilson(successes, n)
            rows.append([level, severity, successes, n, rate.value, rate.low, rate.high])
    return pd.DataFrame(rows, columns=SHARES)
