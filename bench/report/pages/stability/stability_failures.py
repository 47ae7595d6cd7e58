"""The first failure on each axis as a picture of missed, spurious and wrong pixels, next to the true distance."""

import textwrap

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, Row
from bench.report.data.subjects.atlas import STABILITY, Atlas, atlas, title
from bench.report.write import chart, pictures
from bench.report.write.result import Result
from bench.report.write.table import Column, text, to_data

PLACE = 150
READS = (STABILITY,)
PICTURES = 6  # in a line of the figure
COLUMNS = (text("axis"), text("row"), Column("severity"), *(Column(kind) for kind in style.PIXELS))
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
        {"axis": axis, "row": row.name, "severity": float(images["severity"])}
        | {kind: int((images["kinds"] == number).sum()) for number, kind in enumerate(style.PIXELS)}
        for axis, (row, images) in found.items()
    ]
    return Result(
        experiment,
        "First failures.",
        "For each axis that evaluates renderings: left the kind of each pixel, right the true distance (light is "
        "near).",
        n=f"{len(found)} of {len(grid.axes)} axes",
        remarks=NOTES,
        data=to_data(COLUMNS, lines),
        figure=draw(grid, found) if found else None,
    )


@style.styled
def draw(grid: Atlas, found: dict[str, tuple[Row, Images]]) -> Figure:
    """Draws three pairs per row."""
    pairs = PICTURES // 2
    lines = -(-len(found) // pairs)
    figure, axes = chart.sheet(1.5 * lines + 0.4, lines, PICTURES)
    colours = ListedColormap(list(style.PIXELS.values()))
    for place, (axis, (row, images)) in enumerate(found.items()):
        wrong, true = (style.bare(a) for a in axes.flat[2 * place : 2 * place + 2])
        wrong.imshow(images["kinds"], cmap=colours, vmin=-0.5, vmax=len(style.PIXELS) - 0.5)
        true.imshow(images["true_distance"], cmap="Greys")
        wrong.set_title(f"{title(axis)}\n{row.name}", fontsize=6, loc="left", pad=2)
        severity = textwrap.fill(f"truth at {format.number(float(images['severity']))} {grid.unit(axis)}", 26)
        true.set_title(severity, fontsize=5.5, loc="left", pad=2)
    for spare in axes.flat[2 * len(found) :]:
        spare.set_visible(False)
    patches = [
        Patch(facecolor=colour, edgecolor="#999999", label=style.PIXEL_NAMES.get(kind, kind))
        for kind, colour in style.PIXELS.items()
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches))
    return figure


def _first(experiment: Experiment, grid: Atlas, axis: str) -> tuple[Row, Images] | None:
    """The renderer that failed at the mildest severity of an axis, and its pictures."""
    known = {row: cell for row, cell in grid.on(axis) if cell.known}
    shown = [(row, images) for row, cell in known.items() if (images := _images(experiment, cell.record)) is not None]
    return min(shown, key=lambda found: known[found[0]].place(float(found[1]["severity"])), default=None)


def _images(experiment: Experiment, record: Record) -> Images | None:
    images, why = pictures.arrays(experiment.folder(record), ("kinds", "true_distance", "severity"))
    sound = not why and images["kinds"].shape == images["true_distance"].shape and images["kinds"].ndim == 2
    return images if sound else None
