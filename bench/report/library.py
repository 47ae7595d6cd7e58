"""Comparisons and charts of runs from Python: `bench.compare` and `bench.plot`."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from pandas.api.types import is_numeric_dtype

from bench.records.metrics import TABLE_METRICS, Metric, better_direction
from bench.records.read import read_records
from bench.records.results import RESULTS
from bench.report.data import flips
from bench.report.data.statistics import median
from bench.report.suite.attempts import gather
from bench.report.suite.standing import Standing, by_scene, units
from bench.report.sweeps import COST
from bench.report.write import chart, paper
from bench.tables import nearest

COLUMN_INCHES = 3.4  # the width of a column of a paper
PANEL_HEIGHT_INCHES, LEGEND_LINE_INCHES = 2.2, 0.15
MAX_LETTERS_IN_TWO_COLUMNS = 24
AXIS_TITLES = {
    "evaluations_cost": COST,
    "evaluations_value": "field evaluations without gradients",
    "seconds_total": "runtime (s)",
}
COSTS = ("evaluations_cost", "evaluations_value")  # older records have only the second


def compare(
    renderers: Sequence[str], results_dir: str | os.PathLike[str] = RESULTS, *, budget: float = 1.0
) -> pd.DataFrame:
    """Compares renderers on the suite, from shipped runs and those of a results folder, paired by scene.

    >>> compare(["dvr_64_early_stop", "newton"])[["versus", "scenes", "significant"]]  # doctest: +SKIP
                            versus  scenes  significant
    Newton  DVR, n = 64, early stop      24         True

    Args:
        renderers: presets or names of rows; all others are compared with the first.
        results_dir: the folder of runs by `python -m bench.suite`.
        budget: the cost that each run spends, in units of the suite.

    Returns:
        One line for each renderer after the first: `versus`, the first; `progress` and `progress_versus`, means over
        sets; `difference`, in progress, with its 95 % interval from `low` to `high`; `scenes`; `p_uncorrected`, by
        flips of the signs of scenes' differences; `significant`, as on the suite's page: after Holm's correction over
        all pairs of rows, at a total level of 0.02.

    Raises:
        ValueError: fewer than two renderers, or one is not complete on the suite at this budget.
    """
    if isinstance(renderers, str) or len(renderers) < 2:
        raise ValueError(f"bench.compare takes two renderers or more, such as ['dist', 'newton'], not {renderers!r}")
    results = Path(results_dir)
    records = read_records(results)[0] if results.is_dir() else []
    standing = Standing(gather(paper.SHIPPED, results, records))
    runs = standing.complete[standing.complete["budget"] == budget]
    pairs = runs[["preset", "row"]].drop_duplicates().drop_duplicates("preset", keep=False)
    rows = dict(zip(pairs["preset"], pairs["row"], strict=True)) | {row: row for row in runs["row"]}
    for name in renderers:
        if name not in rows:
            listed = f"complete are {', '.join(sorted({*runs['row']})) or 'none'}"
            text = f"no complete results of {name!r} on the suite at {units(budget)}{nearest(name, [*rows])}; {listed}"
            raise ValueError(f"{text}; python -m bench.suite renderer=PRESET budget={budget:g} makes the runs")
    first, *others = dict.fromkeys(rows[name] for name in renderers)
    if not others:
        raise ValueError(f"{' and '.join(renderers)} are one row, {first}: name another")
    scores = by_scene(runs)
    differences = scores[others].to_numpy() - scores[[first]].to_numpy()
    p_values = flips.p_values(differences)
    low, high = np.transpose([flips.interval(column, 0.05) for column in differences.T]) * len(scores)
    progress, ranked = scores.sum(), standing.rankings[budget]
    return pd.DataFrame(
        {
            "versus": first,
            "progress": progress[others],
            "progress_versus": progress[first],
            "difference": differences.sum(axis=0),
            "low": low,
            "high": high,
            "scenes": len(scores),
            "p_uncorrected": p_values,
            "significant": [bool({(first, row), (row, first)} & ranked.better) for row in others],
        },
        index=pd.Index(others, name="row"),
    )


def plot(runs: pd.DataFrame, *, error: str = "", cost: str = "", width: float = COLUMN_INCHES) -> Figure:
    """Draws error over cost: a small point per run that ended ok, a large one at the medians of each row of a table.

    >>> figure = plot(load())  # doctest: +SKIP
    >>> figure.savefig("error_over_cost.pdf")  # doctest: +SKIP

    Args:
        runs: runs of one task at one scale, selected from the table of `bench.load`.
        error: a metric, by default the first one that tables show, such as `chamfer_l2`.
        cost: a column such as `seconds_total`, by default the field evaluations.
        width: in inches.

    Raises:
        ValueError: the runs are of several tasks or scales, or none has the error and the cost.
    """
    if runs.empty:
        raise ValueError("there are no runs to draw")
    if lacking := [column for column in ("task", "scale", "name", "renderer", "status") if column not in runs]:
        raise ValueError(f"the table has no column {lacking[0]!r}: select rows of bench.load(), and keep its columns")
    for column in ("task", "scale"):
        if len(values := sorted({*runs[column].dropna().astype(str)})) > 1:
            raise ValueError(f"the runs have several values of {column}: {', '.join(values)}; select one")
    error = error or next((name for name in TABLE_METRICS if name in runs and runs[name].notna().any()), "")
    cost = cost or next((name for name in COSTS if name in runs and runs[name].notna().any()), "")
    for what, name in (("error", error), ("cost", cost)):
        if not name:
            raise ValueError(f"no run has a default {what}: name a column, {what}=COLUMN")
        if name not in runs or not is_numeric_dtype(runs[name]) or not runs[name].notna().any():
            raise ValueError(f"no run has the {what} {name!r}{'' if name in runs else nearest(name, [*runs.columns])}")
    metric, is_higher_better = TABLE_METRICS.get(error, Metric(error)), better_direction(error) == "higher"
    series, names = [], {str(name) for name in runs["name"].dropna()}
    endings = {name.rpartition(", ")[2] for name in names}
    shared = f", {endings.pop()}" if len(names) > 1 and len(endings) == 1 else ""  # such as one mask loss
    for name, of_row in runs.groupby("name", observed=True, sort=False):
        ok = (of_row["status"] == "ok").to_numpy(bool) & of_row[error].notna().to_numpy(bool)
        costs = of_row[cost][ok].to_numpy(float, na_value=np.nan)
        errors = metric.factor * of_row[error].to_numpy(float, na_value=np.nan)
        finals = np.where(ok, errors, 0.0 if is_higher_better else np.inf)  # failed runs are worst
        failed = f" ({int((~ok).sum())} of {len(ok)} failed)" if not ok.all() else ""
        dots = [[x, y] for x, y in zip(costs, errors[ok], strict=True) if np.isfinite(x)]
        middle = [float(np.nanmedian(costs))] if np.isfinite(costs).any() else []
        title, preset = f"{str(name).removesuffix(shared)}{failed}", str(of_row["renderer"].iloc[0])
        series.append(chart.series(title, preset, middle, [float(median(finals))] * len(middle), shapes=dots))
    panel = chart.panel_data("", AXIS_TITLES.get(cost, cost.replace("_", " ")), metric.label, series)
    panel["y"]["log"] = not is_higher_better and all(y > 0 for each in series for _, y in each["shapes"])
    legend_columns = 1 if max(len(each["name"]) for each in series) > MAX_LETTERS_IN_TWO_COLUMNS else 2
    height = PANEL_HEIGHT_INCHES + LEGEND_LINE_INCHES * -(-len(series) // legend_columns)
    return chart.draw([panel], height, legend=legend_columns, width=width)
