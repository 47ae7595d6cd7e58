"""The pictures of a stress test: a rendering that succeeds and one that fails, on both sides of the breakdown."""

from base64 import b64encode
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch
from PIL import Image

from bench.pictures.style import BOTH, MISSED, PAPER, SCREEN, SPURIOUS, bare, save
from bench.records.format import number
from bench.tasks.stability.trial import Outcome, Trial

# Colours of kinds of pixels; images.npz stores the index of the kind. Names for readers, if different.
PIXELS = {"background": PAPER, "right": BOTH, "lost": MISSED, "false": SPURIOUS, "wrong surface": "#f2a600"}
PIXEL_NAMES = {"background": "no surface", "lost": "missed", "false": "spurious"}
MAX_THUMBNAIL_PIXELS = 64  # per side


@rc_context(SCREEN)
def draw_breakdown(folder: Path, trials: list[Trial], failures: list[str], *, unit: str, title: str) -> dict[str, str]:
    """Writes images.npz and failure.png: distances, true distances and kinds of errors, a line per trial.

    Args:
        trials: with images "distance", "true_distance" and "kinds", an index into `PIXELS` for each pixel.
        failures: for each of them, how many trials of its level failed, in words.
        unit: of the severity.
        title: of the figure, in lines.

    Returns:
        "works" and "breaks", the kinds of errors as a small PNG in a data URI; "works_text" and "breaks_text". If the
        trial is the first one of its level, which bench.ray draws, also the level: "works_level" and "breaks_level".
    """
    arrays, pictures = dict[str, np.ndarray](), dict[str, str]()
    figure = Figure(figsize=(9.2, 4.1 * len(trials) + 0.7), layout="constrained")
    lines = figure.subfigures(len(trials), 1, squeeze=False)[:, 0]
    for line, trial, failed in zip(lines, trials, failures, strict=True):
        name, text, images = "works" if trial.outcome.success else "breaks", _text(trial, unit), trial.outcome.images
        arrays |= {f"{name}_severity": np.array(trial.severity)} | {f"{name}_{key}": images[key] for key in images}
        pictures |= {name: _thumbnail(images["kinds"]), f"{name}_text": text}
        pictures |= {} if trial.repeat else {f"{name}_level": f"{trial.level:.6f}"}
        line.suptitle(f"{text}; {failed} at this severity\n{_counts(trial.outcome)}", fontsize=9)
        _draw_line(line, images)
    figure.suptitle(title, fontsize=9)
    save(figure, folder / "failure.png")
    np.savez_compressed(folder / "images.npz", **arrays)  # type: ignore[arg-type]
    return pictures


def _text(trial: Trial, unit: str) -> str:
    severity = f"{number(trial.severity)} {unit}"
    if trial.outcome.success:
        return f"succeeds at {severity}"
    kind = str(trial.outcome.failure)
    return f"fails at {severity} ({PIXEL_NAMES.get(kind, kind)})"


def _counts(outcome: Outcome) -> str:
    """The errors of a rendering, in words."""
    numbers, rays = outcome.numbers, outcome.images["kinds"].size
    kinds = {"missed": "lost", "on another surface": "wrong", "not a number": "nan"}
    of_hits = ", ".join(f"{numbers[key]:.0f} {words}" for words, key in kinds.items())
    return f"of {numbers['hits']:.0f} true hits on {rays} rays: {of_hits}; {numbers['false']:.0f} spurious hits"


def _draw_line(figure: SubFigure, images: dict[str, np.ndarray]) -> None:
    rendered_axis, true_axis, kinds_axis = figure.subplots(1, 3)
    true_distance = images["true_distance"]
    finite = true_distance[np.isfinite(true_distance)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    for axis, name, heading in ((rendered_axis, "distance", "rendered"), (true_axis, "true_distance", "truth")):
        shown = axis.imshow(images[name], cmap="viridis", vmin=low, vmax=max(high, low + 1e-6))
        axis.set_title(f"distance along the ray, {heading}")
        bare(axis)
        if np.isnan(images[name]).any():
            _legend_below(axis, {"no hit": PAPER})
    figure.colorbar(shown, ax=[rendered_axis, true_axis], shrink=0.7, label="scene units")
    kinds_axis.imshow(images["kinds"], cmap=ListedColormap(list(PIXELS.values())), vmin=-0.5, vmax=len(PIXELS) - 0.5)
    kinds_axis.set_title("kind of error")
    bare(kinds_axis)
    names = [name for index, name in enumerate(PIXELS) if (images["kinds"] == index).any()]
    _legend_below(kinds_axis, {PIXEL_NAMES.get(name, name): PIXELS[name] for name in names})


def _legend_below(axis: Axes, colours: dict[str, str]) -> None:
    patches = [Patch(facecolor=colour, edgecolor="#888888", label=name) for name, colour in colours.items()]
    style = {"frameon": False, "fontsize": 8, "columnspacing": 1.2, "handlelength": 1.5}
    axis.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=3, **style)


def _thumbnail(kinds: np.ndarray) -> str:
    """A PNG of at most 64 x 64 pixels in a data URI; each pixel has the largest index of the pixels that it covers."""
    factor = -(-max(kinds.shape) // MAX_THUMBNAIL_PIXELS)
    padded = np.pad(kinds, [(0, -side % factor) for side in kinds.shape])
    height, width = (side // factor for side in padded.shape)
    image = Image.fromarray(padded.reshape(height, factor, width, factor).max(axis=(1, 3)), mode="P")
    image.putpalette([round(255 * channel) for colour in PIXELS.values() for channel in to_rgb(colour)])
    file = BytesIO()
    image.save(file, "PNG", optimize=True)
    return f"data:image/png;base64,{b64encode(file.getvalue()).decode()}"
