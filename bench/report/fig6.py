"""Fig. 6 of DIST as numbers: how often a camera pose is found, over how far off it was at the start."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import counted_outcome, joined, omitted, setup
from bench.report.experiments import (
    Experiment,
    family,
    identity,
    loop_seconds,
    measured,
    median_of_known,
    row_name,
    setting,
    value_evaluations,
)
from bench.report.statistics import wilson
from bench.report.tables import Result

CAPTION = (
    "Share of runs that end within {degrees:g} degrees and {distance:g} scene units of the true pose, with Wilson's "
    "95 % interval, over the angle by which the camera is off at the start; it is shifted by {shift:g} besides. Each "
    "method has the same shapes, views and starts, {scenes} in all. Markers of one angle stand side by side. A run "
    "that did not end ok counts as not found. Starts take turns, and their trials are in the time; iterative closest "
    "points try each to its end. Times and evaluations are of the loop alone, of runs that ended ok."
)
Cells = dict[tuple[str, float], list[dict[str, Any]]]  # the runs of a method that start at an angle


def make(experiment: Experiment) -> Result:
    """A row a method: how often it succeeds at each angle, and what it costs."""
    cells = _cells(experiment)
    angles = sorted({angle for _, angle in cells})
    rows = []
    for row in dict.fromkeys(row for row, _ in cells):
        own = [record for record in _of(cells, row) if record["status"] == "ok"]
        costs = [format.seconds(_median(own, loop_seconds)), format.count(_median(own, value_evaluations))]
        rows.append([row, *(_told(cells.get((row, angle), [])) for angle in angles), *costs])
    config = experiment.asked()
    settings = {
        name: setting(config, "task", key)
        for name, key in (("degrees", "success_degrees"), ("distance", "success_distance"), ("shift", "shift"))
    }
    scenes = len({(family(record), record["config"].get("index")) for record in experiment.records})
    return Result(
        name="fig6",
        title="Camera pose from a depth image and a silhouette of a known shape.",
        caption=joined(
            setup(experiment, network=False),
            CAPTION.format(**settings, scenes=scenes),
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([_raw(record) for record in experiment.records], dtype=object),
        table=pd.DataFrame(rows, columns=["Method", *(f"{a:g}°" for a in angles), "Loop", "Evaluations"]),
        figure=draw(cells),
    )


@style.styled
def draw(cells: Cells) -> Figure:
    """Success over the angle at the start, and over the median seconds that a method takes."""
    figure = Figure(figsize=(style.WIDTH, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    rows = list(dict.fromkeys(row for row, _ in cells))
    for place, row in enumerate(rows):
        look = style.look(row)
        angles = sorted(angle for name, angle in cells if name == row)
        rates = [wilson(_found(cells[row, angle]), len(cells[row, angle])) for angle in angles]
        shares = 100 * np.array([rate.value for rate in rates])
        ends = 100 * np.array([[rate.low for rate in rates], [rate.high for rate in rates]])
        beside = np.array(angles) + 0.5 * (place - len(rows) / 2)  # so that bars do not hide each other
        bars = np.maximum([shares - ends[0], ends[1] - shares], 0)
        how = {"color": look.colour, "marker": look.marker}
        left.errorbar(beside, shares, bars, ls=look.line, elinewidth=0.7, label=row, **how)
        own = _of(cells, row)
        if (seconds := _median(own, loop_seconds)) is not None:
            right.plot(seconds, 100 * _found(own) / len(own), **how)
    left.set(xlabel="camera off at the start (degrees)", ylabel="poses found (%)", ylim=(-3, 103))
    left.set_xticks(sorted({angle for _, angle in cells}))
    right.set(xlabel="loop, median (seconds)", ylabel="poses found, all angles together (%)", ylim=(-3, 103))
    style.log_axis(right, "x", [_median(own, loop_seconds) for own in cells.values()])
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _cells(experiment: Experiment) -> Cells:
    cells: Cells = {}
    for record in experiment.records:
        cells.setdefault((row_name(record), float(setting(record["config"], "task", "degrees"))), []).append(record)
    return cells


def _of(cells: Cells, row: str) -> list[dict[str, Any]]:
    """A method's runs at all angles."""
    return [record for (name, _), own in cells.items() if name == row for record in own]


def _found(records: list[dict[str, Any]]) -> int:
    """How many poses were found; a run that did not end ok has not."""
    return sum(record["status"] == "ok" and measured(record, "success") == 1 for record in records)


def _told(records: list[dict[str, Any]]) -> str:
    if not records:
        return ""
    rate = wilson(_found(records), len(records))
    return f"{_found(records)} of {len(records)} {format.interval(100 * rate.low, 100 * rate.high)}"


def _median(records: list[dict[str, Any]], value: Callable[[dict[str, Any]], float | None]) -> float | None:
    return median_of_known(map(value, records))


def _raw(record: dict[str, Any]) -> dict[str, Any]:
    names = ("success", "rotation_error_deg", "translation_error", "mask_iou", "depth_mae")
    return {
        "family": family(record),
        "degrees": setting(record["config"], "task", "degrees"),
        "starts": setting(record["config"], "task", "starts"),
        **identity(record),
        **{name: measured(record, name) for name in names},
        "loop_seconds": loop_seconds(record),
        "value_evaluations": value_evaluations(record),
    }
