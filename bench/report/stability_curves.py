"""The stability atlas as curves: the share of trials that succeed over the severity, and what theory predicts."""

import json
import math
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report import style
from bench.report.atlas import Atlas, Cell, atlas, title
from bench.report.caption import joined, omitted
from bench.report.experiments import Experiment, measured, setting
from bench.report.statistics import wilson
from bench.report.tables import Result

COLUMNS = 4
LAPSE = 0.02  # that the search allows for: a trial that fails, or succeeds, whatever its level
CAPTION = (
    "The chance of success over the severity, mild to severe from left to right: the logistic curve of the most "
    "probable breakdown and width. Dots are shares of the trials at a severity; the CSV has their number and Wilson's "
    "intervals. Bars about the middle are the 95 % intervals of the breakdowns. Renderers stand a little above one "
    "another, so that none hides another. A dashed line is the severity at which theory has the renderer of its colour "
    "break, a dotted one that of a second formula, as published: DIST, Eqs. 8 and 10."
)


def make(experiment: Experiment) -> Result:
    """A panel an axis, a line a renderer."""
    grid = atlas(experiment)
    shares = {key: _shares(experiment, cell.record) for key, cell in grid.cells.items() if cell.known}
    data = [
        {"axis": axis, "row": row, **share.to_dict()}
        for (axis, row), table in shares.items()
        for _, share in table.iterrows()
    ]
    return Result(
        name="stability_curves",
        title="How success gives way.",
        caption=joined(CAPTION, omitted(experiment)),
        data=pd.DataFrame(data, dtype=object),
        figure=draw(grid, shares),
    )


@style.styled
def draw(grid: Atlas, shares: dict[tuple[str, str], pd.DataFrame]) -> Figure:
    """Panels in four columns, with one legend."""
    lines = -(-len(grid.axes) // COLUMNS)
    figure = Figure(figsize=(style.WIDTH, 1.35 * lines + 1.0), layout="constrained")
    panels = np.atleast_2d(figure.subplots(lines, COLUMNS, squeeze=False)).ravel()
    for panel, axis in zip(panels, grid.axes, strict=False):
        _panel(panel, grid, axis, shares)
    for panel in panels[len(grid.axes) :]:
        panel.set_visible(False)
    handles = style.labelled(*panels)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    return figure


def _panel(panel: Axes, grid: Atlas, axis: str, shares: dict[tuple[str, str], pd.DataFrame]) -> None:
    drawn = [(row, cell, shares[axis, row]) for row, cell in grid.on(axis) if len(shares.get((axis, row), ()))]
    for place, (row, cell, table) in enumerate(drawn):
        look = style.look(row)
        beside = 0.7 * (place - (len(drawn) - 1) / 2)  # per cent, so that equal curves do not hide each other
        panel.plot(table["severity"], 100 * table["share"] + beside, look.marker, color=look.colour, ms=1.5, alpha=0.5)
        levels = np.linspace(0, 1, 200)
        along = [cell.severity(level) for level in levels]
        panel.plot(along, 100 * _chance(levels, cell) + beside, color=look.colour, lw=1, ls=look.line, label=row)
        ends = [measured(cell.record, f"level_{end}") for end in ("low", "high")]
        if None not in ends:
            low, high = (cell.severity(min(max(end, 0.0), 1.0)) for end in ends)
            panel.plot([low, high], [50 + 4 * beside] * 2, color=look.colour, lw=2, solid_capstyle="butt")
        for name, line in (("predicted", "--"), ("predicted_1", ":")):
            if (predicted := measured(cell.record, name)) is not None:
                panel.axvline(predicted, color=look.colour, ls=line, lw=0.6)
    panel.set_title(title(axis), fontsize=7, pad=2)
    if not drawn:
        style.bare(panel)
        panel.text(0.5, 0.5, "no run", ha="center", va="center", transform=panel.transAxes)
        return
    sweep = drawn[0][1]
    mild, severe = sweep.severity(0.0), sweep.severity(1.0)
    if setting(sweep.record["config"], "task", "stress", "sweep", "log"):
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


def _chance(levels: np.ndarray, cell: Cell) -> np.ndarray:
    """The logistic curve through the breakdown, as the search has it."""
    apart = (levels - (cell.level or 0.0)) / (measured(cell.record, "width") or 0.01)
    return LAPSE + (1 - 2 * LAPSE) / (1 + np.exp(np.clip(apart, -50, 50)))


def _shares(experiment: Experiment, record: dict[str, Any]) -> pd.DataFrame:
    """Successes, trials, their share and its interval for each level that was tried, mild to severe."""
    counts: dict[float, list[Any]] = {}
    try:
        text = (experiment.folder(record) / "curve.jsonl").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    for line in text.splitlines():
        try:
            trial = json.loads(line)
            own = counts.setdefault(float(trial["level"]), [float(trial["severity"]), 0, 0])
        except (ValueError, KeyError, TypeError):
            continue
        own[1] += bool(trial.get("success"))
        own[2] += 1
    rows = []
    for level, (severity, successes, n) in sorted(counts.items()):
        if math.isfinite(severity):
            rate = wilson(successes, n)
            rows.append([level, severity, successes, n, rate.value, rate.low, rate.high])
    return pd.DataFrame(rows, columns=["level", "severity", "successes", "trials", "share", "low", "high"])
