"""Fig. 7 of DIST: erosion and dilation of the rendered shape by the convergence threshold epsilon."""

import math
from dataclasses import replace
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from bench.pictures import style
from bench.report import gallery
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Record, measured, setting
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, metric, through, to_data

PLACE = 230
READS = (Selection("fig7", ("ablation",)),)
NOTES = (
    "Erosion is the number of missed pixels over that of the reference's hits; dilation is the number of spurious "
    "pixels over the same. The depth error is over pixels that both hit. Epsilon is in scene units.",
)
MOST_COLUMNS = 7
# Lines of the chart: column, colour, fill of the marker, label.
KINDS = (
    ("lost_share", style.MISSED, style.MISSED, "erosion"),
    ("false_share", style.SPURIOUS, style.PAPER, "dilation"),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a column of pictures and a point of the chart per epsilon, the largest first."""
    chosen = experiment.of_newest_scene()
    chosen = replace(chosen, records=sorted(chosen.records, key=lambda record: -(_epsilon(record) or -math.inf)))
    several = len({record["renderer"] for record in chosen.records}) > 1
    titles = [_title(record, several=several) for record in chosen.records]
    found = gallery.compared(chosen, titles, MOST_COLUMNS)
    data = to_data(COLUMNS, zip(chosen.records, map(_counts, chosen.records, found.counts), strict=True))
    unplaced = int(data["epsilon"].isna().sum())
    unplaced_note = f"Without an epsilon, and not in the chart: {unplaced} of {len(data)} rows." if unplaced else ""
    return Result(
        chosen,
        "Erosion and dilation of the image by the convergence threshold.",
        "Pictures from the largest epsilon to the smallest, normals (right, up, towards the camera as red, green, "
        "blue) above the angle to the reference's, and erosion, dilation and depth error over epsilon.",
        remarks=(*found.missing, unplaced_note, *NOTES),
        data=data,
        figure=draw(found, data),
    )


@style.styled
def draw(found: gallery.Compared, data: pd.DataFrame) -> Figure:
    """Draws pictures above and two charts over epsilon below."""
    figure = gallery.draw(found.blocks, largest=found.largest, below=2.4)
    _charts(figure.subfigs[1], data[data["epsilon"].notna()])
    return figure


def _charts(figure: SubFigure, data: pd.DataFrame) -> None:
    shares, depth = figure.subplots(1, 2)
    for name, rows in data.groupby("renderer", sort=False):
        _lines(shares, depth, rows, str(name), several=data["renderer"].nunique() > 1)
    for axis in (shares, depth):
        axis.set(xlabel="epsilon (scene units)")
        style.log_axis(axis, "x", data["epsilon"])
        if len(data):
            axis.invert_xaxis()  # in the order of the pictures
    percents = [100 * x for name in ("lost_share", "false_share") for x in style.finite(data[name])]
    if style.needs_log(percents):
        shares.set_yscale("symlog", linthresh=0.1)  # so that zero can be drawn
        shares.yaxis.set_major_formatter("{x:g}")
    shares.set(ylabel="pixels (% of the reference's hits)", ylim=(0, None))
    depth.set(ylabel="median depth error (scene units)")
    style.log_axis(depth, "y", data["depth_error_median"])
    if len(data):
        style.legend_below(figure, shares, depth, columns=6)


def _lines(shares: Axes, depth: Axes, rows: pd.DataFrame, name: str, *, several: bool) -> None:
    """Draws a renderer's lines in both charts."""
    epsilon = style.finite(rows["epsilon"])
    for key, colour, face, label in KINDS:
        percent = [100 * x for x in style.finite(rows[key])]
        how = {"color": colour, "mfc": face, "clip_on": False, "zorder": 3}
        chart.line(shares, name, epsilon, percent, label=f"{label}, {name}" if several else label, **how)
    chart.line(depth, name, epsilon, style.finite(rows["depth_error_median"]), label=name)


def _counts(record: Record, drawn: dict[str, Any]) -> dict[str, Any]:
    """The counts of a record, or else of its picture, and their shares of the reference's hits."""
    counts = {name: measured(record, name) for name in ("size", "hits", "lost", "false")}
    counts = {name: drawn.get(name) if value is None else value for name, value in counts.items()}
    return {**drawn, **counts, **{f"{name}_share": _share(counts[name], counts["hits"]) for name in ("lost", "false")}}


def _share(part: float | None, whole: float | None) -> float | None:
    return part / whole if part is not None and whole else None


def _epsilon(record: Record) -> float | None:
    value = setting(record["config"], "renderer", "epsilon")
    return value if isinstance(value, int | float) and value > 0 else None


def _title(record: Record, *, several: bool) -> str:
    """The epsilon of a picture, with its renderer where there are several."""
    epsilon = _epsilon(record)
    words = "no epsilon" if epsilon is None else f"{epsilon:.0e}".replace("e-0", "e-")
    return f"{record['renderer']}, {words}" if several or epsilon is None else words


COLUMNS = (  # of a record and its counts
    *through(lambda line: line[0], *IDENTITY, Column("epsilon", value=_epsilon)),
    *through(lambda line: line[1], *map(Column, (*gallery.COUNTED, "lost_share", "false_share"))),
    *through(lambda line: line[0], metric("depth_error_median")),
)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The threshold with the fewest wrong pixels."""
    wrong = (data["lost_share"] + data["false_share"]).where(data["status"] == "ok").dropna()
    if not len(wrong):
        return Answer("Which threshold of convergence shows the true outline?")
    best, worst = data.loc[wrong.idxmin()], data.loc[wrong.idxmax()]
    said = (
        f"Missed and spurious pixels together are fewest at epsilon = {best['epsilon']:g}: "
        f"*{100 * wrong.min():.2g} %* of the hits; at {worst['epsilon']:g} they are {100 * wrong.max():.2g} %."
    )
    return Answer("Which threshold of convergence shows the true outline?", said)
