"""The breakdown of each renderer on each axis of the stress test, as a table and a heat map; and robustness over cost.

Robustness is a renderer's mean rank over the axes, cost its number of field values per ray.
"""

import math
from collections import Counter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment
from bench.report.data.records import Row, median_of_known, setting
from bench.report.data.statistics import rank
from bench.report.data.subjects.atlas import FAILED, STABILITY, Atlas, atlas, title
from bench.report.write import chart
from bench.report.write.answer import Answer, chart_panel, presets_of, series
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, PRESET, Column, defined, shown, text, through, to_data, to_table

PLACE = 120
PLACE_COST = 130
READS = (STABILITY,)
NOTES = (
    "The adaptive search makes {share:.0f} % of a full grid's trials; every renderer gets the same trials at a "
    "severity. Renderings have {resolution}×{resolution} pixels.",
    "“At once”: breaks at the mildest severity; “none”: does not break at the severest; both with the number of failed "
    "trials there and the interval of their share (Clopper and Pearson). “Rises”: more trials succeed at the severest "
    "than at the mildest severity, so that none is a breakdown. – is a renderer without that setting.",
    "“One trial”: repeats could not differ there, so that each severity was tried once and there is no interval; the "
    "breakdown lies between two neighbouring severities.",
    "Where a disturbance moves the surface, renderers are judged by the moved surface.",
    "Success: {hits:g} of the true hits within the pixel's footprint and false hits of at most {false_hits:g} of them; "
    "a gradient whose cosine is at least {cosine:g} and whose relative length is within {scale:g} of 1; a fit within "
    "{surface_error:g} scene units of the surface.",
)
COST_NOTES = (
    "Axes: the {axes} that evaluate renderings and that every renderer supports. Where a disturbance moves the "
    "surface, its effect on the method is ranked, not that on the surface. Rank 1 is the best; equal breakdowns share "
    "their mean rank; a run that did not end ok, or is missing, has the worst.",
    "At once: number of axes on which it breaks at the mildest severity; none: on which it does not break at the "
    "severest.",
)
CRITERIA = ("hits", "false_hits", "cosine", "scale", "surface_error")
WORST = 3
COLUMNS = (  # of an axis and a cell
    text("axis", value=lambda line: line[0]),
    text("group", value=lambda line: str(line[1].stress("group"))),
    text("unit", value=lambda line: str(line[1].stress("sweep", "unit"))),
    text("short", value=lambda line: line[1].short()),
    text("full", value=lambda line: line[1].full(line[1].stress("sweep", "unit"))),
    *through(lambda line: line[1].record, *IDENTITY),
)
COSTS = (
    text("row", "Renderer"),
    Column("axes"),
    Column("rank", "Mean rank", show=defined),
    text("at_once", "At once"),
    text("never", "None"),
    Column("cost", "Field values per ray"),
    PRESET,
)
FAILURES = text(
    "failures", value=lambda line: "; ".join(f"{count} {kind}" for kind, count in line[1].failures().items())
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per axis and a column per renderer."""
    grid = atlas(experiment)
    lines = [(axis, cell) for axis in grid.axes for _, cell in grid.on(axis)]
    trials, full = (sum(cell.number(name) or 0 for _, cell in lines) for name in ("trials", "grid_trials"))
    task = experiment.requested().get("task")
    about = {name: float(setting(task, "criteria", name) or math.nan) for name in CRITERIA}
    about |= {"share": 100 * trials / max(full, 1), "resolution": setting(task, "resolution")}
    metrics = dict.fromkeys(name for cell in grid.cells.values() for name in cell.record["metrics"])
    numbers = [
        Column(name, value=lambda line, name=name: line[1].record["metrics"].get(name))
        for name in metrics
        if not name.startswith(FAILED)
    ]
    cells = [shown(row.name, lambda axis, row=row: grid.cell(axis, row).full()) for row in grid.rows]
    return Result(
        experiment,
        "The severity at which each renderer breaks.",
        "The severity at which half of the trials succeed.",
        n=f"{int(trials)} trials in all, of {len(grid.axes)} axes and {len(grid.rows)} renderers",
        interval="95 % credible intervals, the milder end first",
        remarks=[*(note.format(**about) for note in NOTES), *_all_about(grid)],
        data=to_data([*COLUMNS, *numbers, FAILURES], lines),
        table=to_table([shown("Axis", title), shown("Unit", grid.unit), *cells], grid.axes),
        figure=draw(grid),
    )


def make_cost(experiment: Experiment) -> Result:
    """Makes the page, with a line and a point per renderer."""
    grid = atlas(experiment)
    rendered = [axis for axis in grid.axes if grid.stress(axis, "measure") == "rendering"]
    shared = [axis for axis in rendered if not any(cell.unsupported for _, cell in grid.on(axis))]
    # A run that did not end ok, or is missing, has no shade, so it ranks last.
    ranks = rank({row: {axis: 1.0 - grid.cell(axis, row).shade for axis in shared} for row in grid.rows})
    lines = {row: {**_cost(grid, row, shared), "rank": ranks[row]} for row in grid.rows}
    return Result(
        experiment,
        "Robustness over cost.",
        "Mean rank of the breakdowns over the median, over axes, of the field values per ray at the mild end.",
        n=f"{len(shared)} axes and {len(grid.rows)} renderers",
        remarks=[note.format(axes=len(shared)) for note in COST_NOTES],
        data=to_data(COSTS, lines.values()),
        table=to_table(COSTS, lines.values()),
        figure=draw_cost(lines),
    )


@style.styled
def draw(grid: Atlas) -> Figure:
    """Draws the heat map: red where a renderer breaks at a mild severity, blue where it does not break."""
    width = max(style.WIDTH, 0.39 * len(grid.rows) + 2.2)  # inches: a number has room in its cell
    figure, ((axes,),) = chart.sheet(0.19 * len(grid.axes) + 1.7, width=width)
    shades = np.array([[grid.cell(axis, row).shade for row in grid.rows] for axis in grid.axes])
    shown = axes.imshow(np.ma.masked_invalid(shades), cmap="RdYlBu", vmin=0, vmax=1, aspect="auto")
    axes.set_facecolor("#f2f2f2")
    for line, axis in enumerate(grid.axes):
        for row, cell in grid.on(axis):
            words, dark = cell.short(), cell.shade < 0.1 or cell.shade > 0.9
            how = {"color": "white" if dark else "black", "fontsize": 5.5 if len(words) < 8 else 4.5}
            axes.text(grid.rows.index(row), line, words, ha="center", va="center", **how)
    axes.set_xticks(
        range(len(grid.rows)), [row.name for row in grid.rows], rotation=35, ha="left", rotation_mode="anchor"
    )
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(grid.axes)), [f"{title(axis)} ({grid.unit(axis)})" for axis in grid.axes])
    axes.tick_params(length=0, labelsize=6)
    axes.grid(False)
    groups = [grid.stress(axis, "group") for axis in grid.axes]
    for line in range(1, len(groups)):
        if groups[line] != groups[line - 1]:
            axes.axhline(line - 0.5, color="#222222", lw=0.8)
    bar = figure.colorbar(shown, ax=axes, location="bottom", shrink=0.5, aspect=40, pad=0.02)
    bar.set_ticks([0, 1], labels=["breaks at the mildest", "not at the severest"])
    return figure


def _all_about(grid: Atlas) -> list[str]:
    """Notes on each row and on moved surfaces."""
    return [*(_worst(grid, row) for row in grid.rows), _moved(grid)]


def _worst(grid: Atlas, row: Row) -> str:
    """A note on a row's mildest breakdowns, runs that did not end ok first, and on the kinds of its failed trials."""
    cells = [(axis, grid.cells[axis, row]) for axis in grid.axes if (axis, row) in grid.cells]
    tried = [(axis, cell) for axis, cell in cells if not cell.unsupported]
    broken = [(axis, cell) for axis, cell in tried if not cell.never]
    worst = sorted(broken, key=lambda item: (item[1].level if item[1].known else -math.inf, item[0]))[:WORST]
    axes = [f"{title(axis)} {cell.full(grid.unit(axis))}" for axis, cell in worst]
    kinds: Counter[str] = Counter()
    for _, cell in cells:
        kinds.update(cell.failures())
    failed = ", ".join(f"{count} {style.PIXEL_NAMES.get(kind, kind)}" for kind, count in kinds.most_common())
    said = f"worst on {'; '.join(axes)}" if axes else f"breaks on none of {len(tried)} axes"
    return f"{row.name}: {said}. Failed trials: {failed or 'none'}."


def _moved(grid: Atlas) -> str:
    """A note on how far the disturbances moved the surface; empty where none did."""
    parts = []
    for axis in grid.axes:
        moved = [far for _, cell in grid.on(axis) if (far := cell.number("surface_moved")) is not None]
        if moved:
            ends = [format.number(end) for end in dict.fromkeys((min(moved), max(moved)))]
            parts.append(f"{title(axis)} {' to '.join(ends)}")
    return (
        f"Distance by which the surface moved at the breakdowns, in scene units: {'; '.join(parts)}." if parts else ""
    )


@style.styled
def draw_cost(lines: dict[Row, dict[str, Any]]) -> Figure:
    """Draws the mean rank over the field values per ray."""
    figure, ((axes,),) = chart.sheet(3.2)
    places = Counter()
    for row, line in lines.items():
        place = line["cost"], line["rank"]
        chart.points(
            axes, row.preset, *place, label=row.name, ms=7 / (1 + 0.4 * places[place])
        )  # so that none is hidden
        places[place] += 1
    style.log_axis(axes, "x", [line["cost"] for line in lines.values()])
    axes.set(xlabel="field values per ray at the mild end, median over axes", ylabel="mean rank over axes (1 is best)")
    axes.set_ylim(max(place for line in lines.values() for place in (line["rank"], 1) if place == place) + 0.5, 0.5)
    figure.legend(loc="outside right upper")
    return figure


def _cost(grid: Atlas, row: Row, axes: list[str]) -> dict[str, Any]:
    cells = [grid.cells[axis, row] for axis in axes if (axis, row) in grid.cells]
    right = [cell for cell in cells if not cell.at_once]  # a renderer that breaks there may be cheap but find nothing
    cost = median_of_known(cell.number("evaluations_per_ray") for cell in right)
    ends = {"at_once": sum(cell.at_once for cell in cells), "never": sum(cell.never for cell in cells)}
    return {
        "row": row.name,
        "preset": row.preset,
        "axes": len(cells),
        **ends,
        "cost": math.nan if cost is None else cost,
    }


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """How often each renderer does not break, and the atlas as cells."""
    level = data["level"].where(data["status"] == "ok")
    never, known = (
        (level > 1).groupby(data["row"], sort=False).sum(),
        level.notna().groupby(data["row"], sort=False).sum(),
    )
    best, least = never.idxmax(), never.idxmin()
    said = (
        f"{best} does not break on *{never[best]} of {known[best]}* axes, {least} on {never[least]} of {known[least]}"
    )
    return Answer("Where does each renderer break?", f"{said}.", atlas=_cells(data))


def _cells(data: pd.DataFrame) -> dict[str, Any]:
    """The grid for the page: axes, rows, and of each cell its breakdown as text, its shade and its run."""
    axes = [
        {"axis": a, "title": title(a), "group": str(g), "unit": str(u)}
        for a, g, u in data[["axis", "group", "unit"]].drop_duplicates().itertuples(index=False)
    ]
    rows = list(dict.fromkeys(data["row"]))
    found = {(r["axis"], r["row"]): _cell(r) for _, r in data.iterrows()}
    cells = [[found.get((axis["axis"], row)) for row in rows] for axis in axes]
    return {"axes": axes, "rows": rows, "cells": cells}


def _cell(run: pd.Series) -> dict[str, Any]:
    known = run["status"] == "ok" and pd.notna(run["level"])
    told = {name: "" if pd.isna(run[name]) else str(run[name]) for name in ("short", "full", "status", "reason")}
    return told | {"shade": min(max(float(run["level"]), 0.0), 1.0) if known else None, "folder": str(run["folder"])}


def answer_cost(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The most robust renderer and the cheapest."""
    data = data.dropna(subset=["rank", "cost"]).reset_index(drop=True)
    if data.empty:
        return Answer("Is a robust renderer an expensive one?")
    best, cheap = data.loc[data["rank"].idxmin()], data.loc[data["cost"].idxmin()]
    said = (
        f"{best['row']} has the best mean rank, *{format.number(best['rank'])}* of {len(data)}, for "
        f"{format.number(best['cost'])} field values per ray; "
    )
    same = best["row"] == cheap["row"]
    rest = (
        "no renderer is cheaper"
        if same
        else f"{cheap['row']} is the cheapest: rank {format.number(cheap['rank'])} for {format.number(cheap['cost'])}"
    )
    presets, places = presets_of(data), data.groupby(["cost", "rank"]).cumcount()  # later ones smaller: none is hidden
    points = [
        series(row["row"], presets[row["row"]], [row["cost"]], [row["rank"]], size=12 / (1 + 0.4 * places[place]))
        for place, row in data.iterrows()
    ]
    axes = ("field values per ray at the mild end", "mean rank over axes (1 is best)")
    panel = chart_panel("", *axes, points, height=420)
    panel["y"]["reversed"] = True
    return Answer("Is a robust renderer an expensive one?", f"{said}{rest}.", {"panels": [panel]})
