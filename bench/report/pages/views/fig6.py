"""Fig. 6 of DIST in numbers: the success rate of camera pose over the initial error in rotation."""

from collections.abc import Callable
from itertools import chain

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import (
    Record,
    Row,
    grouped,
    loop_seconds,
    measured,
    median_of_known,
    setting,
    shape,
    solid,
    value_evaluations,
)
from bench.report.data.statistics import Interval, share
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import (
    FAMILY,
    IDENTITY,
    LOOP,
    Column,
    configured,
    counted,
    metrics,
    text,
    to_data,
    to_table,
)

PLACE = 60
SETUP = ("scenes", "pixels", "machine")
READS = (Selection("fig6", ("pose", "pose_icp"), ("dataset", "task"), ("degrees",), setup=SETUP),)
PLOTTED = (
    "Share of runs that end within {degrees:g} degrees and {distance:g} scene units of the true pose, over the initial "
    "error in rotation."
)
NOTES = (
    "The initial camera is also shifted by {shift:g}. All methods have the same views and starts, {scenes} in all; "
    "an interval counts the views of one shape as one trial. A run that did not end ok counts as a failure. Markers of "
    "one angle are drawn side by side.",
    "Times include the trials of all starts; iterative closest points run every start to its end. Times and "
    "evaluations are those of the loop, over runs that ended ok.",
)
RUNS = (
    *(FAMILY, configured("degrees", "task", "degrees"), configured("starts", "task", "starts"), *IDENTITY),
    *metrics("success", "rotation_error_deg", "translation_error", "mask_iou", "depth_mae"),
    *LOOP,
)
Runs = dict[Row, dict[float, list[Record]]]  # of each method, by the initial angle


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per method: its success rate at each angle, and its costs."""
    runs = {row: grouped(records, _angle) for row, records in experiment.rows().items()}
    angles = sorted({_angle(record) for record in experiment.records})
    columns = [
        text("method", "Method"),
        *(Column(str(angle), f"{angle:g}°", show=_share) for angle in angles),
        Column("seconds", "Loop", show=format.seconds),
        Column("evaluations", "Evaluations", show=format.count),
    ]
    lines = []
    for row, records in experiment.rows().items():
        ended = [record for record in records if record["status"] == "ok"]
        costs = {"seconds": _median(ended, loop_seconds), "evaluations": _median(ended, value_evaluations)}
        lines.append({"method": row.name, **{str(angle): of for angle, of in runs[row].items()}, **costs})
    names = {"degrees": "success_degrees", "distance": "success_distance", "shift": "shift"}
    settings = {name: setting(experiment.requested(), "task", key) for name, key in names.items()}
    scenes = len({shape(record) for record in experiment.records})
    return Result(
        experiment,
        "Camera pose from a depth image and a silhouette of a known shape.",
        PLOTTED.format(**settings),
        interval="95 % intervals over shapes (Clopper and Pearson)",
        estimates=[_rate(of) for of_row in runs.values() for of in of_row.values()],
        remarks=[note.format(**settings, scenes=scenes) for note in NOTES],
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, lines),
        figure=draw(runs, angles),
    )


@style.styled
def draw(runs: Runs, angles: list[float]) -> Figure:
    """Draws success over the initial angle, and over a method's median seconds."""
    figure, ((left, right),) = chart.sheet(3.0, 1, 2, width_ratios=(1.6, 1))
    for place, (row, of_row) in enumerate(runs.items()):
        _rates(left, row, of_row, 0.5 * (place - len(runs) / 2))
        selected = list(chain(*of_row.values()))
        if (seconds := _median(selected, loop_seconds)) is not None:
            chart.points(right, row.preset, seconds, 100 * _found(selected) / len(selected))
    left.set(xlabel="initial error in rotation (degrees)", ylabel="poses found (%)", ylim=(-3, 103), xticks=angles)
    right.set(xlabel="loop, median (seconds)", ylabel="poses found, all angles together (%)", ylim=(-3, 103))
    style.log_axis(right, "x", [_median(of, loop_seconds) for of_row in runs.values() for of in of_row.values()])
    style.legend_below(figure, left)
    return figure


def _rates(axis: Axes, row: Row, runs: dict[float, list[Record]], offset: float) -> None:
    """Draws the success rate of a row at each angle, with a horizontal offset so that bars do not overlap."""
    angles = sorted(runs)
    rates = [_rate(runs[angle]).times(100) for angle in angles]
    chart.estimates(axis, row.preset, np.array(angles) + offset, rates, bars=True, label=row.name)


def _angle(record: Record) -> float:
    return float(setting(record["config"], "task", "degrees"))


def _found(records: list[Record]) -> int:
    """The number of poses that were found; a run that did not end ok counts as not found."""
    return sum(record["status"] == "ok" and measured(record, "success") == 1 for record in records)


def _share(records: list[Record] | None) -> str:
    if not records:
        return ""
    return counted(_found(records), len(records), _rate(records))


def _rate(records: list[Record]) -> Interval:
    """The share of poses that were found, with its interval over shapes, each of which may have several views."""
    of_shape = grouped(records, solid).values()
    return share([_found(runs) for runs in of_shape], [len(runs) for runs in of_shape])


def _median(records: list[Record], value: Callable[[Record], float | None]) -> float | None:
    return median_of_known(map(value, records))


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row that finds most cameras from the largest angle."""
    question = "From how far off is the camera of a known shape found?"
    far = data[data["degrees"] == data["degrees"].max()]
    success = (
        far["success"]
        .where(far["status"] == "ok", 0.0)
        .fillna(0.0)
        .groupby(far["row"], sort=False)
        .agg(["sum", "count"])
    )
    best, least = success.loc[success["sum"].idxmax()], success.loc[success["sum"].idxmin()]
    said = (
        f"From {far['degrees'].iloc[0]:g} degrees {best.name} finds *{best['sum']:.0f} of {best['count']:.0f}* "
        f"cameras, "
    )
    return Answer(question, f"{said}{least.name} {least['sum']:.0f} of {least['count']:.0f}.")
