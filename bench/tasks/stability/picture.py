"""The picture of a stress test: the first failed rendering."""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bench.pictures.style import BOTH, MISSED, PAPER, SCREEN, SPURIOUS, bare, save

# Colours of kinds of pixels; images.npz stores the index of the kind. Names for readers, if different.
PIXELS = {"background": PAPER, "right": BOTH, "lost": MISSED, "false": SPURIOUS, "wrong surface": "#f2a600"}
PIXEL_NAMES = {"lost": "missed", "false": "spurious"}


@rc_context(SCREEN)
def draw_failure(folder: Path, images: dict[str, np.ndarray], severity: float, title: str) -> None:
    """Writes images.npz and failure.png: rendered and true distances, and the kind of error of each pixel.

    Args:
        images: "distance", "true_distance" and "kinds", an index into `PIXELS` for each pixel; all [height, width].
    """
    np.savez_compressed(folder / "images.npz", severity=severity, **images)  # type: ignore[arg-type]
    figure = Figure(figsize=(9.2, 3.6), layout="constrained")
    rendered_axis, true_axis, kinds_axis = figure.subplots(1, 3)
    true_distance = images["true_distance"]
    finite = true_distance[np.isfinite(true_distance)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    for axis, name, heading in ((rendered_axis, "distance", "found"), (true_axis, "true_distance", "truth")):
        shown = axis.imshow(images[name], cmap="viridis", vmin=low, vmax=max(high, low + 1e-6))
        axis.set_title(f"distance along the ray, {heading}")
        bare(axis)
    figure.colorbar(shown, ax=[rendered_axis, true_axis], shrink=0.7, label="scene units")
    kinds_axis.imshow(images["kinds"], cmap=ListedColormap(list(PIXELS.values())), vmin=-0.5, vmax=len(PIXELS) - 0.5)
    kinds_axis.set_title("kind of error")
    bare(kinds_axis)
    names = [name for index, name in enumerate(PIXELS) if (images["kinds"] == index).any()]
    colours = {PIXEL_NAMES.get(name, name): PIXELS[name] for name in names}
    patches = [Patch(facecolor=colour, edgecolor="#888888", label=name) for name, colour in colours.items()]
    kinds_axis.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, frameon=False)
    figure.suptitle(title)
    save(figure, folder / "failure.png")
