"""Fig. 6 of DIST in numbers: the success rate of camera pose over the initial error in rotation."""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, format, records, statistics, table

PLACE = 60
READS = (Selection("fig6", ("task.degrees",), setup=("scenes", "pixels", "machine")),)
CAPTION = (
    "Fraction of runs that end within {success_degrees:g} degrees and {success_distance:g} scene units of the true "
    "pose, over the initial error in rotation."
)
NOTES = (
    "The initial camera is also shifted by {shift:g} scene units. All methods share the views and initial cameras.",
    "An interval counts the views of one shape as one trial. A failed run has not found the pose.",
    "Costs include the trials of all starts, and are medians over runs that ended ok. Iterative closest points (ICP) "
    "run every start to its end.",
    "The table has the intervals, and the figure has none.",
)
RUNS = (
    table.FAMILY,
    table.configured("degrees", "task", "degrees"),
    table.configured("starts", "task", "starts"),
    *table.IDENTITY,
    *table.metrics("success", "rotation_error_deg", "translation_error", "mask_iou", "depth_mae"),
    *table.LOOP,
)


def make(runs: Runs) -> Result:
    poses = _poses(runs.executed)
    rows = dict(list(poses.groupby(["row", "preset"], sort=False)))
    angles = sorted(poses.degrees.unique())
    settings = records.setting(runs.requested(), "task") or {}
    columns = [
        table.text("method", "Method"),
        *(table.Column(str(angle), f"{angle:g}°", show=_share) for angle in angles),
        table.Column("seconds", "Runtime", show=format.seconds),
        table.Column("evaluations", "Field evaluations", show=format.count),
    ]
    return Result(
        runs,
        "Camera pose from a depth image and a silhouette of a known shape.",
        CAPTION.format(**settings),
        question="How often is a camera found from a wrong initial camera, if the shape is known?",
        verdict=_verdict(poses),
        interval="95 % intervals over shapes (Clopper and Pearson)",
        estimates=[_rate(row_poses) for _, row_poses in poses.groupby(["row", "preset", "degrees"])],
        remarks=[note.format(**settings) for note in NOTES],
        columns=columns,
        lines=[_line(row, row_poses) for (row, _), row_poses in rows.items()],
        run_columns=RUNS,
        figure=draw(rows),
    )


def _poses(runs: Runs) -> pd.DataFrame:
    ok = (runs.frame.status == "ok").to_numpy(bool)
    return runs.frame[["row", "preset", "family", "solid"]].assign(
        degrees=runs.number("config.task.degrees"),
        starts=runs.number("config.task.starts").fillna(1),
        success=ok & (runs.number("success") == 1).to_numpy(),
        seconds=runs.frame.loop.where(ok),
        evaluations=runs.frame["values"].where(ok),
    )


def _verdict(poses: pd.DataFrame) -> str:
    farthest, shapes = poses.degrees.max(), format.plural(len(poses[["family", "solid"]].drop_duplicates()), "shape")
    sentences = []
    for starts, group in poses[poses.degrees == farthest].groupby("starts"):
        title = f"Cameras found from {farthest:g} degrees by {format.plural(int(starts), 'start')}"
        sentences.append(
            table.extremes(title, group.groupby("row").success.mean(), shapes, show=table.percent, largest_first=True)
        )
    return " ".join(sentences)


def _line(row: str, poses: pd.DataFrame) -> dict[str, Any]:
    costs = poses[["seconds", "evaluations"]].median()
    return {"method": row, **costs, **{str(angle): angle_poses for angle, angle_poses in poses.groupby("degrees")}}


def _rate(poses: pd.DataFrame) -> statistics.Interval:
    """The fraction of poses that were found, with its interval over shapes. A shape may have several views."""
    shapes = poses.groupby(["family", "solid"], sort=False, dropna=False).success
    return statistics.share(shapes.sum().to_numpy(float), shapes.size().to_numpy(float))


def _share(poses: pd.DataFrame | None) -> str:
    return "" if poses is None else table.count_with_interval(float(poses.success.sum()), len(poses), _rate(poses))


def draw(rows: dict[tuple[str, str], pd.DataFrame]) -> Figure:
    lines = []
    for (row, preset), poses in rows.items():
        rates = {angle: 100 * _rate(angle_poses).value for angle, angle_poses in poses.groupby("degrees")}
        lines.append(chart.curve(row, preset, rates, rates.values()))
    panel = chart.panel_data("", "initial error in rotation (degrees)", "poses found (%)", lines)
    panel["x"]["log"] = False
    return chart.draw([panel], 2.8)


PAGES = {"fig6": make}
