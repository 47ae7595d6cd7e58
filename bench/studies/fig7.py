"""Fig. 7 of DIST: erosion and dilation of the rendered shape by the convergence threshold epsilon."""

import math
from dataclasses import replace
from typing import Any

import pandas as pd
from matplotlib.figure import Figure, SubFigure

from bench.report.study import Result, Runs, Selection, chart, gallery, records, style, table

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
    found = gallery.compared(chosen, chosen.names(), MOST_COLUMNS)
    data = table.to_data(COLUMNS, zip(chosen.records, map(_counts, chosen.records, found.counts), strict=True))
    return Result(
        chosen,
        "Erosion and dilation of the image by the convergence threshold.",
        "Pictures from the largest epsilon to the smallest, normals (right, up, towards the camera as red, green, "
        "blue) above the angle to the reference's, and erosion and dilation over epsilon.",
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
    """Draws pictures above, and erosion and dilation over epsilon below."""
    figure = gallery.draw(found.blocks, largest=found.largest, below=2.0)
    _chart(figure.subfigs[1], data[data["epsilon"].notna()])
    return figure


def _chart(figure: SubFigure, data: pd.DataFrame) -> None:
    axis = figure.subplots()
    renderers = list(data.groupby("renderer", sort=False))
    for name, rows in renderers:
        for key, colour, face, label in KINDS:
            percent = [100 * x for x in style.finite(rows[f"{key}_share"])]
            how = {"color": colour, "mfc": face, "clip_on": False, "zorder": 3}
            label = f"{label}, {name}" if len(renderers) > 1 else label
            chart.line(axis, str(name), style.finite(rows["epsilon"]), percent, label=label, **how)
    style.log_axis(axis, "x", data["epsilon"])
    if style.needs_log([100 * x for key, *_ in KINDS for x in style.finite(data[f"{key}_share"])]):
        axis.set_yscale("symlog", linthresh=0.1)  # so that zero can be drawn
        axis.yaxis.set_major_formatter("{x:g}")
    axis.set(xlabel="epsilon (scene units)", ylabel="pixels (% of the reference's hits)", ylim=(0, None))
    if len(data):
        axis.invert_xaxis()  # in the order of the pictures
        style.legend_below(figure, axis)


def _counts(record: records.Record, drawn: dict[str, Any]) -> dict[str, Any]:
    """The counts of a record, or else of its picture, and their shares of the reference's hits."""
    counts = drawn | {
        name: x for name in ("size", "hits", "lost", "false") if (x := records.measured(record, name)) is not None
    }
    hits = counts.get("hits")
    return counts | {f"{name}_share": counts[name] / hits for name, *_ in KINDS if hits and name in counts}


def _epsilon(record: records.Record) -> float | None:
    value = records.setting(record["config"], "renderer", "epsilon")
    return value if isinstance(value, int | float) and value > 0 else None


COLUMNS = (  # of a record and its counts
    *table.through(lambda line: line[0], *table.IDENTITY, table.Column("epsilon", value=_epsilon)),
    *table.through(lambda line: line[1], *map(table.Column, (*gallery.COUNTED, "lost_share", "false_share"))),
    *table.through(lambda line: line[0], table.metric("depth_error_median")),
)

PAGES = {"fig7": make}
