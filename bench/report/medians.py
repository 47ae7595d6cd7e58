"""A table line per row with medians, failures and costs; and a figure with a point per run."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.records import format, metrics
from bench.report.data.records import Record, Row, RunKey, by_shape, error, family, index, run_key
from bench.report.data.runs import Runs
from bench.report.data.statistics import Interval, median, ratio
from bench.report.write import chart
from bench.report.write.table import Column, text

COST = (
    text("failed", "Failed"),
    Column("seconds", "Runtime", show=format.seconds),
    Column("evaluations", "Field evaluations", show=lambda value: "none" if value == 0 else format.count(value)),
)


def scene_of(record: Record) -> str:
    """The name of a run's scene for titles, with its index unless it is the object of a file or folder."""
    dataset = record["config"].get("dataset", {})
    is_own_object = dataset.get("path") and not dataset.get("strength") and not index(record)
    return family(record) if is_own_object else f"{family(record)} {index(record)}"


def scored(runs: Runs, name: str) -> pd.Series:
    """A metric of each run; for a failed run the worst value, infinite or 0; nan if a run lacks the metric."""
    ok, worst = runs.frame.status == "ok", 0.0 if metrics.better_direction(name) == "higher" else np.inf
    return runs.number(name).where(ok.to_numpy(bool), worst)


def medians(runs: Runs, names: Sequence[str]) -> list[dict[str, Any]]:
    """A line per row: medians of metrics (failed runs are worst; None if an ok run lacks one), failures, and costs."""
    runs = runs.executed
    frame = runs.frame[["row", "preset"]].assign(
        **{name: scored(runs, name) for name in names},
        ok=(runs.frame.status == "ok").to_numpy(bool),
        seconds=runs.frame.loop,
        evaluations=runs.frame["values"],
    )
    lines = []
    for (row, preset), group in frame.groupby(["row", "preset"], sort=False):
        values = {name: None if group[name].isna().any() else float(median(group[name].to_numpy())) for name in names}
        median_costs = group[group.ok][["seconds", "evaluations"]].median()
        costs = {name: None if np.isnan(value) else float(value) for name, value in median_costs.items()}
        failed = f"{(~group.ok).sum()} of {len(group)}"
        lines.append({"method": row, "preset": preset, "runs": len(group), **values, "failed": failed, **costs})
    return lines


def errors_of(runs: Iterable[Record], metric: str) -> dict[RunKey, float]:
    return {run_key(record): error(record, metric) for record in runs}


def paired_ratio(errors: Mapping[RunKey, float], others: Mapping[RunKey, float]) -> Interval | None:
    """The ratio of the errors to `others` over the runs of both; None without common runs."""
    both = sorted(set(errors) & set(others), key=str)
    if not both:
        return None
    return ratio(*(by_shape({key: values[key] for key in both}) for values in (errors, others)))


def cost(runs: Runs) -> dict[str, pd.Series]:
    """The seconds of each run, or its field evaluations if times are doubtful; by the label of the axis."""
    evaluations = runs.frame["values"].where(runs.frame["values"] > 0)
    return {"runtime (seconds)": runs.frame.loop} if runs.timed else {"field evaluations of the run": evaluations}


def comparable_medians(lines: Sequence[Mapping[str, Any]], name: str) -> dict[str, float | None]:
    """A median by row, of the rows with the most runs; others lack shapes."""
    max_runs = max((line["runs"] for line in lines), default=0)
    return {line["method"]: line[name] for line in lines if line["runs"] == max_runs}


def draw_runs(
    runs: Runs, panels: Mapping[str, pd.Series], rows: Sequence[Row] | None = None, *, log: bool = True
) -> Figure:
    """Draws a panel per measure and label, with a line per row: a point per run, and a bar at the median of several."""
    rows, chart_panels = list(rows or runs.rows()), []
    for label, values in panels.items():
        drawn = []
        for position, row in enumerate(rows):
            points = values[(runs.frame.row == row.name) & (runs.frame.preset == row.preset)].dropna().to_numpy(float)
            spread = np.linspace(-0.25, 0.25, len(points)) if len(points) > 1 else np.zeros(len(points))
            drawn.append(chart.series(row.name, row.preset, points, position + spread))
            if len(points) > 1 and np.isfinite(row_median := float(median(points))):
                drawn.append(chart.level("median", [row_median] * 2, 0) | {"y": [position - 0.38, position + 0.38]})
        panel = chart.panel_data("", label, "", drawn, rows=[row.name for row in rows])
        panel["x"]["log"] &= log
        chart_panels.append(panel)
    return chart.draw(chart_panels, 0.19 * len(rows) + 0.9, legend=0, sharey=True)
