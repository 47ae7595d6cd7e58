"""Completion from depths that a scanner measured, against exact ones at the same pixels."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.records import ONE_WAY, SCALE
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import geometric_mean
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, configured, metrics, text, to_data, to_table

PLACE = 48
READS = (Selection("scans", ("task.depths",), setup=("scenes", "pixels", "machine")),)
METRICS = {"depth_mae": "depth error", ONE_WAY: "truth to prediction", "chamfer_l2": "Chamfer"}
EXACT, MEASURED, RATIO = "exact", "measured", "ratio"  # values of task.depths, and what is between their errors
COLUMNS = (
    text("row", "Method"),
    *(
        Column(f"{name}_{part}", f"{label.capitalize()}, {part}")
        for name, label in METRICS.items()
        for part in (EXACT, MEASURED, RATIO)
    ),
    text("failed", "Failed"),
)
RUNS = (FAMILY, configured("depths", "task", "depths"), *IDENTITY, *metrics(*METRICS), *LOOP)
NOTES = (
    "Scans of one object depend on each other, so there is no interval: a ratio is the geometric mean over scans of "
    "the error with measured depths over that with exact ones.",
    "Exact depths are those of the mesh at the pixels that the scanner measured; the mask is that of the mesh in both.",
    "A run that did not end ok counts as infinite; one that was refused does not count.",
)


def make(runs: Runs) -> Result:
    """A line per row."""
    pairs = {metric: _pairs(runs, metric) for metric in METRICS}
    lines = pd.DataFrame({"failed": _failed(runs)})
    for metric, found in pairs.items():
        medians = found.groupby("row", sort=False)[[EXACT, MEASURED]].median()
        ratio = (found[MEASURED] / found[EXACT]).groupby("row", sort=False).apply(_ratio)
        lines = lines.join(medians.assign(**{RATIO: ratio}).add_prefix(f"{metric}_"))
    lines = lines.astype(object).where(lines.notna(), None).rename_axis("row").reset_index().to_dict("records")
    return Result(
        runs,
        "Shape from depths that a scanner measured.",
        "Median errors over scans (times 1000; depths in scene units, distances between surfaces in their squares) "
        "with exact and with measured depths, and the ratio of both.",
        question="Do depths that a scanner measured complete a shape as exact ones do?",
        verdict=_verdict(pairs["depth_mae"]),
        remarks=NOTES,
        data=to_data(RUNS, runs.records),
        table=to_table(COLUMNS, lines),
        figure=draw(runs, pairs),
    )


def _pairs(runs: Runs, metric: str) -> pd.DataFrame:
    """The error with exact and with measured depths of each row, scan and seed that has runs with both."""
    frame = runs.frame.assign(error=runs.error(metric, SCALE), depths=runs.setting("task.depths"))
    kept = frame[frame.status != "refused"]
    both = kept.pivot(index=["row", "preset", "family", "solid", "view", "seed"], columns="depths", values="error")
    return both.reindex(columns=[EXACT, MEASURED]).dropna()


def _failed(runs: Runs) -> pd.Series:
    bad = runs.frame.groupby("row", sort=False).status.agg(lambda found: (found != "ok").sum())
    return bad.astype(str) + " of " + runs.frame.groupby("row", sort=False).size().astype(str)


def _ratio(ratios: pd.Series) -> float | None:
    return float(geometric_mean(ratios.to_numpy())) if np.isfinite(ratios).all() and (ratios > 0).all() else None


def _verdict(pairs: pd.DataFrame) -> str:
    """The least and the largest ratio of the depth errors; where both failed neither is better."""
    with np.errstate(invalid="ignore"):
        logs = (np.log(pairs[MEASURED]) - np.log(pairs[EXACT])).fillna(0.0).groupby("row", sort=False).mean()
    if logs.empty:
        return ""
    ends = [f"*{format.number(np.exp(logs[row]))}* ({row})" for row in (logs.idxmin(), logs.idxmax())]
    n = len(pairs.groupby(["family", "solid", "seed"]))
    return f"The depth error with measured depths is {' to '.join(ends)} times that with exact ones; n = {n} scans."


@style.styled
def draw(runs: Runs, pairs: dict[str, pd.DataFrame]) -> Figure:
    """A panel per metric: the error with measured depths over that with exact ones, a point per scan and method."""
    figure, axes = chart.sheet(2.9, 1, len(METRICS))
    for axis, (metric, label) in zip(axes[0], METRICS.items(), strict=True):
        known = pairs[metric][np.isfinite(pairs[metric]).all(axis=1)]
        if known.empty:
            chart.say(axis, "no run ended ok")
            continue
        ends = [0.8 * known.min(axis=None), 1.25 * known.max(axis=None)]
        axis.plot(ends, ends, color="#777777", lw=0.8, label="equal")
        for (row, preset), own in known.groupby(["row", "preset"], sort=False):
            chart.points(axis, preset, own[EXACT], own[MEASURED], ms=4, alpha=0.8, label=row)
        axis.set(title=f"{label} × 1000", xlabel="exact depths", xlim=ends, ylim=ends)
        style.log_axis(axis, "x", ends)
        style.log_axis(axis, "y", ends)
        axis.set_box_aspect(1)
    axes[0, 0].set_ylabel("measured depths")
    style.legend_below(figure, *axes.flat)
    return figure


PAGES = {"scans": make}
