"""Fig. 6 of DIST in numbers: the success rate of camera pose over the initial error in rotation."""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, format, records, statistics, table

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
    "Times and evaluations are those of the loop, over runs that ended ok.",
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
    """A line per method: its success rate at each angle, and its costs."""
    found = _poses(runs.made)
    rows = dict(list(found.groupby(["row", "preset"], sort=False)))
    angles = sorted(found.degrees.unique())
    settings = records.setting(runs.requested(), "task") or {}
    columns = [
        table.text("method", "Method"),
        *(table.Column(str(angle), f"{angle:g}°", show=_share) for angle in angles),
        table.Column("seconds", "Loop", show=format.seconds),
        table.Column("evaluations", "Evaluations", show=format.count),
    ]
    return Result(
        runs,
        "Camera pose from a depth image and a silhouette of a known shape.",
        PLOTTED.format(**settings),
        question="From how far off is the camera of a known shape found?",
        verdict=_verdict(found),
        interval="95 % intervals over shapes (Clopper and Pearson)",
        estimates=[_rate(own) for _, own in found.groupby(["row", "preset", "degrees"])],
        remarks=[note.format(**settings) for note in NOTES],
        columns=columns,
        lines=[_line(row, own) for (row, _), own in rows.items()],
        run_columns=RUNS,
        figure=draw(rows),
    )


def _poses(runs: Runs) -> pd.DataFrame:
    """A line per run: row, shape, angle, whether the pose was found, and costs; a failed run found none."""
    ok = (runs.frame.status == "ok").to_numpy(bool)
    return runs.frame[["row", "preset", "family", "solid"]].assign(
        degrees=runs.number("config.task.degrees"),
        starts=runs.number("config.task.starts").fillna(1),
        found=ok & (runs.number("success") == 1).to_numpy(),
        seconds=runs.frame.loop.where(ok),
        evaluations=runs.frame["values"].where(ok),
    )


def _verdict(found: pd.DataFrame) -> str:
    """The most and the fewest cameras found from the largest angle, by the number of starts, which costs apart."""
    farthest, shapes = found.degrees.max(), format.plural(len(found[["family", "solid"]].drop_duplicates()), "shape")
    said = []
    for starts, own in found[found.degrees == farthest].groupby("starts"):
        what = f"Cameras found from {farthest:g} degrees by {format.plural(int(starts), 'start')}"
        said.append(format.ends(what, own.groupby("row").found.mean(), shapes, show=table.percent, most=True))
    return " ".join(said)


def _line(row: str, own: pd.DataFrame) -> dict[str, Any]:
    """The runs of a method by their angle, and its median costs."""
    costs = own[["seconds", "evaluations"]].median()
    return {"method": row, **costs, **{str(angle): of_angle for angle, of_angle in own.groupby("degrees")}}


def _rate(found: pd.DataFrame) -> statistics.Interval:
    """The share of poses that were found, with its interval over shapes, each of which may have several views."""
    shapes = found.groupby(["family", "solid"], sort=False, dropna=False).found
    return statistics.share(shapes.sum().to_numpy(float), shapes.size().to_numpy(float))


def _share(found: pd.DataFrame | None) -> str:
    return "" if found is None else table.counted(float(found.found.sum()), len(found), _rate(found))


def draw(rows: dict[tuple[str, str], pd.DataFrame]) -> Figure:
    """Draws success over the initial angle."""
    lines = []
    for (row, preset), found in rows.items():
        rates = {angle: _rate(own).times(100) for angle, own in found.groupby("degrees")}
        lines.append(chart.curve(row, preset, rates, rates.values()))
    return chart.draw([chart.panel_data("", "initial error in rotation (degrees)", "poses found (%)", lines)], 2.8)


PAGES = {"fig6": make}
