"""The style of the page's figures: width, type size, legends, and each preset's colour, marker and line."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any
from zlib import crc32

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure

from bench.pictures.style import PAPER
from bench.tables import LOOK_KEY, METHOD, Node, choice, names

WIDTH = 7.0  # inches: two columns of a paper
RC = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.minor.pad": 5.0,  # aligns labels with those of major ticks, whose marks are longer
    "ytick.minor.pad": 5.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 4,
    "legend.frameon": False,
    "axes.grid": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "savefig.dpi": 300,
    "pdf.fonttype": 42,
}


@dataclass(frozen=True)
class Look:
    colour: str
    marker: str
    line: str = "-"


FALLBACK_COLOURS = (  # for presets that are not in conf; no renderer there has these
    *("#7570b3", "#556b2f", "#b5179e", "#3a86ff", "#8d6e63", "#607d3b", "#c1121f", "#4a4e69", "#9a8c00", "#00788a"),
)
FALLBACK_MARKERS = ("<", ">", "p", "h", "*", "d", "8")
FALLBACK_LINES = ("-", "--", "-.", ":")


@cache
def look(preset: str) -> Look:
    """The look of a preset in every figure: `_look_` of its renderer or method in conf, else from a hash."""
    checksum = crc32(preset.encode("utf-8", "backslashreplace"))
    choices = {"colour": (FALLBACK_COLOURS, 0), "marker": (FALLBACK_MARKERS, 8), "line": (FALLBACK_LINES, 16)}
    picks = {key: options[(checksum >> shift) % len(options)] for key, (options, shift) in choices.items()}
    settings = _settings_of(preset)
    return Look(**picks | ({"line": "-"} if settings else {}) | settings)


def _settings_of(name: str) -> Node:
    """The keys of `LOOK_KEY`, merged over those of its bases; {} for others. A tuned method looks like the method."""
    name = name.rpartition("/")[2]
    group = METHOD if name in names(METHOD) else "renderer"
    candidates = [name, *(other for other in names("renderer") if other.replace("_", "") == name)]  # or a class name
    return next((_merged(group, candidate) for candidate in candidates if candidate in names(group)), {})


def _merged(group: str, name: str) -> Node:
    node, settings = choice(group, name), dict[str, Any]()
    for base in node.get("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            settings |= _merged(group, base.removeprefix(f"/{group}/"))
        elif renderer := isinstance(base, dict) and base.get("override /renderer"):
            settings |= _merged("renderer", renderer)
    return settings | node.get(LOOK_KEY, {})


def styled(function: Callable[..., Figure]) -> Callable[..., Figure]:
    """Makes a function draw with `RC`; matplotlib's settings are restored after it."""
    return rc_context(RC)(function)


def error_colours() -> Colormap:
    """The colour map of errors, from light grey to black, on which `MISSED` and `SPURIOUS` are visible."""
    colours = ListedColormap(colormaps["Greys"](np.linspace(0.12, 1.0, 256)))
    return colours.with_extremes(bad=PAPER)


def rounded_up(x: float) -> float:
    """The end of a scale of degrees: the smallest of 1, 2, 5, 10, 20, 30, 45, 60, 90, 180 that is at least x."""
    return next((end for end in (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0) if end >= x), 180.0)


def legend_below(figure: Figure, *axes: Axes, columns: int = 4) -> None:
    """Draws one legend of several axes below them, with at most `columns` columns, so that it fits the figure."""
    handles = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    for ncols in range(columns, 0, -1):
        legend = figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=ncols)
        if ncols == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()
