"""The style of pictures of runs; axes, windows and silhouettes that figures use too."""

import math
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

# For pictures in run folders, which are viewed on a screen: larger type, no grid.
SCREEN = {"font.size": 9, "axes.titlesize": 10, "axes.spines.top": False, "axes.spines.right": False}
SCREEN_DPI = 110  # pixels per inch
# Pixels in the true silhouette only, in the rendered silhouette only, in both, in neither.
MISSED, SPURIOUS, BOTH, PAPER = "#d6262b", "#1f77b4", "#d1d1d1", "#ffffff"


def save(figure: Figure, path: Path) -> None:
    """Writes a picture of a run for a screen, quickly: draws once (`savefig` draws twice), compresses little."""
    figure.set_dpi(SCREEN_DPI)
    FigureCanvasAgg(figure).print_png(path, pil_kwargs={"compress_level": 1})


def log_axis(axes: Axes, letter: str, values: Any) -> None:
    """Makes the axis "x" or "y" logarithmic, with plain ticks, unless its positive values are within a factor of 2."""
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


def finite(values: Any) -> list[float]:
    """The values as floats; missing and non-finite values become NaN, which is not drawn."""
    return [float(x) if isinstance(x, Real) and math.isfinite(x) else math.nan for x in values]


def bare(axis: Any) -> Any:
    """Prepares axes for a picture (a thin frame, no ticks, no grid) and returns them."""
    axis.set(xticks=[], yticks=[])
    axis.grid(False)
    for spine in axis.spines.values():
        spine.set(visible=True, color="#bbbbbb")
    return axis


def window(masks: Sequence[np.ndarray], margin: float = 0.08) -> tuple[float, float, float]:
    """The upper edge, left edge and side of the square part of pictures that contains all masks, with a margin.

    In units of a picture's larger side. The side is the smaller side if all masks are empty.
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
