"""Figure 7: how the convergence threshold epsilon erodes or dilates what is seen."""

import math
from dataclasses import replace
from typing import Any

import pandas as pd
from matplotlib.figure import Figure, SubFigure

from bench.report import pictures, style
from bench.report.caption import joined, omitted, outcome, setup
from bench.report.experiments import Experiment, identity, measured, setting
from bench.report.fig4 import plotted, titled
from bench.report.tables import Result

TITLE = "How the convergence threshold erodes or dilates what is seen."
CAPTION = (
    "Pictures from the largest epsilon to the least: normals (right, up, towards the camera as red, green, blue), and "
    "below them the angle to the reference's. Erosion is the share of the reference's hit pixels that are lost; "
    "dilation the number of false pixels as a share of the same. The depth error is over pixels that both hit. Epsilon "
    "is in scene units."
)
MOST_COLUMNS = 8
# Lines of the chart: column, colour, fill of the marker, label.
KINDS = (("lost_share", style.LOST, style.LOST, "erosion"), ("false_share", style.FALSE, style.PAPER, "dilation"))


def make(experiment: Experiment) -> Result:
    """A column of pictures and a point of the chart for each epsilon, from the largest to the least."""
    chosen = experiment.of_newest_scene()
    chosen = replace(chosen, records=sorted(chosen.records, key=lambda record: -(_epsilon(record) or -math.inf)))
    names = [_title(record) for record in chosen.records]
    cells, remarks = pictures.cells(names, [chosen.folder(record) for record in chosen.records])
    data = pd.DataFrame([_row(r, c) for r, c in zip(chosen.records, cells[1:], strict=True)], dtype=object)
    unplaced = int(data["epsilon"].isna().sum())
    remarks += [f"Without an epsilon, and not in the chart: {unplaced} of {len(data)} rows."] if unplaced else []
    shown = [titled(cell, record) for cell, record in zip(cells, [None, *chosen.records], strict=True)]
    return Result(
        name="fig7",
        title=TITLE,
        caption=joined(setup(chosen), CAPTION, outcome(chosen), omitted(chosen), *remarks),
        data=data,
        figure=draw(shown, data),
    )


@style.styled
def draw(cells: list[pictures.Cell], data: pd.DataFrame) -> Figure:
    """Pictures above, two charts over epsilon below."""
    columns = min(len(cells), MOST_COLUMNS)
    lines = -(-len(cells) // columns)
    height = lines * (2 * (style.WIDTH - 0.7) / max(columns, 3) + 0.4)
    figure = Figure(figsize=(style.WIDTH, height + 2.2), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(height, 2.2))
    pictures.draw(above, cells, columns)
    _charts(below, data[data["epsilon"].notna()])
    return figure


def _charts(figure: SubFigure, data: pd.DataFrame) -> None:
    shares, depth = figure.subplots(1, 2)
    for name, rows in data.groupby("renderer", sort=False):
        look = style.look(name)
        epsilon = style.finite(rows["epsilon"])
        of = f", {name}" if data["renderer"].nunique() > 1 else ""
        for key, colour, face, label in KINDS:
            percent = [100 * x for x in style.finite(rows[key])]
            how = {"color": colour, "marker": look.marker, "mfc": face, "clip_on": False, "zorder": 3}
            shares.plot(epsilon, percent, look.line, label=f"{label}{of}", **how)
        error = style.finite(rows["depth_error_median"])
        depth.plot(epsilon, error, look.line, marker=look.marker, color=look.colour, label=name)
    for axis in (shares, depth):
        axis.set(xlabel="epsilon (scene units)")
        style.log_axis(axis, "x", data["epsilon"])
        if len(data):
            axis.invert_xaxis()  # as the pictures stand
            axis.legend()
    percents = [100 * x for name in ("lost_share", "false_share") for x in style.finite(data[name])]
    if style.needs_log(percents):
        shares.set_yscale("symlog", linthresh=0.1)  # zero is a value to be seen, too
        shares.yaxis.set_major_formatter("{x:g}")
    shares.set(ylabel="pixels (% of the reference's hits)", ylim=(0, None))
    depth.set(ylabel="median depth error (scene units)")
    style.log_axis(depth, "y", data["depth_error_median"])


def _row(record: dict[str, Any], cell: pictures.Cell) -> dict[str, Any]:
    """The counts are the record's, and those of the picture where the record has none."""
    counts = {name: measured(record, name) for name in ("size", "hits", "lost", "false")}
    counts |= {name: value for name, value in plotted(cell).items() if counts.get(name) is None}
    shares = {f"{name}_share": _share(counts[name], counts["hits"]) for name in ("lost", "false")}
    error = {"depth_error_median": measured(record, "depth_error_median")}
    return identity(record) | {"epsilon": _epsilon(record)} | counts | shares | error


def _share(part: float | None, whole: float | None) -> float | None:
    return part / whole if part is not None and whole else None


def _epsilon(record: dict[str, Any]) -> float | None:
    value = setting(record["config"], "renderer", "epsilon")
    return value if isinstance(value, int | float) and value > 0 else None


def _title(record: dict[str, Any]) -> str:
    epsilon = _epsilon(record)
    return f"{record['renderer']}, no epsilon" if epsilon is None else f"{epsilon:.0e}".replace("e-0", "e-")
