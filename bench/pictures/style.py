"""The style of all pictures and figures: width, type size, and each preset's colour, marker and line."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from numbers import Real
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from bench.tables import look_of

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
# For pictures in run folders, which are viewed on a screen: larger type, no grid.
SCREEN = {"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False}
SCREEN_DPI = 110  # pixels per inch
# Pixels in the true silhouette only, in the rendered silhouette only, in both, in neither.
MISSED, SPURIOUS, BOTH, PAPER = "#d6262b", "#1f77b4", "#d1d1d1", "#ffffff"


@dataclass(frozen=True)
class Look:
    """The colour, marker and line of a row in every figure."""

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
    settings = look_of(preset)
    return Look(**picks | ({"line": "-"} if settings else {}) | settings)


def styled(function: Callable[..., Figure]) -> Callable[..., Figure]:
    """Makes a function draw with `RC`; matplotlib's settings are restored after it."""
    return rc_context(RC)(function)


def save(figure: Figure, path: Path) -> None:
    """Writes a picture of a run for a screen, quickly: draws once (`savefig` draws twice), compresses little."""
    figure.set_dpi(SCREEN_DPI)
    FigureCanvasAgg(figure).print_png(path, pil_kwargs={"compress_level": 1})


def log_axis(axes: Axes, letter: str, values: Any) -> None:
    """Makes the axis "x" or "y" logarithmic, with plain numbers as ticks; only positive values are drawn.

    Without positive values, or if they lie within a factor of 2, the axis stays linear.
    """
    positive = [x for x in finite(values) if x > 0]
    if not positive or 1 < max(positive) / min(positive) < 2:
        return
    getattr(axes, f"set_{letter}scale")("log", nonpositive="mask")
    ratio = max(positive) / min(positive)  # if it is small, ticks only at powers of ten would be too few
    digits = {2, 3, 4, 5, 6, 7, 8} if ratio < 5 else {2, 5} if ratio < 100 else set()
    axis = getattr(axes, f"{letter}axis")
    axis.set_major_formatter(FuncFormatter(lambda x, _: short(x)))
    axis.set_minor_formatter(FuncFormatter(lambda x, _: short(x) if int(f"{x:.0e}"[0]) in digits else ""))


def short(x: float) -> str:
    """A number as a short text for ticks, such as 5e-5, 0.02 or 10."""
    mantissa, power = f"{x:.0e}".split("e")
    return f"{x:g}" if 1e-3 <= abs(x) < 1e4 or x == 0 else f"{mantissa}e{int(power)}"


def error_colours() -> Colormap:
    """The colour map of errors, from light grey to black, on which `MISSED` and `SPURIOUS` are visible."""
    colours = ListedColormap(colormaps["Greys"](np.linspace(0.12, 1.0, 256)))
    return colours.with_extremes(bad=PAPER)


def rounded_up(x: float) -> float:
    """The end of a scale of degrees: the smallest of 1, 2, 5, 10, 20, 30, 45, 60, 90, 180 that is at least x."""
    return next((end for end in (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 90.0) if end >= x), 180.0)


def finite(values: Any) -> list[float]:
    """The values as floats; missing and non-finite values become NaN, which is not drawn."""
    return [float(x) if isinstance(x, Real) and math.isfinite(x) else math.nan for x in values]


def legend_below(figure: Figure, *axes: Axes, columns: int = 4) -> None:
    """Draws one legend of several axes below them, with at most `columns` columns, so that it fits the figure."""
    handles = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    for ncols in range(columns, 0, -1):
        legend = figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=ncols)
        if ncols == 1 or legend.get_window_extent().width <= figure.bbox.width:
            break
        legend.remove()


def bare(axis: Any) -> Any:
    """Prepares axes for a picture (a thin frame, no ticks, no grid) and returns them."""
    axis.set(xticks=[], yticks=[])
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set(visible=True, color="#bbbbbb")
    return axis


def window(masks: Sequence[np.ndarray], margin: float = 0.08) -> tuple[float, float, float]:
    """The square part of pictures that contains all masks, with a margin.

    Args:
        masks: [height, width], with the same aspect ratio; their sizes may differ.
        margin: as a fraction of the masks' extent.

    Returns:
        Its upper edge, left edge and side, in units of a picture's larger side. If all masks are empty, the side is the
        smaller side.
    """
    sizes = [max(mask.shape) for mask in masks]
    max_side = min((min(mask.shape) / size for mask, size in zip(masks, sizes, strict=True)), default=1.0)
    low, high = np.ones(2), np.zeros(2)
    for mask, size in zip(masks, sizes, strict=True):
        for axis in (0, 1) if mask.any() else ():
            indices = np.nonzero(mask.any(1 - axis))[0]
            low[axis] = min(low[axis], indices[0] / size)
            high[axis] = max(high[axis], (indices[-1] + 1) / size)
    if (low > high).any():
        return 0.0, 0.0, max_side
    side = min(max_side, float((high - low).max()) * (1 + margin))
    spans = np.array(masks[0].shape) / sizes[0]
    top, left = np.clip((low + high - side) / 2, 0, spans - side)
    return float(top), float(left), side


def silhouette_image(rendered: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Compares two masks [height, width] as a picture [height, width, 3]: `BOTH`, `MISSED`, `SPURIOUS` on `PAPER`."""
    cases = [(rendered & true)[..., None], (true & ~rendered)[..., None], (rendered & ~true)[..., None]]
    return np.select(cases, [np.array(to_rgb(colour)) for colour in (BOTH, MISSED, SPURIOUS)], np.array(to_rgb(PAPER)))
