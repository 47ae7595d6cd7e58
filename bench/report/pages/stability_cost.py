"""Robustness over cost: each renderer's mean rank over the axes of the stress test, and its field values per ray."""

import math
from typing import Any

from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.atlas import STABILITY, Atlas, atlas
from bench.report.data.experiments import Experiment
from bench.report.data.records import Row, measured, median_of_known
from bench.report.data.statistics import rank
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, text, to_data, to_table

PLACE = 130
READS = (STABILITY,)
NOTES = (
    "Axes: the {axes} that evaluate renderings and that every renderer supports. Rank 1 is the best; equal breakdowns "
    "share their mean rank; a run that did not end ok, or is missing, has the worst.",
    "At once: number of axes on which it breaks at the mildest severity; none: on which it does not break at the "
    "severest.",
)
COLUMNS = (
    text("row", "Renderer"),
    Column("axes"),
    Column("rank", "Mean rank"),
    text("at_once", "At once"),
    text("never", "None"),
    Column("cost", "Field values per ray"),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line and a point per renderer."""
    grid = atlas(experiment)
    shared = [axis for axis in grid.axes if grid.stress(axis, "measure") == "rendering" and _can_all(grid, axis)]
    ranks = rank({row: {axis: _error(grid, axis, row) for axis in shared} for row in grid.rows})
    lines = {row: {**_cost(grid, row, shared), "rank": ranks[row]} for row in grid.rows}
    return Result(
        title="Robustness over cost.",
        **captioned(
            experiment,
            "Mean rank of the breakdowns over the median, over axes, of the field values per ray at the mild end.",
            n=f"{len(shared)} axes and {len(grid.rows)} renderers",
            notes=[note.format(axes=len(shared)) for note in NOTES],
            parts=("machine",),
        ),
        data=to_data(COLUMNS, lines.values()),
        table=to_table(COLUMNS, lines.values()),
        figure=draw(lines),
    )


@style.styled
def draw(lines: dict[Row, dict[str, Any]]) -> Figure:
    """Draws the mean rank over the field values per ray."""
    figure = Figure(figsize=(style.WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    for row, line in lines.items():
        look = style.look(row.preset)
        axes.plot(line["cost"], line["rank"], marker=look.marker, color=look.colour, ls="none", label=row.name, ms=7)
    style.log_axis(axes, "x", [line["cost"] for line in lines.values()])
    axes.set(xlabel="field values per ray at the mild end, median over axes", ylabel="mean rank over axes (1 is best)")
    axes.set_ylim(len(lines) + 0.5, 0.5)
    figure.legend(loc="outside right upper")
    return figure


def _cost(grid: Atlas, row: Row, axes: list[str]) -> dict[str, Any]:
    cells = [cell for axis in axes if (cell := grid.cells.get((axis, row))) is not None]
    right = [cell for cell in cells if not cell.at_once]  # a renderer that breaks there may be cheap but find nothing
    cost = median_of_known(measured(cell.record, "evaluations_per_ray") for cell in right)
    ends = {"at_once": sum(cell.at_once for cell in cells), "never": sum(cell.never for cell in cells)}
    return {"row": row.name, "axes": len(cells), **ends, "cost": math.nan if cost is None else cost}


def _can_all(grid: Atlas, axis: str) -> bool:
    """Whether all renderers support an axis."""
    return not any(cell.unsupported for _, cell in grid.on(axis))


def _error(grid: Atlas, axis: str, row: Row) -> float | None:
    """The ranked value: 1 minus the level of the breakdown; None where the run did not end ok, or is missing."""
    cell = grid.cells.get((axis, row))
    return None if cell is None or not cell.known else 1.0 - cell.shade
