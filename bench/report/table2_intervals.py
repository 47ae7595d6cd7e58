"""Table 2 with intervals: interquartile means, failures, paired ratios, ranks and tests."""

from typing import Any

import numpy as np
import pandas as pd

from bench.report import format
from bench.report.caption import joined, omitted, setup
from bench.report.experiments import Experiment
from bench.report.planned import NOT_RUN
from bench.report.statistics import bootstrap, compare, holm, interquartile_mean, median, paired_bootstrap, rank, wilson
from bench.report.table2_runs import ERROR, Runs, by_shape, heading, shapes_told
from bench.report.tables import Result

REFERENCE = "DIST with mask"  # what the other rows are compared with
SEED = 0  # of the bootstrap


def make(experiment: Experiment) -> Result:
    """The same with interquartile means, their intervals, ratios to the reference row, and failure rates."""
    runs = Runs(experiment)
    cells = {cell: _statistics(runs, *cell) for cell in runs.errors}
    rows = []
    for name in runs.families:
        ranks = _ranks(runs, name)
        for row in runs.rows_of(name):
            found = [cells.get((name, row, points)) for points in runs.points]
            shown = [format.MISSING if one is None else _told(one) for one in found]
            share = wilson(*runs.failed_shapes(name, row))
            failed = f"{100 * share.value:.0f} % [{100 * share.low:.0f}, {100 * share.high:.0f}]"
            rows.append([name, row, *shown, failed, _ratio(runs, name, row), format.number(ranks[row])])
    columns = [
        "Family",
        "Method",
        *map(heading, runs.points),
        "Shapes with a failure",
        "Ratio to the reference",
        "Mean rank",
    ]
    notes = [f"{row} is {better} than {REFERENCE}: p = {p:.2g}" for row, better, p in _tests(runs)]
    return Result(
        name="table2_intervals",
        title="The same, with intervals.",
        caption=joined(
            setup(experiment),
            ERROR,
            "Interquartile means with 95 % bootstrap intervals over shapes and seeds (expanded percentiles, 2,000 "
            "draws). Shapes with a failure: the share of them of which a run at any number of points did not end ok, "
            "with Wilson's interval. The ratio is that of interquartile means of the row and of "
            f"“{REFERENCE}”, of each shape's geometric mean over all points, paired by shape; it is infinite where a "
            "failure is among the middle half. The rank is the mean over shapes and points; a run that failed, or that "
            "a row lacks, ranks last. Below, Wilcoxon's signed-rank test on these geometric means over the shapes of "
            "all families, adjusted for their number (Holm).",
            shapes_told(runs),
            omitted(experiment),
        ),
        data=pd.DataFrame(cells.values(), dtype=object),
        table=pd.DataFrame(rows, columns=columns),
        notes=notes,
    )


def _statistics(runs: Runs, *cell: str) -> dict[str, Any]:
    """Everything about a cell."""
    errors, statuses = runs.errors[cell], runs.statuses[cell]
    groups = by_shape(errors)
    mean = bootstrap(groups, interquartile_mean, seed=SEED)
    failed = statuses.total() - statuses["ok"]
    share = wilson(failed, statuses.total())
    return {
        **dict(zip(("family", "row", "points"), cell, strict=True)),
        **{
            "shapes": len(groups),
            "runs": len(errors),
            "median": runs.median(*cell),
            "mean": np.mean([*errors.values()]),
        },
        **{"mean": float(np.mean([*errors.values()])), "iqm": mean.value, "iqm_low": mean.low, "iqm_high": mean.high},
        **{"failed": failed, "failed_low": share.low, "failed_high": share.high, "not_run": statuses[NOT_RUN]},
    }


def _told(found: dict[str, Any]) -> str:
    return f"{format.number(found['iqm'])} {format.interval(found['iqm_low'], found['iqm_high'])}".strip()


def _ratio(runs: Runs, name: str, row: str) -> str:
    first, second = runs.pair(name, row, REFERENCE)
    if row == REFERENCE or not first:
        return ""
    ratio = paired_bootstrap(first, second, interquartile_mean, seed=SEED)
    return f"{format.number(ratio.value)} {format.interval(ratio.low, ratio.high)}".strip()


def _ranks(runs: Runs, name: str) -> dict[str, float]:
    """Each row's mean rank over shapes and points; what a row lacks counts as a failure, lest dropping one pays."""
    return rank(
        {
            row: {(p, run): e for p in runs.points for run, e in runs.errors.get((name, row, p), {}).items()}
            for row in runs.rows_of(name)
        }
    )


def _tests(runs: Runs) -> list[tuple[str, str, float]]:
    """Each row against the reference over the shapes of all families: better or worse, and Holm's p-value."""
    found = []
    for row in runs.rows:
        pairs = [runs.pair(name, row, REFERENCE) for name in runs.families]
        first, second = ([group for pair in pairs for group in pair[side]] for side in (0, 1))
        if row != REFERENCE and first:
            wins = sum(median(a) < median(b) for a, b in zip(first, second, strict=True))
            better = f"{'better' if 2 * wins > len(first) else 'no better'} ({wins} of {len(first)} shapes)"
            found.append((row, better, compare(first, second)))
    adjusted = holm([p for _, _, p in found]).tolist() if found else []
    return [(row, better, p) for (row, better, _), p in zip(found, adjusted, strict=True)]
