"""The stability atlas: where each renderer breaks on each axis, as a table and a heat map; what robustness costs."""

import math
from collections import Counter
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.atlas import Atlas, Cell, atlas, title
from bench.report.caption import counted_outcome, joined, omitted
from bench.report.experiments import Experiment, identity, measured, median_of_known, setting
from bench.report.statistics import rank
from bench.report.tables import Result

CAPTION = (
    "The severity at which half of the trials succeed, with its 95 % interval from the milder end, by an adaptive "
    "search; {trials} trials in all, {share:.0f} % of a full grid's. 'At once' breaks at the mildest severity, 'none' "
    "not at the severest; behind either is how many trials failed there and Wilson's interval of their share. – is a "
    "renderer without that setting. Success: {hits:g} of the true hits within the pixel's footprint and false hits of "
    "at most {false_hits:g} of them; a gradient whose cosine is at least {cosine:g} and whose length is right within "
    "{scale:g}; a fit within {surface_error:g} scene units of the surface. Renderings have {resolution}×{resolution} "
    "pixels. The trial of a number at a severity is the same for every renderer."
)
WORST = 3


def make(experiment: Experiment) -> Result:
    """A line an axis, a column a renderer."""
    grid = atlas(experiment)
    header = ["Axis", "Unit", *grid.rows]
    lines = [[title(axis), grid.unit(axis), *(_told(grid, axis, row) for row in grid.rows)] for axis in grid.axes]
    cells = [cell.record for cell in grid.cells.values()]
    trials, full = (sum(measured(record, name) or 0 for record in cells) for name in ("trials", "grid_trials"))
    return Result(
        name="stability",
        title="Where each renderer breaks.",
        caption=joined(
            CAPTION.format(trials=int(trials), share=100 * trials / max(full, 1), **_asked(experiment)),
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([_raw(grid, axis, row) for axis in grid.axes for row, _ in grid.on(axis)], dtype=object),
        table=pd.DataFrame(lines, columns=header),
        notes=[*(_worst(grid, row) for row in grid.rows), *_theory(grid)],
        figure=draw(grid),
    )


@style.styled
def draw(grid: Atlas) -> Figure:
    """The heat map: dark where a renderer breaks at a mild severity."""
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
    axes.set_xticks(range(len(grid.rows)), grid.rows, rotation=35, ha="left", rotation_mode="anchor")
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


def cost(experiment: Experiment) -> Result:
    """What robustness costs: how each renderer ranks over the axes, and the field values that it asks."""
    grid = atlas(experiment)
    shared = [axis for axis in grid.axes if grid.measure(axis) == "rendering" and _can_all(grid, axis)]
    ranks = rank({row: {axis: _error(grid, axis, row) for axis in shared} for row in grid.rows})
    rows = [{**_cost(grid, row, shared), "rank": ranks[row]} for row in grid.rows]
    told = [
        [r["row"], format.number(r["rank"]), str(r["at_once"]), str(r["never"]), format.number(r["cost"])] for r in rows
    ]
    return Result(
        name="stability_cost",
        title="What robustness costs.",
        caption=joined(
            f"Over the {len(shared)} axes that judge renderings and that every renderer has settings for: the mean "
            "rank of the breakdowns, 1 the best, where equal ones share their mean rank and a run that did not end ok, "
            "or is missing, has the worst; on how many axes it breaks at the mildest severity, and on how many not "
            "even at the severest; the median over axes of the field values a ray at the mild end.",
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame(rows, dtype=object),
        table=pd.DataFrame(told, columns=["Renderer", "Mean rank", "At once", "None", "Field values a ray"]),
        figure=draw_cost(rows),
    )


@style.styled
def draw_cost(rows: list[dict[str, Any]]) -> Figure:
    """The mean rank over the field values a ray."""
    figure = Figure(figsize=(style.WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    for row in rows:
        look = style.look(row["row"])
        axes.plot(row["cost"], row["rank"], marker=look.marker, color=look.colour, ls="none", label=row["row"], ms=7)
    style.log_axis(axes, "x", [row["cost"] for row in rows])
    axes.set(xlabel="field values a ray at the mild end, median over axes", ylabel="mean rank over axes (1 is best)")
    axes.set_ylim(len(rows) + 0.5, 0.5)
    figure.legend(loc="outside right upper")
    return figure


def _cost(grid: Atlas, row: str, axes: list[str]) -> dict[str, Any]:
    cells = [cell for axis in axes if (cell := grid.cells.get((axis, row))) is not None]
    right = [cell for cell in cells if not cell.at_once]  # what breaks there may be cheap because it finds nothing
    cost = median_of_known(measured(cell.record, "evaluations_per_ray") for cell in right)
    ends = {"at_once": sum(cell.at_once for cell in cells), "never": sum(cell.never for cell in cells)}
    return {"row": row, "axes": len(cells), **ends, "cost": math.nan if cost is None else cost}


def _can_all(grid: Atlas, axis: str) -> bool:
    """Whether no renderer lacks what an axis asks for."""
    return not any(cell.unsupported for _, cell in grid.on(axis))


def _error(grid: Atlas, axis: str, row: str) -> float | None:
    """What is ranked: how early it breaks; None where the run did not end ok, or is missing."""
    cell = grid.cells.get((axis, row))
    return None if cell is None or not cell.known else 1.0 - cell.shade


def _asked(experiment: Experiment) -> dict[str, Any]:
    """What counts as success, and the pixels of a rendering, as the runs were asked."""
    names = ("hits", "false_hits", "cosine", "scale", "surface_error")
    criteria = {name: float(setting(experiment.asked(), "task", "criteria", name) or math.nan) for name in names}
    return {**criteria, "resolution": setting(experiment.asked(), "task", "resolution")}


def _told(grid: Atlas, axis: str, row: str) -> str:
    cell = grid.cells.get((axis, row))
    return cell.told() if cell is not None else ""


def _shade(grid: Atlas, axis: str, row: str) -> float:
    cell = grid.cells.get((axis, row))
    return cell.shade if cell is not None else math.nan


def _worst(grid: Atlas, row: str) -> str:
    """A row's mildest breakdowns, runs that did not end ok first, and how its trials failed."""
    cells = [(axis, cell) for axis in grid.axes if (cell := grid.cells.get((axis, row))) and not cell.unsupported]
    worst = sorted(cells, key=lambda item: (item[1].level if item[1].known else -math.inf, item[0]))[:WORST]
    told = [f"{title(axis)} {cell.told()}{' ' + grid.unit(axis) if cell.known else ''}" for axis, cell in worst]
    kinds: Counter[str] = Counter()
    for cell in grid.of(row):
        kinds.update(cell.failures())
    failed = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
    return f"{row}: worst on {'; '.join(told) or 'no axis'}. Failed trials: {failed or 'none'}."


def _theory(grid: Atlas) -> list[str]:
    """A line an axis that has a theory: predicted and measured."""
    lines = []
    for axis in grid.axes:
        told = [
            f"{row} {format.number(predicted)}{'' if cell.covers(predicted) else ' (outside)'}, measured {cell.told()}"
            for row, cell in grid.on(axis)
            if cell.known and (predicted := measured(cell.record, "predicted")) is not None
        ]
        if told:
            lines.append(f"Predicted, {title(axis)}: {'; '.join(told)}.")
    return lines


def _raw(grid: Atlas, axis: str, row: str) -> dict[str, Any]:
    cell: Cell = grid.cells[axis, row]
    numbers = {name: value for name, value in cell.record["metrics"].items() if not name.startswith("failed_")}
    kinds = "; ".join(f"{count} {kind}" for kind, count in cell.failures().items())
    told = {"axis": axis, "group": grid.group(axis), "unit": grid.unit(axis), **identity(cell.record)}
    return {**told, **numbers, "failures": kinds}
