"""Fig. 6 of DIST in numbers: the success rate of camera pose over the initial error in rotation."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import (
    Record,
    Row,
    loop_seconds,
    measured,
    median_of_known,
    row_of,
    setting,
    shape,
    value_evaluations,
)
from bench.report.data.statistics import wilson
from bench.report.write.caption import WITHOUT_NETWORK, captioned
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, configured, metrics, text, to_data, to_table

PLACE = 60
READS = (Selection("fig6", ("pose", "pose_icp"), ("dataset", "task"), ("degrees",)),)
PLOTTED = (
    "Share of runs that end within {degrees:g} degrees and {distance:g} scene units of the true pose, over the initial "
    "error in rotation."
)
NOTES = (
    "The initial camera is also shifted by {shift:g}. All methods have the same shapes, views and starts, {scenes} in "
    "all. A run that did not end ok counts as a failure. Markers of one angle are drawn side by side.",
    "Times include the trials of all starts; iterative closest points run every start to its end. Times and "
    "evaluations are those of the loop, over runs that ended ok.",
)
RUNS = (
    *(FAMILY, configured("degrees", "task", "degrees"), configured("starts", "task", "starts"), *IDENTITY),
    *metrics("success", "rotation_error_deg", "translation_error", "mask_iou", "depth_mae"),
    *LOOP,
)
Cells = dict[tuple[Row, float], list[Record]]  # the runs of a method with an initial angle


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per method: its success rate at each angle, and its costs."""
    cells = _cells(experiment)
    columns = [
        text("method", "Method"),
        *(Column(str(angle), f"{angle:g}°", show=_share) for angle in sorted({angle for _, angle in cells})),
        Column("seconds", "Loop", show=format.seconds),
        Column("evaluations", "Evaluations", show=format.count),
    ]
    config = experiment.requested()
    names = {"degrees": "success_degrees", "distance": "success_distance", "shift": "shift"}
    settings = {name: setting(config, "task", key) for name, key in names.items()}
    scenes = len({shape(record) for record in experiment.records})
    return Result(
        title="Camera pose from a depth image and a silhouette of a known shape.",
        **captioned(
            experiment,
            PLOTTED.format(**settings),
            interval="Wilson's 95 % intervals",
            notes=[note.format(**settings, scenes=scenes) for note in NOTES],
            parts=WITHOUT_NETWORK,
        ),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, [_line(cells, row) for row in dict.fromkeys(row for row, _ in cells)]),
        figure=draw(cells),
    )


def _line(cells: Cells, row: Row) -> dict[str, Any]:
    selected = [record for record in _of(cells, row) if record["status"] == "ok"]
    costs = {"seconds": _median(selected, loop_seconds), "evaluations": _median(selected, value_evaluations)}
    return {"method": row.name, **{str(angle): runs for (name, angle), runs in cells.items() if name == row}, **costs}


@style.styled
def draw(cells: Cells) -> Figure:
    """Draws success over the initial angle, and over a method's median seconds."""
    figure = Figure(figsize=(style.WIDTH, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    rows = list(dict.fromkeys(row for row, _ in cells))
    for place, row in enumerate(rows):
        look, selected = style.look(row.preset), _of(cells, row)
        _rates(left, cells, row, 0.5 * (place - len(rows) / 2))
        if (seconds := _median(selected, loop_seconds)) is not None:
            right.plot(seconds, 100 * _found(selected) / len(selected), color=look.colour, marker=look.marker)
    left.set(xlabel="initial error in rotation (degrees)", ylabel="poses found (%)", ylim=(-3, 103))
    left.set_xticks(sorted({angle for _, angle in cells}))
    right.set(xlabel="loop, median (seconds)", ylabel="poses found, all angles together (%)", ylim=(-3, 103))
    style.log_axis(right, "x", [_median(selected, loop_seconds) for selected in cells.values()])
    style.legend_below(figure, left)
    return figure


def _rates(axis: Axes, cells: Cells, row: Row, offset: float) -> None:
    """Draws the success rate of a row at each angle, with a horizontal offset so that bars do not overlap."""
    look, angles = style.look(row.preset), sorted(angle for name, angle in cells if name == row)
    rates = [wilson(_found(cells[row, angle]), len(cells[row, angle])) for angle in angles]
    shares, low, high = (100 * np.array([getattr(rate, end) for rate in rates]) for end in ("value", "low", "high"))
    bars = np.maximum([shares - low, high - shares], 0)
    how = {"color": look.colour, "marker": look.marker, "ls": look.line}
    axis.errorbar(np.array(angles) + offset, shares, bars, elinewidth=0.7, label=row.name, **how)


def _cells(experiment: Experiment) -> Cells:
    cells: Cells = {}
    for record in experiment.records:
        cells.setdefault((row_of(record), float(setting(record["config"], "task", "degrees"))), []).append(record)
    return cells


def _of(cells: Cells, row: Row) -> list[Record]:
    """A method's runs at all angles."""
    return [record for (name, _), selected in cells.items() if name == row for record in selected]


def _found(records: list[Record]) -> int:
    """The number of poses that were found; a run that did not end ok counts as not found."""
    return sum(record["status"] == "ok" and measured(record, "success") == 1 for record in records)


def _share(records: list[Record] | None) -> str:
    if not records:
        return ""
    rate = wilson(_found(records), len(records))
    return f"{_found(records)} of {len(records)} {format.interval(100 * rate.low, 100 * rate.high)}"


def _median(records: list[Record], value: Callable[[Record], float | None]) -> float | None:
    return median_of_known(map(value, records))
