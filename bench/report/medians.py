"""A line per row with medians, failures and costs, and a figure with a point per run."""

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
    Column("seconds", "Loop", show=format.seconds),
    Column("evaluations", "Evaluations", show=lambda value: "none" if value == 0 else format.count(value)),
)


def scene_of(record: Record) -> str:
    """The name of a run's scene, for titles: with its number, unless it is a file's or a folder's own object."""
    dataset = record["config"].get("dataset", {})
    is_own_object = dataset.get("path") and not dataset.get("strength") and not index(record)
    return family(record) if is_own_object else f"{family(record)} {index(record)}"


def scored(runs: Runs, name: str) -> pd.Series:
    """A metric of each run; the worst, infinite or 0, where the run did not end ok, nan where it has no such number."""
    ok, worst = runs.frame.status == "ok", 0.0 if metrics.better_direction(name) == "higher" else np.inf
    return runs.number(name).where(ok.to_numpy(bool), worst)


def medians(runs: Runs, names: Sequence[str]) -> list[dict[str, Any]]:
    """A line per row: medians of metrics, in which failed runs are worst, what failed, and the costs of other runs.

    A metric that a run lacks though it ended ok is None.
    """
    runs = runs.executed
    frame = runs.frame[["row", "preset"]].assign(
        **{name: scored(runs, name) for name in names},
        ok=(runs.frame.status == "ok").to_numpy(bool),
        seconds=runs.frame.loop,
        evaluations=runs.frame["values"],
    )
    lines = []
    for (row, preset), group in frame.groupby(["row", "preset"], sort=False):
        values = {name: group[name] for name in names}
        values = {name: None if x.isna().any() else float(median(x.to_numpy())) for name, x in values.items()}
        median_costs = group[group.ok][["seconds", "evaluations"]].median()
        costs = {name: None if np.isnan(value) else float(value) for name, value in median_costs.items()}
        failed = f"{(~group.ok).sum()} of {len(group)}"
        lines.append({"method": row, "preset": preset, "runs": len(group), **values, "failed": failed, **costs})
    return lines


def errors_of(runs: Iterable[Record], metric: str) -> dict[RunKey, float]:
    """The error of each run; infinite for a failed one."""
    return {run_key(record): error(record, metric) for record in runs}


def paired_ratio(errors: Mapping[RunKey, float], others: Mapping[RunKey, float]) -> Interval | None:
    """The ratio of the errors to others over the runs that both have; None without any."""
    both = sorted(set(errors) & set(others), key=str)
    if not both:
        return None
    return ratio(*(by_shape({key: values[key] for key in both}) for values in (errors, others)))


def cost(runs: Runs) -> dict[str, pd.Series]:
    """The seconds of each run under the label of an axis; its field evaluations, if any, where times are doubtful."""
    evaluations = runs.frame["values"].where(runs.frame["values"] > 0)
    return {"seconds in the loop": runs.frame.loop} if runs.timed else {"field evaluations of the run": evaluations}


def comparable_medians(lines: Sequence[Mapping[str, Any]], name: str) -> dict[str, float | None]:
    """A median of the rows with as many runs as any, by row: those of fewer are not of the same shapes."""
    max_runs = max((line["runs"] for line in lines), default=0)
    return {line["method"]: line[name] for line in lines if line["runs"] == max_runs}


def draw_runs(
    runs: Runs, panels: Mapping[str, pd.Series], rows: Sequence[Row] | None = None, *, log: bool = True
) -> Figure:
    """Draws a panel per measure, with a line per row: a point per run, and a bar at the median of several.

    Args:
        panels: of each measure its values by the label of its axis; nan is not drawn, infinite is at the edge.
        rows: from above, all of them; by default in the order of the runs.
        log: whether an axis whose values differ by a factor is logarithmic.
    """
    rows, chart_panels = list(rows or runs.rows()), []
    for label, values in panels.items():
        drawn = []
        for position, row in enumerate(rows):
            in_row = (runs.frame.row == row.name) & (runs.frame.preset == row.preset)
            row_values = values[in_row].dropna().to_numpy(float)
            spread = np.linspace(-0.25, 0.25, len(row_values)) if len(row_values) > 1 else np.zeros(len(row_values))
            drawn.append(chart.series(row.name, row.preset, row_values, position + spread))
            if len(row_values) > 1 and np.isfinite(row_median := float(median(row_values))):
                drawn.append(chart.level("median", [row_median] * 2, 0) | {"y": [position - 0.38, position + 0.38]})
        panel = chart.panel_data("", label, "", drawn, rows=[row.name for row in rows])
        panel["x"]["log"] &= log
        chart_panels.append(panel)
    return chart.draw(chart_panels, 0.19 * len(rows) + 0.9, legend=0, sharey=True)
