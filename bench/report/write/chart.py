"""Pieces that the figures share: a sheet with axes, a grid of panels, the line of a row."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.statistics import Interval


def sheet(
    height: float, lines: int = 1, columns: int = 1, *, width: float = style.WIDTH, **how: Any
) -> tuple[Figure, np.ndarray]:
    """A figure of that size in inches, and its axes [lines, columns]."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(lines, columns, squeeze=False, **how)


def line(axis: Axes, preset: str, x: Any, y: Any, *, band: Any = None, **how: Any) -> None:
    """Draws the line of a row in the look of its preset, and a band between two ends around it.

    Args:
        axis: where it is drawn.
        preset: the row's preset.
        x, y: positions and values.
        band: the lower and the upper ends of the band; None for no band.
        how: settings of the line that replace those of the look.
    """
    look = style.look(preset)
    axis.plot(x, y, **{"color": look.colour, "marker": look.marker, "ls": look.line, **how})
    if band is not None:
        axis.fill_between(x, *band, color=look.colour, alpha=0.15, lw=0)


def points(axis: Axes, preset: str, x: Any, y: Any, **how: Any) -> None:
    """Draws the points of a row with the marker and colour of its preset."""
    line(axis, preset, x, y, ls="none", **how)


def estimates(axis: Axes, preset: str, x: Any, found: Sequence[Interval], *, bars: bool = False, **how: Any) -> None:
    """Draws estimates of a row with their intervals; where one has none, the points of its shapes, small.

    Args:
        axis: where they are drawn.
        preset: the row's preset.
        x: positions.
        found: the estimates.
        bars: whether the intervals are bars, not a band.
        how: settings of the line that replace those of the look.
    """
    value, low, high = (np.array([getattr(one, end) for one in found]) for end in ("value", "low", "high"))
    if bars:
        look = style.look(preset)
        how = {"color": look.colour, "marker": look.marker, "ls": look.line, "elinewidth": 0.7, **how}
        axis.errorbar(x, value, np.maximum([value - low, high - value], 0), **how)
    else:
        line(axis, preset, x, value, band=(low, high), **how)
    shapes(axis, preset, x, found)


def front(
    axis: Axes, rows: Sequence[tuple[str, str]], costs: Any, errors: Sequence[Interval], on: Sequence[Any]
) -> None:
    """Draws the error of each row, a preset and its name, over its cost; those on the front are filled."""
    edge = 2 * max((error.value for error in errors), default=1.0)
    for (preset, name), cost, error, filled in zip(rows, costs, errors, on, strict=True):
        how = {"ls": "none", "ms": 5, "label": name} | ({} if filled else {"mfc": "none"})
        estimates(axis, preset, [cost], [error.below(edge)], bars=True, **how)


def shapes(axis: Axes, preset: str, x: Any, found: Sequence[Interval]) -> None:
    """Draws the points of the shapes of estimates that have no interval, in the colour of their row."""
    drawn = [(at, point) for at, one in zip(x, found, strict=True) if not one.known for point in one.points]
    if drawn:
        points(axis, preset, *np.array(drawn, dtype=float).T, ms=2, alpha=0.5, zorder=1.5, label=None)


def reference(draw: Callable[..., Any], value: float, times: float, label: str) -> None:
    """Draws a line at a value and a dotted one at a multiple of it, by an axis's `axhline` or `axvline`."""
    draw(value, color="#777777", lw=0.9, label=label)
    draw(times * value, color="#777777", lw=0.9, ls=":", label=f"{times:g} times that")


def panel_data(title: str, x: str, y: str, series: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """A panel of the page's chart; an axis is logarithmic where its values are positive and span a factor above 3."""
    axes = {}
    for letter, name in (("x", x), ("y", y)):
        values = [v for each in series for v in each[letter] if isinstance(v, int | float) and math.isfinite(v)]
        log = bool(values) and min(values) > 0 and max(values) / min(values) > 3
        axes[letter] = {"title": name, "log": log}
    return {"title": title, **axes, "series": series, **more}


def series(name: str, preset: str, x: Any, y: Any, **more: Any) -> dict[str, Any]:
    """A series of the page's chart with the colour and marker that its preset has in every figure."""
    look = style.look(preset)
    found = {"name": name, "x": _rounded(x), "y": _rounded(y), "colour": look.colour, "symbol": look.marker}
    return found | more


def _rounded(values: Any) -> list[float]:
    return [float(f"{value:.5g}") for value in np.asarray(values, float)]
