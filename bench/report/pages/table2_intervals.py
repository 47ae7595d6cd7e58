"""Table 2 with intervals: interquartile means, failures, paired ratios, ranks and tests."""

from typing import Any

import numpy as np
import pandas as pd

from bench.records import format
from bench.records.record import NOT_RUN
from bench.report.data.completions import ERROR, TABLE2, Cell, Completions, heading, shapes_per_cell
from bench.report.data.experiments import Experiment
from bench.report.data.records import Row, by_shape
from bench.report.data.statistics import (
    bootstrap,
    compare,
    holm,
    interquartile_mean,
    median,
    paired_bootstrap,
    rank,
    wilson,
)
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, text, to_table

PLACE = 30
READS = (TABLE2,)
REFERENCE = "dist_mask"  # the preset with which the other rows are compared
SEED = 0  # of the bootstrap
NOTES = (
    "Shapes with a failure: the share of shapes with a run, at any number of points, that did not end ok, with "
    "Wilson's interval.",
    "The ratio is the interquartile mean of the row over that of {reference}, for each shape's geometric mean over all "
    "numbers of points, paired by shape; it is infinite where a failure is in the middle half.",
    "The rank is the mean over shapes and points; a failed or missing run ranks last.",
    "Below: p-values of Wilcoxon's signed-rank test on these geometric means over the shapes of all families, adjusted "
    "for the number of tests (Holm).",
)


def make(experiment: Experiment) -> Result:
    """Makes the page: Table 2 with interquartile means, intervals, ratios to the reference row, and failure rates."""
    runs = Completions(experiment)
    cells = {cell: _statistics(runs, cell) for cell in runs.errors}
    reference = next((row for row in runs.rows if row.preset == REFERENCE), Row(REFERENCE, REFERENCE))
    columns = [
        *(text("family", "Family"), text("row", "Method")),
        *(Column(points, heading(points), show=_interval) for points in runs.points),
        text("failed", "Shapes with a failure"),
        text("ratio", "Ratio to the reference"),
        Column("rank", "Mean rank"),
    ]
    tests = [f"{row} is {better} than {reference.name}: p = {p:.2g}" for row, better, p in _tests(runs, reference)]
    notes = [note.format(reference=f"“{reference.name}”") for note in NOTES]
    return Result(
        title="Shape completion from one depth image, with intervals.",
        **captioned(
            experiment,
            "Interquartile mean of the error at each number of depth points.",
            interval="95 % bootstrap intervals over shapes and seeds (expanded percentiles, 2,000 draws)",
            notes=(ERROR, shapes_per_cell(runs), *notes, *tests),
        ),
        data=pd.DataFrame(cells.values(), dtype=object),
        table=to_table(columns, [line for name in runs.families for line in _lines(runs, name, cells, reference)]),
    )


def _lines(runs: Completions, name: str, cells: dict[Cell, dict[str, Any]], reference: Row) -> list[dict[str, Any]]:
    """The lines of a family, one per row."""
    ranks, lines = _ranks(runs, name), []
    for row in runs.rows_of(name):
        share = wilson(*runs.failed_shapes(name, row))
        failed = f"{100 * share.value:.0f} % [{100 * share.low:.0f}, {100 * share.high:.0f}]"
        by_points = {points: cells.get((name, row, points)) for points in runs.points}
        ratio = _ratio(runs, name, row, reference)
        lines.append(
            {"family": name, "row": row.name, **by_points, "failed": failed, "ratio": ratio, "rank": ranks[row]}
        )
    return lines


def _statistics(runs: Completions, cell: Cell) -> dict[str, Any]:
    """All statistics of a cell: a line of the CSV."""
    errors, statuses = runs.errors[cell], runs.statuses[cell]
    groups = by_shape(errors)
    mean = bootstrap(groups, interquartile_mean, seed=SEED)
    failed = statuses.total() - statuses["ok"]
    share = wilson(failed, statuses.total())
    return {
        **{"family": cell[0], "row": cell[1].name, "points": cell[2], "shapes": len(groups), "runs": len(errors)},
        **{"median": runs.median(*cell), "mean": float(np.mean([*errors.values()]))},
        **{"iqm": mean.value, "iqm_low": mean.low, "iqm_high": mean.high},
        **{"failed": failed, "failed_low": share.low, "failed_high": share.high, "not_run": statuses[NOT_RUN]},
    }


def _interval(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return format.MISSING
    return f"{format.number(cell['iqm'])} {format.interval(cell['iqm_low'], cell['iqm_high'])}".strip()


def _ratio(runs: Completions, name: str, row: Row, reference: Row) -> str:
    first, second = runs.pair(name, row, reference)
    if row == reference or not first:
        return ""
    ratio = paired_bootstrap(first, second, interquartile_mean, seed=SEED)
    return f"{format.number(ratio.value)} {format.interval(ratio.low, ratio.high)}".strip()


def _ranks(runs: Completions, name: str) -> dict[Row, float]:
    """Each row's mean rank over shapes and points; a missing run counts as a failure, so that it gives no advantage."""
    return rank(
        {
            row: {(p, run): e for p in runs.points for run, e in runs.errors.get((name, row, p), {}).items()}
            for row in runs.rows_of(name)
        }
    )


def _tests(runs: Completions, reference: Row) -> list[tuple[str, str, float]]:
    """Each row compared with the reference over the shapes of all families: better or not, and Holm's p-value."""
    found = []
    for row in runs.rows:
        pairs = [runs.pair(name, row, reference) for name in runs.families]
        first, second = ([group for pair in pairs for group in pair[side]] for side in (0, 1))
        if row != reference and first:
            wins = sum(median(a) < median(b) for a, b in zip(first, second, strict=True))
            better = f"{'better' if 2 * wins > len(first) else 'no better'} ({wins} of {len(first)} shapes)"
            found.append((row.name, better, compare(first, second)))
    adjusted = holm([p for _, _, p in found]).tolist() if found else []
    return [(row, better, p) for (row, better, _), p in zip(found, adjusted, strict=True)]
