"""Charts as data: panels of series, drawn here as a figure, and by the page so that they answer the mouse."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.statistics import Interval

GREY = "#777777"  # of lines that belong to no row
NAMES = 14  # that have room beside a panel, one below the other
Series = dict[str, Any]
Panel = dict[str, Any]


def series(name: str, preset: str, x: Iterable[float], y: Iterable[float | Interval], **more: Any) -> Series:
    """Points with the colour and marker that their preset has in every figure; of estimates with their intervals.

    Args:
        y: the values, or estimates: where one has no interval, the points of its shapes are drawn, small.
        more: what the page reads as well, such as `text`, `link` and `hollow`, see `page/parts/chart.js`.
    """
    look, places, found = style.look(preset), list(x), list(y)
    values = [one.value if isinstance(one, Interval) else one for one in found]
    made = {"name": name, "x": _rounded(places), "y": _rounded(values), "colour": look.colour, "symbol": look.marker}
    estimates = [one for one in found if isinstance(one, Interval)]
    if any(one.known for one in estimates):
        ends = [(one.low, one.high) if one.known else (one.value, one.value) for one in estimates]
        made |= dict(zip(("low", "high"), map(_rounded, zip(*ends, strict=True)), strict=True))
    alone = [(at, p) for at, one in zip(places, estimates, strict=False) if not one.known for p in one.points]
    return made | ({"shapes": [_rounded(pair) for pair in alone]} if alone else {}) | more


def curve(name: str, preset: str, x: Iterable[float], y: Iterable[float | Interval], **more: Any) -> Series:
    """As `series`, joined by a line."""
    return series(name, preset, x, y, **{"dash": style.look(preset).line} | more)


def level(name: str, x: Iterable[float], value: float, **more: Any) -> Series:
    """A grey line at a value, between the ends of positions."""
    ends = [min(places := list(x)), max(places)]
    return {"name": name, "x": ends, "y": [value, value], "colour": GREY, "symbol": "", "dash": "-", **more}


def panel_data(title: str, x: str, y: str, series: list[Series], **more: Any) -> Panel:
    """A panel of a chart; an axis is logarithmic where its values are positive and span a factor above 3.

    Positions that have names are not: where the first one has no value, the others are positive.

    Args:
        x, y: what its axes carry, with the unit.
        more: what the page reads as well; `ticks` and `rows`, the names of the positions 0, 1, ... along x and down y.
    """
    axes = {}
    for letter, name, names in (("x", x, "ticks"), ("y", y, "rows")):
        values = [v for each in series for v in each[letter] if math.isfinite(v)]
        log = names not in more and bool(values) and min(values) > 0 and max(values) / min(values) > 3
        axes[letter] = {"title": name, "log": log}
    return {"title": title, **axes, "series": series, **more}


def sheet(
    height: float, lines: int = 1, columns: int = 1, *, width: float = style.WIDTH, **how: Any
) -> tuple[Figure, np.ndarray]:
    """A figure of that size in inches, and its axes [lines, columns]."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(lines, columns, squeeze=False, **how)


@style.styled
def draw(panels: Sequence[Panel], height: float, lines: int = 1, *, legend: int = 4, **how: Any) -> Figure:
    """Draws panels as a figure of that height in inches, so many lines of them, with one legend below.

    Args:
        legend: the columns of the legend; 0 for none.
        how: the width of the figure and what its axes share, see `sheet`.
    """
    columns = -(-max(len(panels), 1) // lines)
    figure, axes = sheet(height, lines, columns, **how)
    size = {True: len(panels), "row": columns}.get(how.get("sharey"), 1)  # panels with one axis have one edge
    for place, (axis, panel) in enumerate(zip(axes.flat, panels, strict=False)):
        _panel(axis, panel, _edge(panels[place // size * size :][:size], "y", "high"))
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis in axes[:, 1:].flat if "sharey" in how else ():
        axis.set_ylabel("")
    if legend:
        style.legend_below(figure, *axes.flat, columns=legend)
    return figure


@style.styled
def draw_lead(panels: Sequence[Panel]) -> Figure:
    """Draws the first panel large, with the names of its lines beside it, and the others small below, of equal axes."""
    figure = Figure(figsize=(style.WIDTH, 5.4), layout="constrained")
    grid = figure.add_gridspec(2, max(len(panels) - 1, 1), height_ratios=(1.7, 1))
    lead = figure.add_subplot(grid[0, :])
    _panel(lead, panels[0], 1.0)
    _name_ends(lead, _shown(panels[0]))
    first = None
    for number, panel in enumerate(panels[1:]):
        first = first or figure.add_subplot(grid[1, 0])
        axis = first if not number else figure.add_subplot(grid[1, number], sharex=first, sharey=first)
        _panel(axis, panel | {"series": [each | {"symbol": ""} for each in panel["series"]]}, 1.0)
        axis.label_outer()
        axis.set_xlabel("")
    if first and panels[0]["x"]["log"]:  # they are too narrow for more
        low, high = first.get_xlim()
        tens = [10.0**power for power in range(-6, 7) if low <= 10.0**power <= high]
        first.minorticks_off()
        first.set_xticks(tens, [f"{ten:g}" for ten in tens])
    lead.set_xlabel("")
    figure.supxlabel(panels[0]["x"]["title"], fontsize=lead.yaxis.label.get_size())
    return figure


def _name_ends(axis: Axes, lines: list[Series]) -> None:
    """Writes the name of each line to the right of the axes, as near to its end as the other names leave room."""
    ends = sorted((each for each in lines if each["x"]), key=lambda each: each["y"][-1])
    right = max((each["x"][-1] for each in ends), default=None)
    axis.set_xlim(right=right)
    low, high = axis.get_ylim()
    gap, places = 1 / max(len(ends), NAMES), list[float]()
    for place in ((each["y"][-1] - low) / (high - low) for each in ends):
        places.append(max(place, places[-1] + gap) if places else place)
    over = max(places[-1] - 1 + gap / 2, 0.0) if places else 0.0
    for each, place in zip(ends, places, strict=True):
        axis.plot([each["x"][-1], right], [each["y"][-1]] * 2, color=each["colour"], lw=0.6, ls=":")
        axis.annotate(
            each["name"],
            (right, each["y"][-1]),
            (1.04, place - over),
            **{"textcoords": "axes fraction", "va": "center", "color": each["colour"]},
            arrowprops={"arrowstyle": "-", "color": each["colour"], "lw": 0.6, "relpos": (0, 0.5)}
            | {"shrinkA": 0, "shrinkB": 0},
        )


def _shown(panel: Panel) -> list[Series]:
    return [each for each in panel["series"] if not each.get("off")]


def _edge(panels: Sequence[Panel], *of: str) -> float:
    """Where what is infinite is drawn: beyond all else of panels that share an axis, in these parts of their series."""
    values = [v for panel in panels for each in _shown(panel) for key in of for v in each.get(key, ())]
    return 2 * max(filter(math.isfinite, values), default=1.0)


def _panel(axis: Axes, panel: Panel, edge: float) -> None:
    shown = _shown(panel)
    for each in shown:
        _series(axis, each, [_edge([panel], "x"), edge])
    for letter in "xy":
        if panel[letter]["log"]:
            style.log_axis(axis, letter, [v for each in shown for v in (*each[letter], *each.get("low", ()))])
    if "ticks" in panel:
        axis.set_xticks(range(len(panel["ticks"])), panel["ticks"])
    if "rows" in panel:
        axis.set_yticks(range(len(panel["rows"])), panel["rows"])
        axis.set_ylim(len(panel["rows"]) - 0.4, -0.6)
    if panel["y"].get("reversed"):
        axis.invert_yaxis()
    axis.set(title=panel["title"], xlabel=panel["x"]["title"], ylabel=panel["y"]["title"])


def _series(axis: Axes, each: Series, edges: list[float]) -> None:
    """Draws a series; what is infinite at the edge, points as crosses there; intervals as a band or as bars."""
    x, y, line = np.minimum(each["x"], edges[0]), np.minimum(each["y"], edges[1]), "dash" in each
    how: dict[str, Any] = {"color": each["colour"], "marker": each["symbol"], "ls": each.get("dash", "none")}
    how |= {"markevery": max(len(x) // 6, 1)} if line else {}
    how |= {"drawstyle": "steps-post"} if each.get("step") else {}
    how |= {"mfc": "none"} if each.get("hollow") else {}
    how |= {"ms": 0.55 * each["size"]} if "size" in each else {}
    lost = (np.isinf(each["x"]) | np.isinf(each["y"])) & (not line)
    axis.plot(x[~lost], y[~lost], label=None if each.get("quiet") else each["name"], **how)
    if lost.any():
        axis.plot(x[lost], y[lost], "x", color=each["colour"])
    if "low" in each:
        ends = [np.minimum(each[end], edges[1]) for end in ("low", "high")]
        if line:
            axis.fill_between(x, *ends, color=each["colour"], alpha=0.15, lw=0)
        else:
            axis.vlines(x, *ends, color=each["colour"], lw=0.7)
    if "shapes" in each:
        at, found = np.minimum(each["shapes"], edges).T
        axis.plot(at, found, color=each["colour"], marker=each["symbol"], ls="none", ms=2, alpha=0.5, zorder=1.5)


def _rounded(values: Iterable[float]) -> list[float]:
    return [float(f"{value:.5g}") for value in values]
