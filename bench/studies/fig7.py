"""Fig. 7 of DIST: erosion and dilation of the rendered shape by the convergence threshold epsilon."""

import math
from dataclasses import replace
from typing import Any

import pandas as pd
from matplotlib.figure import Figure, SubFigure

from bench.pictures import style
from bench.report import gallery
from bench.report.data.records import Record, measured, setting
from bench.report.data.runs import Runs, Selection
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, metric, through, to_data

PLACE = 230
READS = (Selection("fig7", alike=("dataset", "view", "prior", "task")),)
NOTES = (
    "Erosion is the number of missed pixels over that of the reference's hits; dilation is the number of spurious "
    "pixels over the same.",
    "The depth error is over pixels that both hit; epsilon is in scene units.",
)
MOST_COLUMNS = 7
# Lines of the chart: what is counted, colour, fill of the marker, label.
KINDS = (("lost", style.MISSED, style.MISSED, "erosion"), ("false", style.SPURIOUS, style.PAPER, "dilation"))


def make(runs: Runs) -> Result:
    """A column of pictures and a point of the chart per epsilon, the largest first."""
    chosen = runs.of_newest_scene()
    chosen = replace(chosen, records=sorted(chosen.records, key=lambda record: -(_epsilon(record) or -math.inf)))
    several = len({record["renderer"] for record in chosen.records}) > 1
    found = gallery.compared(chosen, [_title(record, several=several) for record in chosen.records], MOST_COLUMNS)
    data = to_data(COLUMNS, zip(chosen.records, map(_counts, chosen.records, found.counts), strict=True))
    return Result(
        chosen,
        "Erosion and dilation of the image by the convergence threshold.",
        "Pictures from the largest epsilon to the smallest, normals (right, up, towards the camera as red, green, "
        "blue) above the angle to the reference's, and erosion, dilation and depth error over epsilon.",
        question="Which threshold of convergence shows the true outline?",
        verdict=_verdict(data),
        remarks=(*found.missing, *NOTES),
        data=data,
        figure=draw(found, data),
    )


def _verdict(data: pd.DataFrame) -> str:
    """The threshold with the fewest wrong pixels; empty where none is known."""
    wrong = (data["lost_share"] + data["false_share"]).where(data["status"] == "ok").dropna().astype(float)
    if not len(wrong):
        return ""
    best, worst = (data["epsilon"][place] for place in (wrong.idxmin(), wrong.idxmax()))
    return (
        f"Missed and spurious pixels together are fewest at epsilon = {best:g}: *{100 * wrong.min():.2g} %* of the "
        f"hits; at {worst:g} they are {100 * wrong.max():.2g} %; n = one shape."
    )


@style.styled
def draw(found: gallery.Compared, data: pd.DataFrame) -> Figure:
    """Draws pictures above and two charts over epsilon below."""
    figure = gallery.draw(found.blocks, largest=found.largest, below=2.4)
    _charts(figure.subfigs[1], data[data["epsilon"].notna()])
    return figure


def _charts(figure: SubFigure, data: pd.DataFrame) -> None:
    shares, depth = figure.subplots(1, 2)
    several = data["renderer"].nunique() > 1
    for name, rows in data.groupby("renderer", sort=False):
        epsilon = style.finite(rows["epsilon"])
        for key, colour, face, label in KINDS:
            percent = [100 * x for x in style.finite(rows[f"{key}_share"])]
            how = {"color": colour, "mfc": face, "clip_on": False, "zorder": 3}
            chart.line(shares, str(name), epsilon, percent, label=f"{label}, {name}" if several else label, **how)
        chart.line(depth, str(name), epsilon, style.finite(rows["depth_error_median"]), label=name)
    for axis in (shares, depth):
        axis.set(xlabel="epsilon (scene units)")
        style.log_axis(axis, "x", data["epsilon"])
        if len(data):
            axis.invert_xaxis()  # in the order of the pictures
    if style.needs_log([100 * x for key, *_ in KINDS for x in style.finite(data[f"{key}_share"])]):
        shares.set_yscale("symlog", linthresh=0.1)  # so that zero can be drawn
        shares.yaxis.set_major_formatter("{x:g}")
    shares.set(ylabel="pixels (% of the reference's hits)", ylim=(0, None))
    depth.set(ylabel="median depth error (scene units)")
    style.log_axis(depth, "y", data["depth_error_median"])
    if len(data):
        style.legend_below(figure, shares, depth, columns=6)


def _counts(record: Record, drawn: dict[str, Any]) -> dict[str, Any]:
    """The counts of a record, or else of its picture, and their shares of the reference's hits."""
    counts = drawn | {
        name: x for name in ("size", "hits", "lost", "false") if (x := measured(record, name)) is not None
    }
    hits = counts.get("hits")
    return counts | {f"{name}_share": counts[name] / hits for name, *_ in KINDS if hits and name in counts}


def _epsilon(record: Record) -> float | None:
    value = setting(record["config"], "renderer", "epsilon")
    return value if isinstance(value, int | float) and value > 0 else None


def _title(record: Record, *, several: bool) -> str:
    """The epsilon of a picture, with its renderer where there are several."""
    epsilon = _epsilon(record)
    words = "no epsilon" if epsilon is None else f"{epsilon:.0e}".replace("e-0", "e-")
    return f"{record['renderer']}, {words}" if several else words


COLUMNS = (  # of a record and its counts
    *through(lambda line: line[0], *IDENTITY, Column("epsilon", value=_epsilon)),
    *through(lambda line: line[1], *map(Column, (*gallery.COUNTED, "lost_share", "false_share"))),
    *through(lambda line: line[0], metric("depth_error_median")),
)

PAGES = {"fig7": make}
