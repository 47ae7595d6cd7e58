"""The stability atlas as curves: the share of trials that succeed over the severity, and what theory predicts."""

import json
import math
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report import style
from bench.report.atlas import Atlas, atlas, title
from bench.report.caption import joined, omitted
from bench.report.experiments import Experiment, measured
from bench.report.statistics import wilson
from bench.report.tables import Result

COLUMNS = 4
MOST_BARS = 4  # rows with bars of their intervals in a panel; with more they would hide each other
CAPTION = (
    "The share of trials that succeed over the severity, mild to severe from left to right, where the search made "
    "them; bars are Wilson's 95 % intervals (in panels of at most {most} renderers; else the CSV has them). Lines lead "
    "through each renderer's shares; a vertical dashed line of its colour is the severity at which theory has it break."
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
        caption=joined(CAPTION.format(most=MOST_BARS), omitted(experiment)),
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
    handles = {label: h for p in panels for h, label in zip(*p.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
    return figure


def _panel(panel: Axes, grid: Atlas, axis: str, shares: dict[tuple[str, str], pd.DataFrame]) -> None:
    drawn = [(row, cell, shares[axis, row]) for row, cell in grid.on(axis) if len(shares.get((axis, row), ()))]
    for place, (row, cell, table) in enumerate(drawn):
        look = style.look(row)
        beside = 1.5 * (place - (len(drawn) - 1) / 2)  # per cent, so that equal lines do not hide each other
        share = 100 * table["share"] + beside
        how: dict[str, Any] = {"color": look.colour, "marker": look.marker, "ms": 2.5, "lw": 0.9, "label": row}
        if len(drawn) <= MOST_BARS:
            bars = np.maximum([share - 100 * table["low"], 100 * table["high"] - share], 0)
            panel.errorbar(table["severity"], share, bars, elinewidth=0.5, **how)
        else:
            panel.plot(table["severity"], share, **how)
        predicted = measured(cell.record, "predicted")
        if predicted is not None:
            panel.axvline(predicted, color=look.colour, ls="--", lw=0.7)
    if not drawn:
        panel.text(0.5, 0.5, "no run", ha="center", va="center", transform=panel.transAxes)
        return
    sweep = drawn[0][1]
    mild, severe = sweep.severity(0.0), sweep.severity(1.0)
    if sweep.record["config"]["task"]["stress"]["sweep"]["log"]:
        panel.set_xscale("log")
        reach = (severe / mild) ** 0.05
        panel.set_xlim(mild / reach, severe * reach)
    else:
        panel.set_xlim(mild - 0.05 * (severe - mild), severe + 0.05 * (severe - mild))
    panel.set_title(title(axis), fontsize=7, pad=2)
    panel.set_xlabel(grid.unit(axis), fontsize=5.5, labelpad=1)
    panel.set_ylim(-12, 112)
    panel.set_yticks([0, 50, 100])
    panel.tick_params(labelsize=5.5)
    panel.minorticks_off()


def _shares(experiment: Experiment, record: dict[str, Any]) -> pd.DataFrame:
    """Successes, trials, their share and its interval for each level that was tried, mild to severe."""
    counts: dict[int, list[Any]] = {}
    try:
        text = (experiment.folder(record) / "curve.jsonl").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    for line in text.splitlines():
        try:
            trial = json.loads(line)
            own = counts.setdefault(int(trial["level"]), [float(trial["severity"]), 0, 0])
        except (ValueError, KeyError, TypeError):
            continue
        own[1] += bool(trial.get("success"))
        own[2] += 1
    rows = []
    for _, (severity, successes, n) in sorted(counts.items()):
        if not math.isfinite(severity):
            continue
        rate = wilson(successes, n)
        rows.append([severity, successes, n, rate.value, rate.low, rate.high])
    return pd.DataFrame(rows, columns=["severity", "successes", "trials", "share", "low", "high"])
