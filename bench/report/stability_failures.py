"""The first failure of renderers as pictures, with the truth beside: what was lost, what is false, what is wrong."""

import textwrap
import zipfile
import zlib
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bench.report import format, style
from bench.report.atlas import Atlas, Cell, atlas, title
from bench.report.caption import joined, omitted
from bench.report.experiments import Experiment
from bench.report.tables import Result

COLUMNS = 6
KINDS = {  # in the order of the numbers that a run's images.npz has
    "background": "#ffffff",
    "right": "#d0d0d0",
    "lost": style.LOST,
    "false": style.FALSE,
    "wrong surface": "#f2a600",
}
CAPTION = (
    "For each axis that judges renderings, the failure at the mildest severity among the first failures of all "
    "renderers: left what is wrong with each pixel, right the true distance (light is near). Each run's folder has the "
    "same of its own, as failure.png."
)
Images = dict[str, np.ndarray]


def make(experiment: Experiment) -> Result:
    """A pair of pictures an axis."""
    grid = atlas(experiment)
    found = {axis: first for axis in grid.axes if (first := _first(experiment, grid, axis)) is not None}
    data = [
        {"axis": axis, "row": row, "severity": float(images["severity"]), **_counted(images)}
        for axis, (row, _, images) in found.items()
    ]
    return Result(
        name="stability_failures",
        title="First failures.",
        caption=joined(CAPTION, omitted(experiment)),
        data=pd.DataFrame(data, dtype=object),
        figure=draw(grid, found) if found else None,
    )


@style.styled
def draw(grid: Atlas, found: dict[str, tuple[str, Cell, Images]]) -> Figure:
    """Pairs in rows of three."""
    pairs = COLUMNS // 2
    lines = -(-len(found) // pairs)
    figure = Figure(figsize=(style.WIDTH, 1.5 * lines + 0.4), layout="constrained")
    axes = figure.subplots(lines, COLUMNS, squeeze=False).ravel()
    for place, (axis, (row, _, images)) in enumerate(found.items()):
        wrong, true = (style.bare(a) for a in axes[2 * place : 2 * place + 2])
        wrong.imshow(images["kinds"], cmap=ListedColormap(list(KINDS.values())), vmin=-0.5, vmax=len(KINDS) - 0.5)
        true.imshow(images["true_distance"], cmap="Greys")
        wrong.set_title(f"{title(axis)}\n{row}", fontsize=6, loc="left", pad=2)
        severity = textwrap.fill(f"truth at {format.number(float(images['severity']))} {grid.unit(axis)}", 26)
        true.set_title(severity, fontsize=5.5, loc="left", pad=2)
    for spare in axes[2 * len(found) :]:
        spare.set_visible(False)
    patches = [Patch(facecolor=colour, edgecolor="#999999", label=name) for name, colour in KINDS.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(KINDS))
    return figure


def _first(experiment: Experiment, grid: Atlas, axis: str) -> tuple[str, Cell, Images] | None:
    """The renderer that failed at the mildest severity of an axis, its cell and the picture of it."""
    pairs = [(row, cell, _images(experiment, cell.record)) for row, cell in grid.on(axis) if cell.known]
    shown = [(row, cell, images) for row, cell, images in pairs if images is not None]
    return min(shown, key=lambda found: found[1].place(float(found[2]["severity"])), default=None)


def _images(experiment: Experiment, record: dict[str, Any]) -> Images | None:
    try:
        with np.load(experiment.folder(record) / "images.npz") as file:
            images = {name: file[name] for name in ("kinds", "true_distance", "severity")}
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error):
        return None
    return images if images["kinds"].shape == images["true_distance"].shape and images["kinds"].ndim == 2 else None


def _counted(images: Images) -> dict[str, int]:
    return {name: int((images["kinds"] == number).sum()) for number, name in enumerate(KINDS)}
