"""How right the gradients are: against a reference, by renderer and by the angle at which a ray meets the surface."""

import math
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import joined, omitted, outcome, setup
from bench.report.experiments import Experiment, definitions, identity, measured
from bench.report.tables import Result

BANDS = ("frontal", "oblique", "grazing", "silhouette")
ERRORS = ("cosine", "scale", "median_error", "p99_error")
COUNTS = ("pixels", "excluded")
NUMBERS = (*COUNTS, *(f"{of}_{e}" for of in ("code", "camera") for e in ERRORS), "image_cosine", "image_scale")
UNSHOWN = ("code_pooled_cosine", "camera_pooled_cosine")  # in the CSV only: a table has no room for all
TITLE = "How right the gradients are."
CAPTION = (
    "Cosine and scale compare a renderer's gradient with the true one: both are 1 where it is right. Errors are "
    "relative to the length of the true gradient. Pixels are frontal, oblique or grazing by the angle between ray and "
    "surface; the silhouette is judged as one image. "
    "A renderer without ray gradients has no camera numbers."
)
TITLES = ("gradient for the code", "gradient for the camera", "silhouette")  # of the figure's columns
# Panels of the figure: metric, what its axis says, and the value of a right gradient.
PANELS = (
    ("code_scale", "scale (ratio, right: 1)", 1.0),
    ("camera_scale", "scale (ratio, right: 1)", 1.0),
    ("image_scale", "scale (ratio, right: 1)", 1.0),
    ("code_median_error", "median relative error (ratio)", None),
    ("camera_median_error", "median relative error (ratio)", None),
    ("image_cosine", "cosine (right: 1)", 1.0),
)


def make(experiment: Experiment) -> Result:
    """A row for each renderer and band, failed runs too, and a figure of scales and errors."""
    rows = [
        {
            "name": name,
            **identity(record),
            "band": band,
            **{n: measured(record, f"{band}.{n}") for n in (*NUMBERS, *UNSHOWN)},
        }
        for name, record in zip(experiment.names(), experiment.records, strict=True)
        for band in BANDS
    ]
    data = pd.DataFrame(rows, dtype=object)
    zeros = sum((data[metric] == 0).sum() for metric, _, right in PANELS if right is None)
    unseen = f"{zeros} errors of exactly zero lie below the figure's logarithmic axes." if zeros else ""
    return Result(
        name="gradients",
        title=TITLE,
        caption=joined(setup(experiment), CAPTION, outcome(experiment), omitted(experiment), unseen),
        data=data.drop(columns="name"),
        table=pd.DataFrame([_readable(row) for row in rows]),
        notes=definitions(experiment.records, {name: _heading(name) for name in NUMBERS}),
        figure=draw(data),
    )


@style.styled
def draw(data: pd.DataFrame) -> Figure:
    """Scale above, median error below, by band, a marker a renderer; the silhouette in a column of its own."""
    figure = Figure(figsize=(style.WIDTH, 4.4), layout="constrained")
    axes = figure.subplots(2, 3, width_ratios=(3, 3, 2)).flat
    names = list(dict.fromkeys(data["name"]))
    for axis, (metric, label, right) in zip(axes, PANELS, strict=True):
        bands = BANDS[3:] if metric.startswith("image") else BANDS[:3]
        for place, name in enumerate(names):
            _points(axis, data[data["name"] == name].set_index("band"), metric, bands, (place + 0.5) / len(names) - 0.5)
        _dress(axis, label, right, bands)
    for axis, what in zip(figure.axes, TITLES, strict=False):
        axis.set_title(what)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(names), 5))
    return figure


def _points(axis: Any, rows: pd.DataFrame, metric: str, bands: tuple[str, ...], shift: float) -> None:
    look = style.look(rows["row"].iloc[0])
    values = style.finite(rows.loc[list(bands), metric])
    places = np.arange(len(bands)) + 0.7 * shift
    name, status = rows["name"].iloc[0], rows["status"].iloc[0]
    label = name if status == "ok" else f"{name} ({status})"
    axis.plot(places, values, look.marker, color=look.colour, label=label, markersize=5, clip_on=False)


def _dress(axis: Any, label: str, right: float | None, bands: tuple[str, ...]) -> None:
    axis.set(ylabel=label, xticks=range(len(bands)), xticklabels=bands, xlim=(-0.5, len(bands) - 0.5))
    axis.grid(False, axis="x")
    for edge in range(1, len(bands)):
        axis.axvline(edge - 0.5, color="#cccccc", lw=0.6)
    values = np.concatenate([line.get_ydata() for line in axis.lines if line.get_marker() not in ("", "None")])
    values = values[np.isfinite(values)]
    if not values.size:
        axis.text(0.5, 0.5, "no numbers", transform=axis.transAxes, ha="center", color="#777777")
    if right is None:
        style.log_axis(axis, "y", values)
        return
    axis.axhline(right, color="#555555", lw=0.8, ls=":", zorder=1.5)
    if values.size and np.abs(values).max() > 5:
        axis.set_yscale("symlog", linthresh=2.0)
        axis.yaxis.set_major_formatter("{x:g}")


def _readable(row: dict[str, Any]) -> dict[str, str]:
    texts = {"Renderer": row["name"], "Band": row["band"]}
    texts |= {_heading(name): _text(name, row[name]) for name in NUMBERS}
    return texts | {"Status": row["status"]}


def _text(name: str, value: float | None) -> str:
    if name.endswith("cosine") and value is not None and math.isfinite(value):
        return f"{value:.5f}"  # what matters is how little it lacks to 1
    return f"{value:.0f}" if name in COUNTS and value is not None else format.number(value)


def _heading(name: str) -> str:
    """A metric's name for a reader, such as "Code median error"."""
    return name.replace("_", " ").capitalize()
