"""Charts as data: panels of series, drawn here as a figure, and by the page as an interactive chart."""

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any
from urllib.parse import urlencode

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import figure_style, style
from bench.report.data.statistics import Interval, dominated
from bench.report.suite.attempts import CUSTOM

REFERENCE_COLOUR = "#777777"
MAX_BANDS, MAX_BARS = 4, 6  # more lines have bars in place of bands, if each has few points
BAR_STEP = 0.011  # between the bars of two lines, as a fraction of the width
Series = dict[str, Any]
Panel = dict[str, Any]


def series(name: str, preset: str, x: Iterable[float | Interval], y: Iterable[float | Interval], **more: Any) -> Series:
    """Points with the colour and marker of their preset; estimates along y, or x with named rows, have intervals.

    If an estimate has no interval, small points show its shapes. `more` is data for the page, see
    `page/parts/chart.js`.
    """
    look, x, y = _look(name, preset), list(x), list(y)
    points = {"name": name, "x": _values(x), "y": _values(y), "colour": look.colour, "symbol": look.marker}
    estimates = [estimate for estimate in (*x, *y) if isinstance(estimate, Interval)]
    if any(estimate.has_ends for estimate in estimates):
        ends = [(each.low, each.high) if each.has_ends else (each.value, each.value) for each in estimates]
        points |= dict(zip(("low", "high"), map(_values, zip(*ends, strict=True)), strict=True))
    shapes = [_values(pair) for point in zip(x, y, strict=True) for pair in _shape_points(*point)]
    return points | ({"shapes": shapes} if shapes else {}) | more


def _look(name: str, preset: str) -> figure_style.Look:
    """The look of a preset; rows of renderer=custom have different looks."""
    return figure_style.look(name if preset == CUSTOM else preset)


def _shape_points(x: float | Interval, y: float | Interval) -> Iterable[tuple[float, float]]:
    """The points of the single shapes of an estimate without an interval; empty for other points."""
    if not any(isinstance(value, Interval) and not value.has_ends for value in (x, y)):
        return ()
    return product(*(value.points if isinstance(value, Interval) else (value,) for value in (x, y)))


def curve(name: str, preset: str, x: Iterable[float], y: Iterable[float | Interval], **more: Any) -> Series:
    return series(name, preset, x, y, **{"dash": _look(name, preset).line} | more)


def link_to_runs(text: str) -> str:
    return "#/runs?task=all&view=runs&" + urlencode({"q": text})


def level(name: str, x: Iterable[float], value: float, **more: Any) -> Series:
    """A grey horizontal line at a value, from the smallest to the largest position."""
    ends = [min(places := list(x)), max(places)]
    return {"name": name, "x": ends, "y": [value, value], "colour": REFERENCE_COLOUR, "symbol": "", "dash": "-", **more}


def front(x: Iterable[float], y: Iterable[float]) -> Series:
    """The line of the front of points: those for which no other point is smaller in both."""
    points = np.array([pair for pair in zip(x, y, strict=True) if all(map(math.isfinite, pair))]).reshape(-1, 2)
    points = points[~dominated(*points.T)] if len(points) else points
    line = {"symbol": "", "dash": "-", "step": True, "quiet": True}
    return series("front", "", *points[points[:, 0].argsort()].T.tolist(), **line) | {"colour": REFERENCE_COLOUR}


def panel_data(title: str, x: str, y: str, series: list[Series], **more: Any) -> Panel:
    """A panel of a chart. An axis is logarithmic if its values are positive and span a factor above 3.

    An axis with named positions, `ticks` along x or `rows` down y in `more`, is never logarithmic.
    """
    axes = {}
    for letter, name, names in (("x", x, "ticks"), ("y", y, "rows")):
        values = [v for each in series for v in each[letter] if math.isfinite(v)]
        log = names not in more and bool(values) and min(values) > 0 and max(values) / min(values) > 3
        axes[letter] = {"title": name, "log": log}
    return {"title": title, **axes, "series": series, **more}


def sheet(
    height: float, lines: int = 1, columns: int = 1, *, width: float = figure_style.WIDTH, **how: Any
) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(lines, columns, squeeze=False, **how)


@figure_style.styled
def draw(panels: Sequence[Panel], height: float, lines: int = 1, *, legend: int = 4, **how: Any) -> Figure:
    """Draws panels in lines, `height` inches high, with a legend of so many columns below; `how`: see `sheet`."""
    columns = -(-max(len(panels), 1) // lines)
    figure, axes = sheet(height, lines, columns, **how)
    size = {True: len(panels), "row": columns}.get(how.get("sharey"), 1)  # panels that share an axis share its edge
    for index, (axis, panel) in enumerate(zip(axes.flat, panels, strict=False)):
        _panel(axis, panel, _edge(panels[index // size * size :][:size], "y"))
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis in axes[:, 1:].flat if "sharey" in how else ():
        axis.set_ylabel("")
    if legend:
        figure_style.legend_below(figure, *axes.flat, columns=legend)
    return figure


def _shown(panel: Panel) -> list[Series]:
    return [each for each in panel["series"] if not each.get("off")]


def _drawn(panel: Panel, letter: str) -> list[float]:
    ends = ("low", "high") if letter == ("x" if "rows" in panel else "y") else ()
    values = [v for each in _shown(panel) for key in (letter, *ends) for v in each.get(key, ())]
    return values + [pair["xy".index(letter)] for each in _shown(panel) for pair in each.get("shapes", ())]


def _edge(panels: Sequence[Panel], letter: str) -> float:
    """The position of infinite values: beyond all finite values of panels that share an axis."""
    return 2 * max((v for panel in panels for v in _drawn(panel, letter) if math.isfinite(v)), default=1.0)


def _panel(axis: Axes, panel: Panel, edge: float) -> None:
    lengths = [len(each["x"]) for each in _shown(panel) if _has_band(each)]
    as_bars = len(lengths) > MAX_BANDS and max(lengths) <= MAX_BARS
    for each in _side_by_side(_shown(panel), log=panel["x"]["log"]) if as_bars else _shown(panel):
        _series(axis, each, [_edge([panel], "x"), edge], across="rows" in panel, bars=as_bars)
    for letter in "xy":
        if panel[letter]["log"]:
            style.log_axis(axis, letter, _drawn(panel, letter))
    if "ticks" in panel:
        axis.set_xticks(range(len(panel["ticks"])), panel["ticks"])
    if "rows" in panel:
        axis.set_yticks(range(len(panel["rows"])), panel["rows"])
        axis.set_ylim(len(panel["rows"]) - 0.4, -0.6)
    if panel["y"].get("reversed"):
        axis.invert_yaxis()
    axis.set(title=panel["title"], xlabel=panel["x"]["title"], ylabel=panel["y"]["title"])


def _has_band(each: Series) -> bool:
    return "dash" in each and "low" in each


def _side_by_side(shown: Sequence[Series], *, log: bool) -> list[Series]:
    """The series, those with bands moved along x so that bars in their place do not overlap."""
    forward, back = (np.log, np.exp) if log else (np.asarray, np.asarray)
    positions = [forward(each["x"]) for each in shown if _has_band(each)]
    places = np.unique(np.concatenate([x[np.isfinite(x)] for x in positions]))
    width, gap = (np.ptp(places), np.diff(places).min()) if len(places) > 1 else (1.0, 1.0)
    step = min(BAR_STEP * width, 0.8 * gap / len(positions))
    middle = (len(positions) - 1) / 2
    moved = (back(x + (index - middle) * step) for index, x in enumerate(positions))
    return [each | {"x": next(moved)} if _has_band(each) else each for each in shown]


def _series(axis: Axes, each: Series, edges: list[float], *, across: bool, bars: bool) -> None:
    """Draws a series: intervals, along x if `across`, as a band or bars; infinite values at the edge or as crosses."""
    x, y, line = np.minimum(each["x"], edges[0]), np.minimum(each["y"], edges[1]), "dash" in each
    style_options: dict[str, Any] = {"color": each["colour"], "marker": each["symbol"], "ls": each.get("dash", "none")}
    style_options |= {"markevery": max(len(x) // 6, 1)} if line else {}
    style_options |= {"drawstyle": "steps-post"} if each.get("step") else {}
    style_options |= {"mfc": "none"} if each.get("hollow") else {}
    style_options |= {"ms": 0.55 * each["size"]} if "size" in each else {}
    is_infinite = (np.isinf(each["x"]) | np.isinf(each["y"])) & (not line)
    axis.plot(x[~is_infinite], y[~is_infinite], label=None if each.get("quiet") else each["name"], **style_options)
    if is_infinite.any():
        axis.plot(x[is_infinite], y[is_infinite], "x", color=each["colour"])
    if "low" in each:
        ends = [np.minimum(each[end], edges[not across]) for end in ("low", "high")]
        if line and not bars:
            axis.fill_between(x, *ends, color=each["colour"], alpha=0.15, lw=0)
        elif across:
            axis.hlines(y, *ends, color=each["colour"], lw=1)
        else:
            axis.vlines(x, *ends, color=each["colour"], lw=0.7)
    if "shapes" in each:
        shape_x, shape_y = np.minimum(np.reshape(each["shapes"], (-1, 2)), edges).T  # without runs: empty
        axis.plot(shape_x, shape_y, color=each["colour"], marker=each["symbol"], ls="none", ms=2, alpha=0.5, zorder=1.5)


def _values(values: Iterable[float | Interval]) -> list[float]:
    return [float(f"{value.value if isinstance(value, Interval) else value:.5g}") for value in values]
