"""Table 2 of DIST: shape completion over the sparsity of the depth image, measured and published; with intervals.

The second page has interquartile means, failures, paired ratios, ranks and tests, the third each row's wins.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records.record import NOT_RUN
from bench.report.data import statistics
from bench.report.data.experiments import Experiment
from bench.report.data.records import SCALE, Row, RunKey, by_shape, grouped, iterations_of, row_of
from bench.report.data.subjects import wins
from bench.report.data.subjects.completions import (
    ERROR,
    EVERY,
    POINTS,
    TABLE2,
    Cell,
    Completions,
    heading,
    shapes_per_cell,
)
from bench.report.data.subjects.oracle import LABEL, NOTE, oracles
from bench.report.write import chart
from bench.report.write.answer import Answer, at_fewest_points
from bench.report.write.caption import undefined
from bench.report.write.result import Result
from bench.report.write.table import (
    COMPLETION,
    FAMILY,
    LOOP,
    Column,
    configured,
    counted,
    defined,
    text,
    to_data,
    to_table,
)

PLACE = 20
PLACE_INTERVALS = 30
PLACE_WINS = 31
READS = (TABLE2,)
REFERENCE = "dist_mask"  # the preset with which the other rows are compared
SEED = 0  # of the bootstrap
# DIST (Liu et al. 2020), Table 2: median Chamfer x 1000 over 200 shapes of ShapeNet, in the order of POINTS.
PUBLISHED = {
    "sofa": {
        "DeepSDF": (5.37, 5.56, 5.50, 5.93, 6.03, 7.63),
        "DIST": (4.12, 5.75, 5.49, 5.72, 5.57, 6.95),
        "DIST with mask": (4.12, 3.98, 4.31, 3.98, 4.30, 4.94),
    },
    "plane": {
        "DeepSDF": (3.71, 3.73, 4.29, 4.44, 4.40, 5.39),
        "DIST": (2.18, 4.08, 4.81, 4.44, 4.51, 5.30),
        "DIST with mask": (2.18, 2.08, 2.62, 2.26, 2.55, 3.60),
    },
    "table": {
        "DeepSDF": (12.93, 12.78, 11.67, 12.87, 13.76, 15.77),
        "DIST": (5.37, 12.05, 11.42, 11.70, 13.76, 15.83),
        "DIST with mask": (5.37, 5.15, 5.16, 5.26, 6.33, 7.62),
    },
}
NOTES = (
    "Below six shapes the small points are the shapes. Dense depth implies the mask. “Paper's as printed” is the "
    "setting of DIST, B.4 (the mean of the squared code from the official code); conf/README.md, “The paper's setting, "
    "and the default”, says what the other rows are.",
    NOTE,
    "“Published” is DIST, Table 2: 200 shapes of ShapeNet, with another prior and camera, and another number of points "
    "per share, so it cannot be compared directly with the measured rows.",
)
INTERVAL_NOTES = (
    "Shapes with a failure: the number of shapes with a run, at any number of points, that did not end ok, with the "
    "interval of their share (Clopper and Pearson).",
    "The ratio is the interquartile mean of the row over that of {reference}, for each shape's geometric mean over all "
    "numbers of points, paired by shape; it is infinite where a failure is in the middle half.",
    "The rank is the mean over shapes and points; a failed or missing run ranks last.",
    "Below: p-values of Wilcoxon's signed-rank test on these geometric means over the shapes of all families, adjusted "
    "for the number of tests (Holm).",
)
RUNS = (
    FAMILY,
    configured("points", "task", "points"),
    *COMPLETION,
    Column("chamfer_l2_start", value=lambda record: record["metrics_start"].get("chamfer_l2")),
    *LOOP,
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and method: the median at each number of points."""
    runs = Completions(experiment)
    oracle = oracles(experiment, "chamfer_l2")
    columns = [
        *(text("family", "Family"), text("method", "Method")),
        *(Column(points, heading(points)) for points in runs.points),
        text("failed", "Failed"),
    ]
    return Result(
        experiment,
        "Shape completion from one depth image, over its sparsity.",
        "Median error over {shapes and seeds} at each number of given depth points.",
        remarks=(ERROR, shapes_per_cell(runs), _given(runs), _iterations(experiment), *NOTES),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, [line for name in runs.families for line in _lines(runs, name, oracle.get(name))]),
        figure=draw(runs, oracle),
    )


def _lines(runs: Completions, name: str, oracle: float | None) -> list[dict[str, Any]]:
    """The lines of a family: the oracle, the rows, and the published ones."""
    lines = [] if oracle is None else [{"method": LABEL, "failed": "", **dict.fromkeys(runs.points, oracle)}]
    for row in runs.rows_of(name):
        medians = {points: runs.median(name, row, points) for points in runs.points}
        lines.append({"method": row.name, "failed": "{} of {}".format(*runs.failures(name, row)), **medians})
    for row, numbers in PUBLISHED.get(name, {}).items():
        lines.append({"method": f"published: {row}", "failed": "", **dict(zip(POINTS, numbers, strict=True))})
    return [{"family": name, **line} for line in lines]


@style.styled
def draw(runs: Completions, oracle: dict[str, float]) -> Figure:
    """Draws a panel per family: medians over the number of given points, and the oracle."""
    columns = min(len(runs.families), 4)
    lines = -(-len(runs.families) // columns)
    figure, axes = chart.sheet(2.4 * lines + 0.7, lines, columns, sharey=True)
    everything = []
    for axis, name in zip(axes.flat, runs.families, strict=False):
        everything += _panel(axis, runs, name)
        if name in oracle:
            chart.reference(axis.axhline, oracle[name], 1.5, LABEL)
    for axis in axes.flat[len(runs.families) :]:
        axis.axis("off")
    for axis in axes[:, 0]:
        axis.set_ylabel("Chamfer × 1000 (scene units²)")
    style.log_axis(axes[0, 0], "y", everything)
    style.legend_below(figure, *axes.flat)
    return figure


def _panel(axis: Axes, runs: Completions, name: str) -> list[float]:
    """Draws a line per row of a family, and gives the medians."""
    given = [runs.given(name, points) for points in runs.points]
    places = range(len(given)) if None in given else given
    order, everything = np.argsort(places), []
    for row in runs.rows_of(name):
        medians = style.finite(runs.median(name, row, points) for points in runs.points)
        everything += medians
        chart.line(axis, row.preset, [places[i] for i in order], [medians[i] for i in order], label=row.name)
        chart.shapes(axis, row.preset, places, [_points(runs, name, row, points) for points in runs.points])
    axis.set(title=name, xlabel="depth points given")
    style.log_axis(axis, "x", [] if None in given else places)
    return everything


def _points(runs: Completions, name: str, row: Row, points: str) -> statistics.Interval:
    """The medians of the shapes of a cell, to be drawn below six shapes."""
    shapes = by_shape(runs.errors.get((name, row, points), {}))
    drawn = style.finite(statistics.shape_medians(shapes)) if len(shapes) < statistics.FEWEST_SHAPES else []
    return statistics.Interval(math.nan, math.nan, math.nan, tuple(drawn))


def _given(runs: Completions) -> str:
    """A note on the median numbers of points of the shares in each family."""
    families = []
    for name in runs.families:
        known = {p: runs.given(name, p) for p in runs.points if not p.isdigit()}
        if all(value is not None for value in known.values()) and known:
            families.append(f"{name} " + ", ".join(f"{p} {value:.0f}" for p, value in known.items()))
    return f"Points given, medians: {'; '.join(families)}." if families else ""


def _iterations(experiment: Experiment) -> str:
    """A note on the rows' iterations: the most frequent number, then the rows with another one."""
    found = grouped(experiment.records, iterations_of)
    names = {count: list(dict.fromkeys(row_of(record).name for record in records)) for count, records in found.items()}
    known = {count: rows for count, rows in names.items() if count is not None}
    most = max(known, key=lambda count: len(known[count]), default=None)
    others = [f"{', '.join(rows)} {count}" for count, rows in known.items() if count != most]
    return f"Iterations: {most}{'; '.join(['', *others])}." if known else ""


def make_intervals(experiment: Experiment) -> Result:
    """Makes the page of Table 2 with interquartile means, intervals, ratios to the reference row, and failure rates."""
    runs = Completions(experiment)
    means = {cell: _mean(errors) for cell, errors in runs.errors.items()}
    reference = next((row for row in runs.rows if row.preset == REFERENCE), Row(REFERENCE, REFERENCE))
    columns = [
        *(text("family", "Family"), text("row", "Method")),
        *(text(points, heading(points)) for points in runs.points),
        text("failed", "Shapes with a failure"),
        text("ratio", "Ratio to the reference"),
        Column("rank", "Mean rank", show=defined),
    ]
    notes = [note.format(reference=f"“{reference.name}”") for note in INTERVAL_NOTES]
    lines = [line for name in runs.families for line in _intervals(runs, name, means, reference)]
    return Result(
        experiment,
        "Shape completion from one depth image, with intervals.",
        "Interquartile mean of the error at each number of depth points.",
        interval="95 % bootstrap intervals over {shapes and seeds} (expanded percentiles, 2,000 draws)",
        estimates=means.values(),
        remarks=(
            *(ERROR, shapes_per_cell(runs), *notes, *_tests(runs, reference)),
            undefined(line["rank"] for line in lines),
        ),
        data=pd.DataFrame([_statistics(runs, cell, mean) for cell, mean in means.items()], dtype=object),
        table=to_table(columns, lines),
    )


def _mean(errors: dict[RunKey, float]) -> statistics.Interval:
    return statistics.bootstrap(by_shape(errors), statistics.interquartile_mean, seed=SEED)


def _intervals(
    runs: Completions, name: str, means: dict[Cell, statistics.Interval], reference: Row
) -> Iterator[dict[str, Any]]:
    """The lines of a family, one per row. Ranks are over shapes and points.

    A missing run counts in the rank as a failure, so that it gives no advantage.
    """
    errors = {
        row: {(p, run): e for p in runs.points for run, e in runs.errors.get((name, row, p), {}).items()}
        for row in runs.rows_of(name)
    }
    ranks = statistics.rank(errors, draw=lambda key: key[1])  # of points and run
    for row in errors:
        failed, shapes = runs.failed_shapes(name, row)
        first, second = runs.pair(name, row, reference)
        compared = row != reference and first
        yield {
            **{"family": name, "row": row.name, "rank": ranks[row]},
            **{points: means.get((name, row, points)) for points in runs.points},
            "failed": counted(failed, shapes, statistics.share(np.arange(shapes) < failed, np.ones(shapes))),
            "ratio": statistics.paired_bootstrap(first, second, statistics.interquartile_mean, seed=SEED)
            if compared
            else "",
        }


def _statistics(runs: Completions, cell: Cell, mean: statistics.Interval) -> dict[str, Any]:
    """All statistics of a cell: a line of the CSV."""
    errors, statuses = runs.errors[cell], runs.statuses[cell]
    failed = statuses.total() - statuses["ok"]
    lost = [np.isinf(statistics.flat([group])) for group in by_shape(errors)]
    share = statistics.share([float(group.sum()) for group in lost], [len(group) for group in lost])
    return {
        **{"family": cell[0], "row": cell[1].name, "points": cell[2]},
        **{"shapes": len(by_shape(errors)), "runs": len(errors)},
        **{"median": runs.median(*cell), "mean": float(np.mean([*errors.values()]))},
        **{"iqm": mean.value, "iqm_low": mean.low, "iqm_high": mean.high},
        **{"failed": failed, "failed_low": share.low, "failed_high": share.high, "not_run": statuses[NOT_RUN]},
    }


def _tests(runs: Completions, reference: Row) -> list[str]:
    """A note for each row: on how many shapes of all families it has the lower error; Holm's p-value."""
    found: dict[str, float] = {}
    for row in runs.rows:
        first, second = runs.pair(EVERY, row, reference)
        if row != reference and len(first) > 1:
            won = statistics.lower(*map(statistics.shape_medians, (first, second)))
            shapes = f"on {won:g} of {len(first)} shapes"
            found[f"{row.name} has a lower error than {reference.name} {shapes}"] = statistics.compare(first, second)
    adjusted = statistics.holm([*found.values()]) if found else []
    return [f"{test}: p = {p:.2g}" for test, p in zip(found, adjusted, strict=True)]


def make_wins(experiment: Experiment) -> Result:
    """Makes the page with the wins of each row against each other, all families together; the CSV has each family."""
    runs = Completions(experiment)
    of_family = {
        name: wins.duels({row: runs.all_errors(name, row) for row in runs.rows}) for name in (EVERY, *runs.families)
    }
    pooled = of_family[EVERY]
    lines = [{"family": name, **one.line} for name, found in of_family.items() for one in found if one.pairs]
    return Result(
        experiment,
        "Shape completion from one depth image, row against row.",
        "On how many of the shapes, seeds and numbers of points on which both ran a row has the lower error.",
        interval="95 % intervals over shapes (Clopper and Pearson)",
        estimates=[one.chance for one in pooled if one.pairs],
        remarks=(ERROR, wins.NOTE, undefined(one.chance.value for one in pooled if one.pairs)),
        data=pd.DataFrame(lines, dtype=object),
        table=wins.table(pooled),
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The best row at the fewest points."""
    fewest, found = at_fewest_points(data)
    verdict = found.said(f"error from {fewest} points, over all families (Chamfer × 1000)", scale=SCALE)
    return Answer("Which method completes a shape best from sparse depth?", verdict)


def answer_intervals(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row that is best in most cells."""
    question = "How sure are the errors of completion?"
    best = data.loc[data.groupby(["family", "points"])["iqm"].idxmin().dropna(), "row"].value_counts()
    cells, known = data.groupby(["family", "points"]).ngroups, int(data["iqm_low"].notna().sum())
    said = (
        f"{best.index[0]} has the lowest interquartile mean in *{best.iloc[0]} of {cells}* cells of family and points"
    )
    few = "" if known else "; with so few shapes none has an interval"
    return Answer(question, f"{said}{few}.")


def answer_wins(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row whose least share of wins against another is largest."""
    whole = data[data["family"] == EVERY]
    least = whole.loc[whole.groupby("row")["probability"].idxmin().dropna()].sort_values("probability")
    best = least.iloc[-1]
    share = f"*{100 * best['probability']:.0f} %*"
    beats = best["probability"] > 0.5
    said = (
        f"{best['row']} has the lower error than every other on most pairs; at least {share}, against {best['other']}"
        if beats
        else f"No method has the lower error than every other on most pairs: {best['row']} has {share} against "
        f"{best['other']}"
    )
    return Answer("Which method wins against which?", f"{said} (n = {best['shapes']:.0f} shapes).")
