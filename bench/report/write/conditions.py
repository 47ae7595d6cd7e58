"""The figure of runs under conditions of which one varies at a time: the error over its value, by family and method."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.conditions import Cell, Conditions
from bench.report.data.records import Row, grouped
from bench.report.data.statistics import Interval
from bench.report.write import chart


@style.styled
def draw(errors: dict[Cell, Interval], conditions: Conditions, *, success: float | None = None) -> Figure:
    """Draws a row of panels per family, with a panel per condition and a line per method.

    Args:
        errors: of each cell.
        conditions: in the order of the panels.
        success: largest error of a run that counts as a success, which is drawn as a line; None without.
    """
    families = list(dict.fromkeys(name for name, *_ in errors))
    figure, axes = chart.sheet(2.1 * len(families) + 0.5, len(families), len(conditions), sharey="row")
    for line, name in zip(axes, families, strict=True):
        found = [error for (n, *_), error in errors.items() if n == name]
        known = style.finite(end for error in found for end in (error.value, error.high, *error.points))
        edge = 2 * np.nanmax([*known, 0.5]) if np.isfinite(known).any() else 2.0
        for axis, condition in zip(line, conditions, strict=True):
            selected = {(row, x): error for (n, row, c, x), error in errors.items() if (n, c) == (name, condition)}
            _panel(axis, selected, edge)
            if success is not None:
                axis.axhline(success, color="#777777", lw=0.9, label="success: below")
            axis.set(xlabel=condition.label, title=name)
        style.log_axis(line[0], "y", known)
        line[0].set_ylabel("truth to prediction × 1000\n(scene units²)")
    style.legend_below(figure, *axes.flat, columns=3)
    return figure


def _panel(axis: Axes, errors: dict[tuple[Row, float], Interval], edge: float) -> None:
    """Draws the medians of each row with their intervals or points; values beyond the edge are drawn at it."""
    for row, keys in grouped(errors, lambda key: key[0]).items():
        found = [errors[key].below(edge) for key in keys]
        chart.estimates(axis, row.preset, [x for _, x in keys], found, label=row.name)
