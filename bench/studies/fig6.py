"""Fig. 6 of DIST in numbers: the success rate of camera pose over the initial error in rotation."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.records import Row, setting
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import Interval, share
from bench.report.medians import plural
from bench.report.write import chart
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
READS = (Selection("fig6", ("task.degrees",), setup=("scenes", "pixels", "machine")),)
PLOTTED = (
    "Share of runs that end within {success_degrees:g} degrees and {success_distance:g} scene units of the true pose, "
    "over the initial error in rotation."
)
NOTES = (
    "The initial camera is also shifted by {shift:g}; all methods have the same views and starts.",
    "An interval counts the views of one shape as one trial; a run that did not end ok is a failure.",
    "Times include the trials of all starts; iterative closest points run every start to its end.",
    "Times and evaluations are those of the loop, over runs that ended ok; markers of one angle stand side by side.",
)
RUNS = (
    *(FAMILY, configured("degrees", "task", "degrees"), configured("starts", "task", "starts"), *IDENTITY),
    *metrics("success", "rotation_error_deg", "translation_error", "mask_iou", "depth_mae"),
    *LOOP,
)


def make(runs: Runs) -> Result:
    """A line per method: its success rate at each angle, and its costs."""
    of_row = {row: _poses(runs, row) for row in runs.rows()}
    angles = sorted({angle for found in of_row.values() for angle in found.degrees})
    settings = setting(runs.requested(), "task") or {}
    columns = [
        text("method", "Method"),
        *(Column(str(angle), f"{angle:g}°", show=_share) for angle in angles),
        Column("seconds", "Loop", show=format.seconds),
        Column("evaluations", "Evaluations", show=format.count),
    ]
    lines = [{"method": row.name, **_costs(found), **_angles(found)} for row, found in of_row.items()]
    return Result(
        runs,
        "Camera pose from a depth image and a silhouette of a known shape.",
        PLOTTED.format(**settings),
        question="From how far off is the camera of a known shape found?",
        verdict=_verdict(of_row, angles[-1]),
        interval="95 % intervals over shapes (Clopper and Pearson)",
        estimates=[_rate(own) for found in of_row.values() for _, own in found.groupby("degrees")],
        remarks=[note.format(**settings) for note in NOTES],
        data=to_data(RUNS, runs.records),
        table=to_table(columns, lines),
        figure=draw(of_row, angles),
    )


def _poses(runs: Runs, row: Row) -> pd.DataFrame:
    """The runs of a row: their angle, whether the pose was found, their shape and costs; a failed run found none."""
    ok = (runs.frame.status == "ok").to_numpy(bool)
    found = runs.frame[["family", "solid"]].assign(
        degrees=runs.number("config.task.degrees"),
        found=ok & (runs.number("success") == 1).to_numpy(),
        seconds=runs.frame.loop.where(ok),
        evaluations=runs.frame["values"].where(ok),
    )
    return found[((runs.frame.row == row.name) & (runs.frame.preset == row.preset)).to_numpy()]


def _costs(found: pd.DataFrame) -> dict[str, float | None]:
    medians = {name: found[name].median() for name in ("seconds", "evaluations")}
    return {name: None if np.isnan(value) else float(value) for name, value in medians.items()}


def _angles(found: pd.DataFrame) -> dict[str, pd.DataFrame]:
    return {str(angle): own for angle, own in found.groupby("degrees")}


def _rate(found: pd.DataFrame) -> Interval:
    """The share of poses that were found, with its interval over shapes, each of which may have several views."""
    shapes = found.groupby(["family", "solid"], sort=False, dropna=False).found
    return share(shapes.sum().to_numpy(float), shapes.size().to_numpy(float))


def _share(found: pd.DataFrame | None) -> str:
    return "" if found is None else counted(found.found.sum(), len(found), _rate(found))


def _verdict(of_row: dict[Row, pd.DataFrame], angle: float) -> str:
    """The rows that find most and fewest cameras from the largest angle."""
    far = {row.name: own[own.degrees == angle] for row, own in of_row.items() if (own.degrees == angle).any()}
    most, least = (pick(far, key=lambda row: far[row].found.sum()) for pick in (max, min))
    said = {row: f"{far[row].found.sum()} of {len(far[row])}" for row in (most, least)}
    shapes = plural(len({*zip(far[most].family, far[most].solid, strict=True)}), "shape")
    return f"From {angle:g} degrees {most} finds *{said[most]}* cameras, {least} {said[least]}; n = {shapes}."


@style.styled
def draw(of_row: dict[Row, pd.DataFrame], angles: list[float]) -> Figure:
    """Draws success over the initial angle, and over a method's median seconds."""
    figure, ((left, right),) = chart.sheet(3.0, 1, 2, width_ratios=(1.6, 1))
    for place, (row, found) in enumerate(of_row.items()):
        rates = {angle: _rate(own).times(100) for angle, own in found.groupby("degrees")}
        beside = np.array(list(rates)) + 0.5 * (place - len(of_row) / 2)  # so that bars do not overlap
        chart.estimates(left, row.preset, beside, list(rates.values()), bars=True, label=row.name)
        if (seconds := _costs(found)["seconds"]) is not None:
            chart.points(right, row.preset, seconds, 100 * found.found.mean())
    left.set(xlabel="initial error in rotation (degrees)", ylabel="poses found (%)", ylim=(-3, 103), xticks=angles)
    right.set(xlabel="loop, median (seconds)", ylabel="poses found, all angles together (%)", ylim=(-3, 103))
    style.log_axis(right, "x", [_costs(found)["seconds"] for found in of_row.values()])
    style.legend_below(figure, left)
    return figure


PAGES = {"fig6": make}
