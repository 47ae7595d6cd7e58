"""How much a network of one image needs: the error over its training shapes, and over the images of each."""

from dataclasses import replace

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import SCALE, Record, Row, by_shape, grouped, setting
from bench.report.data.statistics import Interval, bootstrap, geometric_ratio, median
from bench.report.pages.single_view.dvr_table1 import errors_of, over
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.shapes import middle
from bench.report.write.table import FAMILY, IDENTITY, Column, configured, metrics, text, to_data, to_table

PLACE = 43
READS = (
    Selection(
        "single_view_budget",
        ("single_view",),
        ("dataset", "task", "supervision"),
        ("shapes", "views"),
        setup=("machine",),
    ),
)
NOTES = (
    "Each point is a training of its own, with the same number of steps; all are judged by the same shapes. "
    "A failed run counts as infinite.",
    "“Over the largest”: the ratio of geometric means of Chamfer-L1 to those of the largest training, over the same "
    "shapes; above 1 is worse.",
)
COLUMNS = (
    *(text("family", "Family"), text("method", "Training"), text("shapes", "Shapes"), text("views", "Images each")),
    *(text("found", "Chamfer-L1"), Column("iou", "IoU"), text("ratio", "Over the largest"), text("failed", "Failed")),
)
RUNS = (
    *(FAMILY, configured("shapes", "task", "shapes"), configured("views", "task", "views"), *IDENTITY),
    *metrics("chamfer_l1", "iou", "normal_consistency", "mask_iou"),
)
Budget = tuple[int, int]  # training shapes, and images of each


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family, row and budget."""
    lines, estimates = [], []
    for name, records in experiment.families().items():
        for row, of_row in replace(experiment, records=records).rows().items():
            budgets = dict(sorted(grouped(of_row, _budget).items()))
            for budget, found in budgets.items():
                estimates.append(_estimate(found))
                line = {"family": name, "method": row.name, "found": str(estimates[-1])}
                lines.append({**line, **_line(budget, budgets)})
    return Result(
        experiment,
        "Shape from one image, by the size of the training.",
        "Chamfer-L1 in scene units, times 1000, medians over shapes.",
        interval="95 % bootstrap intervals over shapes",
        estimates=estimates,
        remarks=NOTES,
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw(experiment),
    )


def _budget(record: Record) -> Budget:
    task = record["config"]["task"]
    return setting(task, "shapes"), setting(task, "views")


def _estimate(records: list[Record]) -> Interval:
    return bootstrap(by_shape(errors_of(records)), median, seed=0).times(SCALE)


def _line(budget: Budget, budgets: dict[Budget, list[Record]]) -> dict[str, object]:
    found = budgets[budget]
    largest = max(budgets, key=lambda one: one[0] * one[1])
    ratio = None if budget == largest else over(errors_of(found), errors_of(budgets[largest]))
    return {
        "shapes": str(budget[0]),
        "views": str(budget[1]),
        "iou": middle(found, "iou"),
        "ratio": "" if ratio is None else str(ratio),
        "failed": f"{sum(record['status'] != 'ok' for record in found)} of {len(found)}",
    }


@style.styled
def draw(experiment: Experiment) -> Figure:
    """A line of panels per family: the error over the images of each shape, and over the shapes."""
    families = experiment.families()
    figure, axes = chart.sheet(2.6 * len(families), len(families), 2, sharey="row")
    for (left, right), (name, records) in zip(axes, families.items(), strict=True):
        for row, of_row in replace(experiment, records=records).rows().items():
            budgets = grouped(of_row, _budget)
            most = (max(shapes for shapes, _ in budgets), max(views for _, views in budgets))
            _curve(left, row, {views: runs for (shapes, views), runs in budgets.items() if shapes == most[0]})
            _curve(right, row, {shapes: runs for (shapes, views), runs in budgets.items() if views == most[1]})
            left.set_xlabel(f"images of each of {most[0]} training shapes")
            right.set_xlabel(f"training shapes, {most[1]} images of each")
        left.set_ylabel(f"{name}: Chamfer-L1 × 1000 (scene units)")
    style.legend_below(figure, axes[0, 0])
    return figure


def _curve(axis: Axes, row: Row, runs: dict[int, list[Record]]) -> None:
    sizes = sorted(runs)
    chart.estimates(axis, row.preset, sizes, [_estimate(runs[size]) for size in sizes], bars=True, label=row.name)
    axis.set_xscale("log", base=2)
    axis.set_xticks(sizes, [str(size) for size in sizes])
    axis.minorticks_off()


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """How many ratios to the largest training of a family have an interval that excludes 1."""
    ratios, largest = [], (0, 0)
    for _, family in data.groupby("family", sort=False):
        errors = family["chamfer_l1"].where(family["status"] == "ok", float("inf"))
        by_run = errors.groupby([family["shapes"], family["views"], family["index"], family["seed"]]).first()
        budgets = {budget: part.droplevel([0, 1]) for budget, part in by_run.groupby(level=[0, 1])}
        largest = max(budgets, key=lambda one: one[0] * one[1])
        ratios += [
            geometric_ratio(list(part.to_numpy()[:, None]), list(budgets[largest].to_numpy()[:, None]))
            for budget, part in budgets.items()
            if budget != largest and part.index.equals(budgets[largest].index)
        ]
    known = [ratio for ratio in ratios if ratio.known]
    beyond = sum(ratio.excludes(1) for ratio in known)
    of_largest = f"{largest[0]} shapes with {largest[1]} images each"
    verdict = f"The interval excludes 1 for *{beyond} of {len(known)}* ratios to the training on {of_largest}."
    return Answer("How many shapes, and images of each, does a training need?", verdict if known else "")
