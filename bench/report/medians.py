"""A line per row with medians, failures and costs, and a figure with a point per run."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format, metrics
from bench.report.data.records import Record, family, index
from bench.report.data.runs import Runs
from bench.report.data.statistics import median
from bench.report.write import chart
from bench.report.write.table import Column, text

COST = (
    text("failed", "Failed"),
    Column("seconds", "Loop", show=format.seconds),
    Column("evaluations", "Evaluations", show=lambda value: "none" if value == 0 else format.count(value)),
)


def scene_of(record: Record) -> str:
    """The name of a run's scene, for titles: with its number, unless it is a file's or a folder's own object."""
    dataset = record["config"].get("dataset", {})
    own = dataset.get("path") and not dataset.get("strength") and not index(record)
    return family(record) if own else f"{family(record)} {index(record)}"


def scored(runs: Runs, name: str) -> pd.Series:
    """A metric of each run; the worst, infinite or 0, where the run did not end ok, nan where it has no such number."""
    ok, worst = runs.frame.status == "ok", 0.0 if metrics.better(name) == "higher" else np.inf
    return runs.number(name).where(ok.to_numpy(bool), worst)


def medians(runs: Runs, names: Sequence[str]) -> list[dict[str, Any]]:
    """A line per row: medians of metrics, in which failed runs are worst, what failed, and the costs of other runs.

    A metric that a run lacks though it ended ok is None.
    """
    frame = runs.frame[["row", "preset"]].assign(
        **{name: scored(runs, name) for name in names},
        ok=(runs.frame.status == "ok").to_numpy(bool),
        seconds=runs.frame.loop,
        evaluations=runs.frame["values"],
    )
    lines = []
    for (row, preset), own in frame.groupby(["row", "preset"], sort=False):
        found = {name: None if own[name].isna().any() else float(median(own[name].to_numpy())) for name in names}
        spent = own[own.ok][["seconds", "evaluations"]].median()
        costs = {name: None if np.isnan(value) else float(value) for name, value in spent.items()}
        failed = f"{(~own.ok).sum()} of {len(own)}"
        lines.append({"method": row, "preset": preset, "runs": len(own), **found, "failed": failed, **costs})
    return lines


def whole(lines: Sequence[Mapping[str, Any]], name: str) -> dict[str, float | None]:
    """A median of the rows with as many runs as any, by row: those of fewer are not of the same shapes."""
    most = max((line["runs"] for line in lines), default=0)
    return {line["method"]: line[name] for line in lines if line["runs"] == most}


@style.styled
def draw_runs(runs: Runs, panels: Mapping[str, pd.Series], *, log: bool = True) -> Figure:
    """Draws a panel per measure, with a line per row: a point per run, and a bar at the median of several.

    Args:
        runs: of the rows.
        panels: of each measure its values by the label of its axis; nan is not drawn, infinite is a cross at the edge.
        log: whether an axis whose values differ by more than a factor of five is logarithmic.
    """
    rows = list(runs.rows())
    figure, (axes,) = chart.sheet(0.19 * len(rows) + 0.9, 1, len(panels), sharey=True)
    for axis, (label, values) in zip(axes, panels.items(), strict=True):
        for place, row in enumerate(rows):
            mine = ((runs.frame.row == row.name) & (runs.frame.preset == row.preset)).to_numpy() & values.notna()
            _points(axis, place, row.preset, values[mine].to_numpy(float))
        if log and style.needs_log(values, 5.0):
            style.log_axis(axis, "x", values)
        axis.set_xlabel(label)
        axis.grid(axis="y", visible=False)
    axes[0].set_yticks(range(len(rows)), [row.name for row in rows])
    axes[0].set_ylim(len(rows) - 0.4, -0.6)
    return figure


def _points(axis: Axes, place: int, preset: str, values: np.ndarray) -> None:
    where, known = _spread(place, len(values)), np.isfinite(values)
    chart.points(axis, preset, values[known], where[known], ms=3.5, alpha=0.8)
    lost = where[~known]
    chart.points(axis, preset, [0.99] * len(lost), lost, marker="x", transform=axis.get_yaxis_transform())
    middle = float(median(values)) if len(values) > 1 else np.inf
    if np.isfinite(middle):
        axis.plot([middle, middle], [place - 0.38, place + 0.38], color="#222222", lw=1.2)


def _spread(place: int, count: int) -> np.ndarray:
    return place + np.linspace(-0.25, 0.25, count) if count > 1 else np.full(count, float(place))
