"""The first failure on each axis as a picture of missed, spurious and wrong pixels, next to the true distance."""

import textwrap

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bench.pictures import style
from bench.records import format
from bench.report.data.atlas import STABILITY, Atlas, Cell, atlas, title
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, Row
from bench.report.write import pictures
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, text, to_data

PLACE = 150
READS = (STABILITY,)
PICTURES = 6  # in a line of the figure
KINDS = {  # kinds of pixels, in the order of their numbers in images.npz
    "background": style.PAPER,
    "right": style.BOTH,
    "lost": style.MISSED,
    "false": style.SPURIOUS,
    "wrong surface": style.WRONG,
}
LABELS = {"lost": "missed", "false": "spurious"}  # for readers
COLUMNS = (text("axis"), text("row"), Column("severity"), *(Column(kind) for kind in KINDS))
NOTES = (
    "Shown is the failure at the mildest severity among the first failures of all renderers. Each run's folder has its "
    "first failure as failure.png.",
)
Images = dict[str, np.ndarray]


def make(experiment: Experiment) -> Result:
    """Makes the page, with a pair of pictures per axis."""
    grid = atlas(experiment)
    found = {axis: first for axis in grid.axes if (first := _first(experiment, grid, axis)) is not None}
    lines = [
        {"axis": axis, "row": row.name, "severity": float(images["severity"]), **_counted(images)}
        for axis, (row, _, images) in found.items()
    ]
    return Result(
        title="First failures.",
        **captioned(
            experiment,
            "For each axis that evaluates renderings: left the kind of each pixel, right the true distance (light is "
            "near).",
            n=f"{len(found)} of {len(grid.axes)} axes",
            notes=NOTES,
            parts=("machine",),
        ),
        data=to_data(COLUMNS, lines),
        figure=draw(grid, found) if found else None,
    )


@style.styled
def draw(grid: Atlas, found: dict[str, tuple[Row, Cell, Images]]) -> Figure:
    """Draws three pairs per row."""
    pairs = PICTURES // 2
    lines = -(-len(found) // pairs)
    figure = Figure(figsize=(style.WIDTH, 1.5 * lines + 0.4), layout="constrained")
    axes = figure.subplots(lines, PICTURES, squeeze=False).ravel()
    for place, (axis, (row, _, images)) in enumerate(found.items()):
        wrong, true = (style.bare(a) for a in axes[2 * place : 2 * place + 2])
        wrong.imshow(images["kinds"], cmap=ListedColormap(list(KINDS.values())), vmin=-0.5, vmax=len(KINDS) - 0.5)
        true.imshow(images["true_distance"], cmap="Greys")
        wrong.set_title(f"{title(axis)}\n{row.name}", fontsize=6, loc="left", pad=2)
        severity = textwrap.fill(f"truth at {format.number(float(images['severity']))} {grid.unit(axis)}", 26)
        true.set_title(severity, fontsize=5.5, loc="left", pad=2)
    for spare in axes[2 * len(found) :]:
        spare.set_visible(False)
    patches = [
        Patch(facecolor=colour, edgecolor="#999999", label=LABELS.get(name, name)) for name, colour in KINDS.items()
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(KINDS))
    return figure


def _first(experiment: Experiment, grid: Atlas, axis: str) -> tuple[Row, Cell, Images] | None:
    """The renderer that failed at the mildest severity of an axis, its cell and its pictures."""
    pairs = [(row, cell, _images(experiment, cell.record)) for row, cell in grid.on(axis) if cell.known]
    shown = [(row, cell, images) for row, cell, images in pairs if images is not None]
    return min(shown, key=lambda found: found[1].place(float(found[2]["severity"])), default=None)


def _images(experiment: Experiment, record: Record) -> Images | None:
    images, why = pictures.arrays(experiment.folder(record), ("kinds", "true_distance", "severity"))
    sound = not why and images["kinds"].shape == images["true_distance"].shape and images["kinds"].ndim == 2
    return images if sound else None


def _counted(images: Images) -> dict[str, int]:
    return {name: int((images["kinds"] == number).sum()) for number, name in enumerate(KINDS)}
