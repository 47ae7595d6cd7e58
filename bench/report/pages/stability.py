"""The breakdown of each renderer on each axis of the stress test, as a table and a heat map."""

import math
from collections import Counter
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.atlas import STABILITY, Atlas, Cell, atlas, title
from bench.report.data.experiments import Experiment
from bench.report.data.records import Row, measured, setting
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, shown, text, through, to_data, to_table

PLACE = 120
READS = (STABILITY,)
NOTES = (
    "The adaptive search makes {share:.0f} % of a full grid's trials; every renderer gets the same trials at a "
    "severity. Renderings have {resolution}×{resolution} pixels.",
    "“At once”: breaks at the mildest severity; “none”: does not break at the severest; both with the number of failed "
    "trials there and Wilson's interval of their share. – is a renderer without that setting.",
    "Success: {hits:g} of the true hits within the pixel's footprint and false hits of at most {false_hits:g} of them; "
    "a gradient whose cosine is at least {cosine:g} and whose relative length is within {scale:g} of 1; a fit within "
    "{surface_error:g} scene units of the surface.",
)
WORST = 3


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per axis and a column per renderer."""
    grid = atlas(experiment)
    lines = [(grid, axis, row) for axis in grid.axes for row, _ in grid.on(axis)]
    cells = [grid.cells[axis, row].record for _, axis, row in lines]
    trials, full = (sum(measured(record, name) or 0 for record in cells) for name in ("trials", "grid_trials"))
    about = {"share": 100 * trials / max(full, 1), **_criteria(experiment)}
    columns = [
        shown("Axis", title),
        shown("Unit", grid.unit),
        *(shown(row.name, lambda axis, row=row: _full(grid, axis, row)) for row in grid.rows),
    ]
    return Result(
        title="The severity at which each renderer breaks.",
        **captioned(
            experiment,
            "The severity at which half of the trials succeed.",
            n=f"{int(trials)} trials in all, of {len(grid.axes)} axes and {len(grid.rows)} renderers",
            interval="95 % credible intervals, the milder end first",
            notes=(
                *(note.format(**about) for note in NOTES),
                *(_worst(grid, row) for row in grid.rows),
                *_theory(grid),
            ),
            parts=("machine",),
        ),
        data=to_data([*COLUMNS, *_measured(grid), FAILURES], lines),
        table=to_table(columns, grid.axes),
        figure=draw(grid),
    )


def _cell(line: tuple[Atlas, str, Row]) -> Cell:
    grid, axis, row = line
    return grid.cells[axis, row]


def _measured(grid: Atlas) -> list[Column]:
    """A column for each metric of the cells, except the failures."""
    metrics = dict.fromkeys(name for cell in grid.cells.values() for name in cell.record["metrics"])
    names = [name for name in metrics if not name.startswith("failed_")]
    return [Column(name, value=lambda line, name=name: _cell(line).record["metrics"].get(name)) for name in names]


COLUMNS = (  # of the grid, an axis and a row
    text("axis", value=lambda line: line[1]),
    text("group", value=lambda line: line[0].group(line[1])),
    text("unit", value=lambda line: line[0].unit(line[1])),
    *through(lambda line: _cell(line).record, *IDENTITY),
)
FAILURES = text(
    "failures", value=lambda line: "; ".join(f"{count} {kind}" for kind, count in _cell(line).failures().items())
)


@style.styled
def draw(grid: Atlas) -> Figure:
    """Draws the heat map: red where a renderer breaks at a mild severity, green where it does not break."""
    figure = Figure(figsize=(style.WIDTH, 0.19 * len(grid.axes) + 1.7), layout="constrained")
    axes = figure.subplots()
    shades = np.array([[_shade(grid, axis, row) for row in grid.rows] for axis in grid.axes])
    shown = axes.imshow(np.ma.masked_invalid(shades), cmap="RdYlGn", vmin=0, vmax=1, aspect="auto")
    axes.set_facecolor("#f2f2f2")
    for line, axis in enumerate(grid.axes):
        for column, row in enumerate(grid.rows):
            cell = grid.cells.get((axis, row))
            if cell is not None:
                ink = "white" if cell.shade in (0.0, 1.0) else "black"
                axes.text(column, line, cell.short(), ha="center", va="center", fontsize=5.5, color=ink)
    axes.set_xticks(
        range(len(grid.rows)), [row.name for row in grid.rows], rotation=35, ha="left", rotation_mode="anchor"
    )
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(grid.axes)), [f"{title(axis)} ({grid.unit(axis)})" for axis in grid.axes])
    axes.tick_params(length=0, labelsize=6)
    axes.grid(False)
    groups = [grid.group(axis) for axis in grid.axes]
    for line in range(1, len(groups)):
        if groups[line] != groups[line - 1]:
            axes.axhline(line - 0.5, color="#222222", lw=0.8)
    bar = figure.colorbar(shown, ax=axes, location="bottom", shrink=0.5, aspect=40, pad=0.02)
    bar.set_ticks([0, 1], labels=["breaks at the mildest", "not at the severest"])
    return figure


def _criteria(experiment: Experiment) -> dict[str, Any]:
    """The criteria of success, and the resolution of a rendering."""
    names = ("hits", "false_hits", "cosine", "scale", "surface_error")
    config = experiment.requested()
    criteria = {name: float(setting(config, "task", "criteria", name) or math.nan) for name in names}
    return {**criteria, "resolution": setting(config, "task", "resolution")}


def _full(grid: Atlas, axis: str, row: Row) -> str:
    cell = grid.cells.get((axis, row))
    return cell.full() if cell is not None else ""


def _shade(grid: Atlas, axis: str, row: Row) -> float:
    cell = grid.cells.get((axis, row))
    return cell.shade if cell is not None else math.nan


def _worst(grid: Atlas, row: Row) -> str:
    """A note on a row's mildest breakdowns, runs that did not end ok first, and on the kinds of its failed trials."""
    cells = [(axis, cell) for axis, cell in grid.of(row) if not cell.unsupported]
    worst = sorted(cells, key=lambda item: (item[1].level if item[1].known else -math.inf, item[0]))[:WORST]
    axes = [f"{title(axis)} {cell.full()}{' ' + grid.unit(axis) if cell.known else ''}" for axis, cell in worst]
    kinds: Counter[str] = Counter()
    for _, cell in grid.of(row):
        kinds.update(cell.failures())
    failed = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    return f"{row.name}: worst on {'; '.join(axes) or 'no axis'}. Failed trials: {failed or 'none'}."


def _theory(grid: Atlas) -> list[str]:
    """A note per axis with a theoretical prediction: the predicted and the measured breakdown of each row."""
    lines = []
    for axis in grid.axes:
        rows = [
            f"{row.name} {format.number(predicted)}{'' if cell.covers(predicted) else ' (outside)'}, "
            f"measured {cell.full()}"
            for row, cell in grid.on(axis)
            if cell.known and (predicted := measured(cell.record, "predicted")) is not None
        ]
        if rows:
            lines.append(f"Predicted, {title(axis)}: {'; '.join(rows)}.")
    return lines
