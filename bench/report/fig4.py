"""Figure 4: what each strategy of sphere tracing does to the picture."""

import textwrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import pictures, style
from bench.report.caption import joined, omitted, outcome, setup
from bench.report.experiments import Experiment, identity, measured
from bench.report.tables import Result

TITLE = "What each strategy does to the picture."
CAPTION = (
    "Above, normals (right, up, towards the camera as red, green, blue); below, the angle to the reference's normals. "
    "Shown is the part of the picture that holds every hit. A row that did not finish at the asked size is shown at "
    "the largest at which it did."
)
MOST_COLUMNS = 5


def make(experiment: Experiment) -> Result:
    """The reference and a column a row; rows without pictures keep their place."""
    chosen = experiment.of_newest_scene()
    cells, remarks = pictures.cells(chosen.names(), [chosen.folder(record) for record in chosen.records])
    rows = [_row(record, cell) for record, cell in zip(chosen.records, cells[1:], strict=True)]
    return Result(
        name="fig4",
        title=TITLE,
        caption=joined(setup(chosen), CAPTION, outcome(chosen), omitted(chosen), *remarks),
        data=pd.DataFrame(rows, dtype=object),
        figure=draw([titled(cell, record) for cell, record in zip(cells, [None, *chosen.records], strict=True)]),
    )


@style.styled
def draw(cells: list[pictures.Cell]) -> Figure:
    """Pictures in as few lines of at most `MOST_COLUMNS` as they need."""
    lines = -(-len(cells) // MOST_COLUMNS)
    columns = -(-len(cells) // lines)
    width = style.WIDTH - 0.7  # the rest is the colour bar's
    figure = Figure(figsize=(style.WIDTH, lines * (2 * width / max(columns, 3) + 0.35)), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    pictures.draw(figure, cells, columns)
    return figure


def titled(cell: pictures.Cell, record: dict[str, Any] | None) -> pictures.Cell:
    """The cell with a title that fits its column and says what became of a run that did not end ok."""
    lines = textwrap.wrap(cell.title, 20)
    if record is not None and record["status"] != "ok":
        at = f" at {cell.images.hit.shape[0]} px" if cell.images is not None else ""
        lines.append(f"({record['status']}{at and ', shown'}{at})")
    return pictures.Cell("\n".join(lines), cell.images, cell.missing, cell.reference)


def _row(record: dict[str, Any], cell: pictures.Cell) -> dict[str, Any]:
    return identity(record) | plotted(cell) | {"depth_error_median": measured(record, "depth_error_median")}


def plotted(cell: pictures.Cell) -> dict[str, Any]:
    """The numbers of a picture: pixels of each kind, and angles in degrees; none of a row without one."""
    names = ("size", "hits", "lost", "false", "angle_median", "angle_p99", "angle_max")
    if cell.images is None:
        return dict.fromkeys(names)
    images, angles = cell.images, cell.images.angles()
    found = angles[np.isfinite(angles)]
    spread = [float(x) for x in np.percentile(found, (50, 99, 100))] if found.size else [None] * 3
    counts = [int(mask.sum()) for mask in (images.reference_hit, images.lost, images.false)]
    return dict(zip(names, [images.hit.shape[0], *counts, *spread], strict=True))
