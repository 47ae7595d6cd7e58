"""The crossing: the errors and costs of every renderer under every loss of the mask."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data import statistics
from bench.report.data.experiments import Experiment
from bench.report.data.records import SCALE, by_shape
from bench.report.data.subjects.completions import ERROR, EVERY, FAILURE, heading
from bench.report.data.subjects.crossing import CROSSING, LOSSES, Crossed
from bench.report.write import chart
from bench.report.write.answer import Answer, at_fewest_points, chart_panel, presets_of, series
from bench.report.write.result import Result
from bench.report.write.table import (
    COMPLETION,
    FAMILY,
    LOOP,
    PRESET,
    Column,
    configured,
    estimate,
    text,
    to_data,
    to_table,
)

PLACE = 32
PLACE_FRONT = 35
READS = (CROSSING,)
NOTES = (
    "Every renderer has every loss, with the numbers of conf/losses, the same weight of the task and the same "
    "settings otherwise. Under its own paper's loss: {own}.",
    "In the figure small points are shapes and large ones their medians; renderers stand from left to right in the "
    "order of the legend.",
)
RUNS = (
    *(FAMILY, configured("points", "task", "points"), configured("loss", "silhouette", "_label_")),
    *(*COMPLETION, *LOOP),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family, renderer and loss: the median at each number of points."""
    crossed = Crossed(experiment)
    labels, points = crossed.labels, crossed.runs.points
    columns = [
        *(text("family", "Family"), text("renderer", "Renderer"), text("loss", "Loss of the mask")),
        *(Column(p, heading(p)) for p in points),
        Column("cost", "Evaluations", show=format.count),
        text("failed", "Failed"),
    ]
    lines = [
        {"family": name, "renderer": labels[key[0]], "loss": labels[key[1]]}
        | {p: crossed.runs.median(name, row, p) for p in points}
        | {"cost": crossed.cost(key), "failed": "{} of {}".format(*crossed.runs.failures(name, row))}
        for name in crossed.runs.families
        for key, row in crossed.rows.items()
    ]
    own = "; ".join(f"{labels[renderer]}: {labels.get(loss, loss)}" for renderer, loss in crossed.own.items())
    return Result(
        experiment,
        "Every renderer under every loss of the mask.",
        "Median error of each renderer under each loss of the mask.",
        remarks=(ERROR, *(note.format(own=own) for note in NOTES), *LOSSES),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, lines),
        figure=draw(crossed),
    )


@style.styled
def draw(crossed: Crossed) -> Figure:
    """Draws a panel per number of points and family: each shape's error and the medians, by loss and renderer."""
    points, families = crossed.runs.points, crossed.runs.families
    figure, axes = chart.sheet(2.0 * len(points) + 0.8, len(points), len(families), sharey=True, sharex=True)
    for line, given in zip(axes, points, strict=True):
        for axis, name in zip(line, families, strict=True):
            _panel(axis, crossed, name, given)
            axis.set_title(f"{name}, {heading(given)}")
        line[0].set_ylabel("Chamfer × 1000 (scene units²)")
    for axis in axes[-1]:
        axis.set_xlabel("loss of the mask")
    style.log_axis(axes[0, 0], "y", [e for errors in crossed.runs.errors.values() for e in errors.values()])
    style.legend_below(figure, axes[0, 0])
    return figure


def _panel(axis: Axes, crossed: Crossed, name: str, points: str) -> None:
    step = 0.8 / len(crossed.renderers)
    for place, renderer in enumerate(crossed.renderers):
        x = np.arange(len(crossed.losses)) - 0.4 + step * (place + 0.5)
        cells = [(name, crossed.rows.get((renderer, loss)), points) for loss in crossed.losses]
        for at, cell in zip(x, cells, strict=True):
            errors = style.finite(crossed.runs.errors.get(cell, {}).values())
            chart.points(axis, renderer, np.full(len(errors), at), errors, ms=2, alpha=0.45, mew=0)
        medians = style.finite(crossed.runs.median(*cell) for cell in cells)
        chart.points(axis, renderer, x, medians, ms=5, label=crossed.labels[renderer])
    axis.set_xticks(range(len(crossed.losses)), [crossed.labels[x].removesuffix(" mask loss") for x in crossed.losses])
    axis.grid(False, axis="x")


def make_front(experiment: Experiment) -> Result:
    """Makes the page of the front, with a line per loss and renderer: its error over all families, and its cost."""
    crossed = Crossed(experiment)
    lines = [line for loss in crossed.losses for line in _placed(crossed, loss)]
    columns = [
        *(text("loss", "Loss of the mask"), text("renderer", "Renderer")),
        Column("evaluations", "Evaluations", show=format.count),
        *estimate("error", "Error × 1000"),
        text("front", "On the front"),
        PRESET,
    ]
    return Result(
        experiment,
        "Error over cost, under one loss at a time.",
        "Geometric mean of the errors of all shapes and numbers of points over the median number of a run's values.",
        interval="95 % intervals over shapes (Student's, of logarithms)",
        estimates=[line["error"] for line in lines],
        remarks=(
            ERROR,
            FAILURE,
            "On the front: under the same loss no other renderer has a smaller error for fewer values.",
        ),
        data=to_data(columns, lines),
        table=to_table(columns, lines),
        figure=draw_front(crossed, lines),
    )


def _placed(crossed: Crossed, loss: str) -> list[dict[str, Any]]:
    """The renderers under a loss: their errors, their costs, and whether they are on the front."""
    lines: list[dict[str, Any]] = []
    for key in (key for key in crossed.rows if key[1] == loss):
        errors = by_shape(crossed.runs.over_points(EVERY, crossed.rows[key], finite=True))
        cost = crossed.cost(key)
        if errors and cost is not None:
            found = statistics.geometric(errors)
            names = {"preset": key[0], "renderer": crossed.labels[key[0]], "loss": crossed.labels[loss]}
            lines.append(names | {"error": found, "evaluations": cost})
    front = statistics.on_front([line["evaluations"] for line in lines], [line["error"].value for line in lines])
    return [line | {"front": "yes" if on else ""} for line, on in zip(lines, front, strict=True)]


@style.styled
def draw_front(crossed: Crossed, lines: list[dict[str, Any]]) -> Figure:
    """Draws a panel per loss, with a point per renderer; filled points are on the front."""
    figure, (axes,) = chart.sheet(2.9, 1, len(crossed.losses), sharey=True, sharex=True)
    finite = [line for line in lines if np.isfinite(line["error"].value)]
    for axis, loss in zip(axes, crossed.losses, strict=True):
        own = [line for line in finite if line["loss"] == crossed.labels[loss]]
        rows, errors = [(line["preset"], line["renderer"]) for line in own], [line["error"] for line in own]
        chart.front(axis, rows, [line["evaluations"] for line in own], errors, [line["front"] for line in own])
        axis.set(title=crossed.labels[loss], xlabel="field values per run")
    axes[0].set_ylabel("Chamfer × 1000 (scene units²)")
    style.log_axis(axes[0], "x", [line["evaluations"] for line in finite])
    style.log_axis(axes[0], "y", [line["error"].value for line in finite])
    style.legend_below(figure, *axes)
    return figure


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The best pair of renderer and loss at the fewest points."""
    fewest, found = at_fewest_points(data)
    verdict = found.said(f"error from {fewest} points (Chamfer × 1000)", scale=SCALE)
    return Answer("Which renderer is best under which loss of the mask?", verdict)


def answer_front(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The renderers that are on the front under most losses."""
    front = data[data["front"] == "yes"]
    losses, counts = data["loss"].nunique(), front["renderer"].value_counts()
    said = "; ".join(f"{name} under *{n} of {losses}*" for name, n in counts.items())
    panels, presets = [], presets_of(data, "renderer")
    for loss, found in data.groupby("loss", sort=False):
        points = [
            series(
                name,
                presets[name],
                own["evaluations"],
                own["error"],
                low=own["low"].tolist(),
                high=own["high"].tolist(),
                size=9,
            )
            for name, own in found.groupby("renderer", sort=False)
        ]
        panels.append(chart_panel(loss, "field values of a run", "error × 1000", points))
    question = "Under one loss, does a renderer with fewer field values pay with a larger error?"
    return Answer(question, f"On the front of error over field values: {said} losses.", {"panels": panels})
