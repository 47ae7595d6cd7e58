"""How all figures look: one width, one type size, and for each renderer or strategy one colour, marker and line."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import Any
from zlib import crc32

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

WIDTH = 7.0  # inches: two columns of a paper
RC = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
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
LOST, FALSE, PAPER = "#d6262b", "#1f77b4", "#ffffff"  # as in the pictures of a run


@dataclass(frozen=True)
class Look:
    """How a row is drawn in every figure."""

    colour: str
    marker: str
    line: Any = "-"


KNOWN = {  # a strategy that is but a renderer looks as that renderer
    "Naive sphere tracing": Look("#111111", "o"),
    "+ practical grad.": Look("#8a8a8a", "s", "--"),
    "+ parallel": Look("#e69f00", "^"),
    "+ dynamic": Look("#56b4e9", "v", "--"),
    "+ aggressive": Look("#d55e00", "D"),
    "+ coarse-to-fine": Look("#009e73", "P"),
    "+ coarse-to-fine, 100 steps": Look("#cc79a7", "X", "--"),
    "naive": Look("#111111", "o"),
    "dist": Look("#0072b2", "s"),
    "dvr": Look("#d1495b", "^"),
    "idr": Look("#6a3d9a", "D"),
    "narrowband": Look("#9a6a1f", "v"),
    "DIST, our default": Look("#0072b2", "s"),
    "DIST, official clamp": Look("#2f9e9e", "<", "-."),
    "DVR, n = 64": Look("#d1495b", "^"),
    "IDR": Look("#6a3d9a", "D"),
    "Naive, all rays at once": Look("#5b4a3f", "p", "--"),
    "+ aggressive, capped": Look("#f0a35e", "d", "--"),
    "+ aggressive, step back": Look("#8b2252", "v", "-."),
    "+ aggressive, step floor": Look("#b8860b", "<", "--"),
    "+ aggressive, slope bound": Look("#66a61e", ">", "-."),
    "DVR, n = 128": Look("#d1495b", "^"),
    "DVR, official slope": Look("#e7a1ab", "^", "--"),
    "DIST, 16 starts": Look("#0072b2", "s"),
    "DIST, 4 starts": Look("#0072b2", "s"),
    "DVR, 32 x 32": Look("#d1495b", "^"),
    "Naive, 32 x 32": Look("#111111", "<", "-."),
    "DVR": Look("#d1495b", "^"),
    "ICP, point to point": Look("#8fbc5a", "v", "--"),
    "ICP, point to plane": Look("#e69f00", "d", "--"),
    "ICP, point to plane, 16 starts": Look("#b36b00", "P", "-."),
    "DIST with mask": Look("#0072b2", "s"),
    "DIST": Look("#56b4e9", "o", "--"),
    "DIST with mask, paper's": Look("#5b4a3f", "p"),
    "DIST, paper's": Look("#b39c8a", "h", "--"),
    "DeepSDF samples": Look("#009e73", "P", "-."),
    "DVR with mask": Look("#d1495b", "^"),
    "IDR with mask": Look("#6a3d9a", "D"),
    "Naive with mask": Look("#111111", "<", "-."),
}
_COLOURS = (
    "#1b9e77",
    "#d95f02",
    "#7570b3",
    "#e7298a",
    "#66a61e",
    "#b8860b",
    "#8b2252",
    "#2f6f8f",
    "#556b2f",
    "#c04000",
)
_MARKERS = ("<", ">", "p", "h", "*", "d", "8")
_LINES = ("-", "--", "-.", (0, (1, 1)))


def look(name: str) -> Look:
    """The look of a row, by nothing but its name, so that it is the same in every figure and every report."""
    if name in KNOWN:
        return KNOWN[name]
    drawn = crc32(name.encode("utf-8", "backslashreplace"))
    picks = ((drawn >> shift) % len(choices) for shift, choices in ((0, _COLOURS), (8, _MARKERS), (16, _LINES)))
    colour, marker, line = picks
    return Look(_COLOURS[colour], _MARKERS[marker], _LINES[line])


def styled(function: Callable[..., Figure]) -> Callable[..., Figure]:
    """Makes what a function draws look like all other figures; matplotlib's settings are as before after it."""
    return rc_context(RC)(function)


def log_axis(axes: Axes, letter: str, values: Any) -> None:
    """Makes the axis "x" or "y" logarithmic, with plain numbers, where a value is positive; others are not drawn.

    Where the positive values are all about the same, within a factor of 2, it stays linear: its ticks say more.
    """
    positive = [x for x in finite(values) if x > 0]
    if not positive or 1 < max(positive) / min(positive) < 2:
        return
    getattr(axes, f"set_{letter}scale")("log", nonpositive="mask")
    ratio = max(positive) / min(positive)  # where it is small, decades alone would leave an axis without numbers
    digits = {2, 3, 4, 5, 6, 7, 8} if ratio < 4 else {2, 5} if ratio < 100 else set()
    axis = getattr(axes, f"{letter}axis")
    axis.set_major_formatter(FuncFormatter(lambda x, _: short(x)))
    axis.set_minor_formatter(FuncFormatter(lambda x, _: short(x) if int(f"{x:.0e}"[0]) in digits else ""))


def short(x: float) -> str:
    """A number of one significant digit or few, such as 5e-5, 0.02 or 10."""
    mantissa, power = f"{x:.0e}".split("e")
    return f"{x:g}" if 1e-3 <= abs(x) < 1e4 or x == 0 else f"{mantissa}e{int(power)}"


def error_colours() -> Colormap:
    """From light grey for none to black for much, so that `LOST` and `FALSE` stand out of it."""
    colours = ListedColormap(colormaps["Greys"](np.linspace(0.12, 1.0, 256)))
    return colours.with_extremes(bad=PAPER)


def rounded_up(x: float) -> float:
    """The least of 1, 2, 5, 10, 20, 30, 45, 60, 90, 180 that is not below x: the end of a scale of degrees."""
    return next((end for end in (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0) if end >= x), 180.0)


def finite(values: Any) -> list[float]:
    """The values with nan, which is not drawn, for all that are missing or not finite."""
    return [float(x) if isinstance(x, Real) and math.isfinite(x) else math.nan for x in values]


def needs_log(values: Any, factor: float = 20.0) -> bool:
    """Whether the positive values differ by more than this factor, too much for a linear axis."""
    positive = [x for x in finite(values) if x > 0]
    return bool(positive) and max(positive) > factor * min(positive)


def labelled(*axes: Axes) -> dict[str, Any]:
    """What stands in a legend for each label of some axes, each label once."""
    return {label: handle for one in axes for handle, label in zip(*one.get_legend_handles_labels(), strict=True)}


def bare(axis: Any) -> Any:
    """The axes of a picture: a thin frame, no ticks, no grid."""
    axis.set(xticks=[], yticks=[])
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set(visible=True, color="#bbbbbb")
    return axis
