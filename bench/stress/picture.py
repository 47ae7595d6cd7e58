"""The mildest failure of a search as a picture, and as arrays for the report."""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bench.pictures import BOTH, FALSE, LOST, PAPER, STYLE, bare
from bench.stress.outcome import Trial

WRONG = (0.95, 0.65, 0.0)
KINDS = {"background": PAPER, "hit": BOTH, "lost": LOST, "false": FALSE, "wrong surface": WRONG}


def draw_failure(folder: Path, trial: Trial, *, title: str, unit: str) -> None:
    """Writes images.npz and failure.png: distances found and true, and what is wrong with each pixel."""
    images = trial.outcome.images
    np.savez_compressed(folder / "images.npz", severity=trial.severity, **images)  # type: ignore[arg-type]
    matplotlib.use("Agg")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.2, 3.6), layout="constrained")
        found, true, kinds = figure.subplots(1, 3)
        true_distance = images["true_distance"]
        known = true_distance[np.isfinite(true_distance)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        for axis, name, heading in ((found, "distance", "found"), (true, "true_distance", "truth")):
            shown = axis.imshow(images[name], cmap="viridis", vmin=low, vmax=max(high, low + 1e-6))
            axis.set_title(f"distance along the ray, {heading}")
            bare(axis)
        figure.colorbar(shown, ax=[found, true], shrink=0.7, label="scene units")
        kinds.imshow(images["kinds"], cmap=ListedColormap(list(KINDS.values())), vmin=-0.5, vmax=len(KINDS) - 0.5)
        kinds.set_title("what is wrong")
        bare(kinds)
        there = [name for number, name in enumerate(KINDS) if (images["kinds"] == number).any()]
        patches = [Patch(facecolor=KINDS[name], edgecolor="#888888", label=name) for name in there]
        kinds.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, frameon=False)
        failure = trial.outcome.failure
        figure.suptitle(f"{title}: first failure ({failure}) at {trial.severity:.3g} {unit}")
        figure.savefig(folder / "failure.png", dpi=110, bbox_inches="tight")
