"""Completion from depths that a scanner measured, against exact ones at the same pixels."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.records.record import RunStatus
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import ONE_WAY, SCALE, Record, error, family, grouped, index, setting
from bench.report.data.statistics import geometric_mean, median
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, configured, metrics, text, to_data, to_table

PLACE = 48
QUESTION = "Do depths that a scanner measured complete a shape as exact ones do?"
EXACT, MEASURED = "exact", "measured"  # values of task.depths
READS = (Selection("scans", ("completion",), ("dataset", "task"), ("depths",), setup=("scenes", "pixels", "machine")),)
METRICS = {"depth_mae": "depth error", ONE_WAY: "truth to prediction", "chamfer_l2": "Chamfer"}
COLUMNS = (
    text("method", "Method"),
    *(
        Column(f"{name}_{depth}", f"{label.capitalize()}, {depth}")
        for name, label in METRICS.items()
        for depth in (EXACT, MEASURED, "ratio")
    ),
    text("failed", "Failed"),
)
RUNS = (FAMILY, configured("depths", "task", "depths"), *IDENTITY, *metrics(*METRICS), *LOOP)
NOTES = (
    "Scans of one object depend on each other, so there is no interval: a ratio is the geometric mean over scans of "
    "the error with measured depths over that with exact ones.",
    "Exact depths are those of the mesh at the pixels that the scanner measured; the mask is that of the mesh in both.",
    "A run that did not end ok counts as infinite. One that was refused, as where a folder has fewer scans, does not "
    "count.",
)
Pairs = dict[str, list[tuple[float, float]]]  # by metric, a scan's error with exact and with measured depths


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per row."""
    found = {row: _pairs(records) for row, records in experiment.rows().items()}
    failed = {row: sum(r["status"] != "ok" for r in records) for row, records in experiment.rows().items()}
    lines = [
        {"method": row.name, "failed": f"{failed[row]} of {len(experiment.rows()[row])}"} | _line(pairs)
        for row, pairs in found.items()
    ]
    return Result(
        experiment,
        "Shape from depths that a scanner measured.",
        "Median errors over scans (times 1000; depths in scene units, distances between surfaces in their squares) "
        "with exact and with measured depths, and the ratio of both.",
        remarks=NOTES,
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw({(row.preset, row.name): pairs for row, pairs in found.items()}),
    )


def _pairs(records: Sequence[Record]) -> Pairs:
    """The errors of each scan of which there are runs with both kinds of depths."""
    run = [record for record in records if record["status"] != RunStatus.REFUSED]
    scans = grouped(run, lambda record: (family(record), index(record), record["seed"]))
    both = [{setting(r["config"], "task", "depths"): r for r in runs} for runs in scans.values()]
    return {
        name: [(SCALE * error(two[EXACT], name), SCALE * error(two[MEASURED], name)) for two in both if len(two) == 2]
        for name in METRICS
    }


def _line(pairs: Pairs) -> dict[str, Any]:
    line: dict[str, Any] = {}
    for name, errors in pairs.items():
        if errors:
            exact, noisy = np.array(errors).T
            line |= {f"{name}_{EXACT}": median(exact), f"{name}_{MEASURED}": median(noisy)}
            if np.isfinite(errors).all():
                line[f"{name}_ratio"] = geometric_mean(noisy / exact)
    return line


@style.styled
def draw(found: dict[tuple[str, str], Pairs]) -> Figure:
    """A panel per metric: the error with measured depths over that with exact ones, a point per scan and method."""
    figure, axes = chart.sheet(2.9, 1, len(METRICS))
    for axis, (name, label) in zip(axes[0], METRICS.items(), strict=True):
        known = [pair for pairs in found.values() for pair in pairs[name] if np.isfinite(pair).all()]
        if not known:
            chart.say(axis, "no run ended ok")
            continue
        ends = [0.8 * np.min(known), 1.25 * np.max(known)]
        axis.plot(ends, ends, color="#777777", lw=0.8, label="equal")
        for (preset, row), pairs in found.items():
            shown = [pair for pair in pairs[name] if np.isfinite(pair).all()]
            if shown:
                chart.points(axis, preset, *np.array(shown).T, ms=4, alpha=0.8, label=row)
        axis.set(title=f"{label} × 1000", xlabel="exact depths", xlim=ends, ylim=ends)
        style.log_axis(axis, "x", ends)
        style.log_axis(axis, "y", ends)
        axis.set_box_aspect(1)
    axes[0, 0].set_ylabel("measured depths")
    style.legend_below(figure, *axes.flat)
    return figure


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The ratios of the depth error with measured depths to that with exact ones, over the scans that both have."""
    errors = data.assign(depth_mae=data["depth_mae"].where(data["status"] == "ok", np.inf))
    both = errors.pivot_table("depth_mae", ["row", "index", "seed"], "depths", sort=False).dropna()
    with np.errstate(invalid="ignore"):  # where both failed neither is better
        logs = (np.log(both["measured"]) - np.log(both["exact"])).fillna(0.0).groupby("row", sort=False).mean()
    ratios = np.exp(logs).sort_values()
    if not len(ratios):
        return Answer(QUESTION)
    ends = (
        f"*{format.number(ratios.iloc[0])}* ({ratios.index[0]}) to *{format.number(ratios.iloc[-1])}* "
        f"({ratios.index[-1]})"
    )
    return Answer(
        QUESTION, f"The error of depths that a scanner measured is {ends} times that of exact ones at the same pixels."
    )
