"""Errors of gradients against central differences, by renderer and by the angle between ray and surface."""

import math

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import definitions, measured, row_of
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, shown, text, through, to_data, to_table, whole

PLACE = 200
READS = (Selection("gradients", ("gradients",)),)
ANGLES = ("frontal", "oblique", "grazing")
BANDS = (*ANGLES, "silhouette", "colour")
ERRORS = ("pooled_cosine", "pooled_scale", "cosine", "scale", "median_error", "p99_error")
COUNTS = ("pixels", "excluded")
NUMBERS = (
    *COUNTS,
    *(f"{of}_{e}" for of in ("code", "camera", "texture") for e in ERRORS),
    "image_cosine",
    "image_scale",
)
NOTES = (
    "A pooled number compares the gradients of all pixels of a band at once, as one long vector: a factor that differs "
    "between pixels lowers the pooled cosine. A pixel's own cosine cannot show this: it is 1 for any positive multiple "
    "of the true gradient.",
    "Errors are relative to the length of the true gradient. Pixels are frontal, oblique or grazing by the angle "
    "between ray and normal; the silhouette is evaluated as one image. A renderer without ray gradients has no numbers "
    "for the camera.",
    "Colour: the gradient of colours, of a random smooth paint of point and normal, at the renderer's points, towards "
    "shape (code), camera and texture. In the figure are distances alone.",
)
TITLES = ("gradient for the code", "gradient for the camera", "silhouette")  # of the figure's columns
# Panels of the figure: metric, label of the axis, and the value of an exact gradient; None where there is none.
PANELS = (
    ("code_pooled_cosine", "pooled cosine (exact: 1)", 1.0),
    ("camera_pooled_cosine", "pooled cosine (exact: 1)", 1.0),
    ("image_cosine", "cosine (exact: 1)", 1.0),
    ("code_scale", "scale (ratio, exact: 1)", 1.0),
    ("camera_scale", "scale (ratio, exact: 1)", 1.0),
    ("image_scale", "scale (ratio, exact: 1)", 1.0),
    ("code_median_error", "median relative error (ratio)", None),
    ("camera_median_error", "median relative error (ratio)", None),
    None,
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line for each renderer and band, including failed runs."""
    lines = [(record, band) for record in experiment.named() for band in BANDS]
    data = to_data(COLUMNS, lines)
    zeros = sum((data[panel[0]] == 0).sum() for panel in PANELS if panel and panel[2] is None)
    unseen = f"{zeros} errors of exactly zero lie below the figure's logarithmic axes." if zeros else ""
    return Result(
        experiment,
        "Errors of the gradients.",
        "Cosine and scale of a renderer's gradient against the true one, pooled over the pixels of a band and per "
        "pixel: all are 1 where it is exact.",
        remarks=(*NOTES, unseen, *definitions(experiment.records, {name: _heading(name) for name in NUMBERS})),
        data=data,
        table=to_table(COLUMNS, lines),
        figure=draw(data.assign(name=[r["name"] for r, _ in lines], preset=[row_of(r).preset for r, _ in lines])),
    )


@style.styled
def draw(data: pd.DataFrame) -> Figure:
    """Draws pooled cosine, scale and median error, by band, a marker per renderer; the silhouette in a third column."""
    figure, axes = chart.sheet(6.2, 3, 3, width_ratios=(3, 3, 2))
    names = list(dict.fromkeys(data["name"]))
    for axis, panel in zip(axes.flat, PANELS, strict=True):
        if panel is None:
            axis.set_visible(False)
            continue
        metric, label, right = panel
        bands = ("silhouette",) if metric.startswith("image") else ANGLES
        for place, name in enumerate(names):
            _points(axis, data[data["name"] == name].set_index("band"), metric, bands, (place + 0.5) / len(names) - 0.5)
        _dress(axis, label, right, bands)
    for axis, what in zip(axes[0], TITLES, strict=True):
        axis.set_title(what)
    style.legend_below(figure, axes[0, 0], columns=min(len(names), 5))
    return figure


def _points(axis: Axes, rows: pd.DataFrame, metric: str, bands: tuple[str, ...], shift: float) -> None:
    values = style.finite(rows.loc[list(bands), metric])
    name, status, preset = rows[["name", "status", "preset"]].iloc[0]
    label = name if status == "ok" else f"{name} ({status})"
    chart.points(axis, preset, np.arange(len(bands)) + 0.7 * shift, values, label=label, ms=5, clip_on=False)


def _dress(axis: Axes, label: str, right: float | None, bands: tuple[str, ...]) -> None:
    axis.set(ylabel=label, xticks=range(len(bands)), xticklabels=bands, xlim=(-0.5, len(bands) - 0.5))
    axis.grid(False, axis="x")
    for edge in range(1, len(bands)):
        axis.axvline(edge - 0.5, color="#cccccc", lw=0.6)
    values = np.concatenate([line.get_ydata() for line in axis.lines if line.get_marker() not in ("", "None")])
    values = values[np.isfinite(values)]
    if not values.size:
        chart.say(axis, "no numbers", va="baseline", color="#777777")
    if right is None:
        style.log_axis(axis, "y", values)
        return
    axis.axhline(right, color="#555555", lw=0.8, ls=":", zorder=1.5)
    if values.size and np.abs(values).max() > 5:
        axis.set_yscale("symlog", linthresh=2.0)
        axis.yaxis.set_major_formatter("{x:g}")


def _cosine(value: float | None) -> str:
    """A cosine with five decimals, to show small differences from 1."""
    return f"{value:.5f}" if value is not None and math.isfinite(value) else format.number(value)


def _heading(name: str) -> str:
    """A metric's name for a reader, such as "Code median error"."""
    return name.replace("_", " ").capitalize()


def _column(name: str, heading: str = "") -> Column:
    """A column of a number of each band."""
    show = whole if name in COUNTS else _cosine if name.endswith("cosine") else format.number
    return Column(name, heading, lambda line: measured(line[0], f"{line[1]}.{name}"), show)


COLUMNS = (  # of a record and a band
    shown("Renderer", lambda line: line[0]["name"]),
    *through(lambda line: line[0], *IDENTITY),
    text("band", "Band", lambda line: line[1]),
    *(_column(name, _heading(name)) for name in NUMBERS),
    shown("Status", lambda line: line[0]["status"]),
)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """How many renderers have a pooled cosine of 0.99 in every band of hits."""
    hits = data[data["band"].isin(["frontal", "oblique", "grazing"])]
    cosine = hits["code_pooled_cosine"].where(hits["status"] == "ok").fillna(-1.0)
    least = cosine.groupby(hits["row"], sort=False).min()
    worst = least.idxmin()
    said = (
        f"*{int((least >= 0.99).sum())} of {len(least)}* renderers have a pooled cosine of at least 0.99 with "
        f"the true gradient in every band of hits"
    )
    rest = f"; the least is {least[worst]:.2f}, of {worst}" if least[worst] >= 0 else f"; {worst} has none"
    return Answer("Are the gradients true?", f"{said}{rest}.")
