"""Every renderer under one loss of the mask, at one tuned setting: errors, ratios, and error over cost."""

import math
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data import statistics
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Row, by_shape, family, loop_seconds, median_of_known, row_of, value_evaluations
from bench.report.data.subjects.completions import ERROR, EVERY, FAILURE, Completions, heading, shapes_per_cell
from bench.report.data.subjects.wins import Gap, excluding_one, gap
from bench.report.write import chart
from bench.report.write.answer import Answer, chart_panel, excluding, series
from bench.report.write.result import Result
from bench.report.write.table import Column, estimate, text, to_data, to_table

PLACE = 21
READS = (Selection("one_loss", ("completion",), ("dataset", "task"), ("points",)),)
REFERENCE = "dist_mask"
QUESTION = "How do all renderers compare under one loss and one setting?"
COSTS = {"evaluations": "field values of a run", "seconds": "seconds of the loop"}
UNITS = {"evaluations": "values", "seconds": "seconds"}
NOTES = (
    "The ratio to DIST is that of geometric means over shapes, of each shape's geometric mean over all numbers of "
    "points; behind it the number of shapes on which the row is better, ties half.",
    "On a front, filled in the figure: no other row has a smaller error for a smaller cost. A bound of range analysis "
    "counts as three field values; seconds depend on the machine.",
    "Under this loss a renderer is its hits, their distances and the least value along each ray. Opacities take part "
    "by hits and distances alone, and bands not at all: Relaxed boundary is IDR with more steps, and what these "
    "two differ by is close to the noise of the fits, which the intervals, over shapes, do not contain.",
    "Rates and weights, one setting for all rows: _one_loss of conf/tuned.yaml, the draw that is best over some of the "
    "methods on validation shapes (`python -m bench.tune`); its first lines say from which runs. What "
    "belongs to a renderer, such as steps, samples and sharpness, stands at its default, but for DVR (64 samples, an "
    "early stop), the mesh (48³) and the relaxed boundary (100 steps).",
)
Line = dict[str, Any]


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and row, all families first."""
    runs = Completions(experiment)
    lines = [line for name in _names(runs) for line in _of(experiment, runs, name)]
    columns = [
        *(text("family", "Family"), text("row", "Method")),
        *(Column(points, heading(points)) for points in runs.points),
        *estimate("error", "Geometric mean"),
        text("ratio", "Ratio to DIST", lambda line: "" if line["ratio"] is None else str(line["ratio"])),
        *(Column(f"ratio_{end}", value=lambda line, end=end: _end(line["ratio"], end)) for end in ("low", "high")),
        Column("evaluations", "Values", show=format.count),
        Column("seconds", "Loop", show=format.seconds),
        *(text(f"front_{cost}", f"Front, {unit}") for cost, unit in UNITS.items()),
        text("failed", "Failed"),
        text("preset"),
    ]
    return Result(
        experiment,
        "Every renderer under one loss, at one tuned setting.",
        "Median error at each number of given depth points, the geometric mean of all errors, and the median cost.",
        interval="95 % intervals over shapes (Student's, of logarithms)",
        estimates=[line["error"] for line in lines],
        remarks=(*verdict(lines), ERROR, FAILURE, shapes_per_cell(runs), *NOTES),
        data=to_data(columns, lines),
        table=to_table(columns, lines),
        figure=draw(lines),
    )


def verdict(lines: list[Line]) -> list[str]:
    """The rows that differ from DIST over all families by their interval, in words."""
    pooled = [(line["row"], line["ratio"].ratio) for line in lines if line["family"] == EVERY and line["ratio"]]
    return excluding_one([(f"{row} {ratio}", ratio) for row, ratio in pooled], "to DIST over all families")


def _end(ratio: Gap | None, end: str) -> float:
    return math.nan if ratio is None else getattr(ratio.ratio, end)


def _names(runs: Completions) -> list[str]:
    return [EVERY, *runs.families] if len(runs.families) > 1 else runs.families


def _of(experiment: Experiment, runs: Completions, name: str) -> list[Line]:
    """The lines of a family, with what is on its front."""
    lines = [_line(experiment, runs, name, row) for row in runs.rows]
    for cost in COSTS:
        front = statistics.on_front([line[cost] for line in lines], [line["error"].value for line in lines])
        lines = [line | {f"front_{cost}": "yes" if on else ""} for line, on in zip(lines, front, strict=True)]
    return lines


def _line(experiment: Experiment, runs: Completions, name: str, row: Row) -> Line:
    families = runs.families if name == EVERY else [name]
    mine = [r for r in experiment.records if row_of(r) == row and family(r) in families and r["status"] == "ok"]
    errors = by_shape(runs.over_points(name, row, finite=True))
    reference = next((other for other in runs.rows if other.preset == REFERENCE), row)
    failures = [runs.failures(each, row) for each in families]
    return {
        **{"family": name, "row": row.name, "preset": row.preset},
        **{points: _median(runs, families, row, points) for points in runs.points},
        "error": statistics.geometric(errors) if errors else statistics.Interval(math.nan, math.nan, math.nan),
        "ratio": None if row == reference else gap(*runs.pair(name, row, reference, finite=True)),
        "evaluations": median_of_known(map(value_evaluations, mine)),
        "seconds": median_of_known(map(loop_seconds, mine)),
        "failed": "{} of {}".format(*(sum(part) for part in zip(*failures, strict=True))),
    }


def _median(runs: Completions, families: list[str], row: Row, points: str) -> float | None:
    errors = [error for name in families for error in runs.errors.get((name, row, points), {}).values()]
    return float(statistics.median(errors)) if errors else None


@style.styled
def draw(lines: list[Line]) -> Figure:
    """Draws the error over all families over each cost, with a point per row; filled points are on the front."""
    first = [line for line in lines if line["family"] == lines[0]["family"]] if lines else []
    figure, (axes,) = chart.sheet(3.2, 1, len(COSTS), sharey=True)
    for axis, (cost, label) in zip(axes, COSTS.items(), strict=True):
        _panel(axis, [line for line in first if line[cost] is not None], cost)
        axis.set_xlabel(label)
    axes[0].set_ylabel("Chamfer × 1000 (scene units²)")
    style.log_axis(axes[0], "y", [v for line in first for v in (line["error"].low, line["error"].value)])
    style.legend_below(figure, axes[0], columns=3)
    return figure


def _panel(axis: Axes, lines: list[Line], cost: str) -> None:
    rows, errors = [(line["preset"], line["row"]) for line in lines], [line["error"] for line in lines]
    chart.front(axis, rows, [line[cost] for line in lines], errors, [line[f"front_{cost}"] for line in lines])
    style.log_axis(axis, "x", [line[cost] for line in lines])


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The rows with the least error and the least cost, and the front over field values and over seconds."""
    whole = data[
        (data["family"] == data["family"].iloc[0]) & data["error"].map(math.isfinite) & data["seconds"].notna()
    ]
    if whole.empty:
        return Answer(QUESTION)
    best, quick = whole.loc[whole["error"].idxmin()], whole.loc[whole["seconds"].idxmin()]
    named = [f"({row['row']}, {format.seconds(row['seconds'])})" for row in (best, quick)]
    said = (
        f"Under one loss and one setting, the least error × 1000 is *{best['error']:.3g}* {named[0]}; the quickest row "
        f"has {quick['error']:.3g} {named[1]}."
    )
    sure, all_known = excluding(whole, ["ratio"])
    if all_known:
        said += f" The interval of the ratio to DIST excludes 1 for *{sure} of {all_known}* rows."
    panels = []
    for cost, label in COSTS.items():
        points = [
            series(row["row"], row["preset"], [row[cost]], [row["error"]], low=[row["low"]], high=[row["high"]], size=9)
            for _, row in whole.iterrows()
        ]
        panels.append(chart_panel("error over cost", label, "error × 1000", points))
    return Answer(QUESTION, said, {"panels": panels})
