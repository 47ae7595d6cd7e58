"""How much a network of one image needs: the error over its training shapes, and over the images of each."""

from dataclasses import replace
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.records import SCALE, Record, Row, by_shape, family, grouped, row_of, setting
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import Interval, bootstrap, median
from bench.report.medians import medians
from bench.report.single_view import INTERVALS, errors_of, over
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, Column, configured, metrics, text, to_data, to_table

PLACE = 43
READS = (Selection("single_view_budget", ("task.shapes", "task.views"), setup=("machine",)),)
NOTES = (
    "Each point is a training of its own, with the same number of steps; all are judged by the same shapes, and a "
    "failed run counts as infinite.",
    "“Over the largest”: the ratio of geometric means of Chamfer-L1 to those of the largest training, over the same "
    "shapes; above 1 is worse.",
)
COLUMNS = (
    *(text("family", "Family"), text("method", "Training"), text("shapes", "Shapes"), text("views", "Images each")),
    *(text("error", "Chamfer-L1"), Column("iou", "IoU")),
    text("ratio", "Over the largest", lambda line: "" if line["ratio"] is None else str(line["ratio"])),
    text("failed", "Failed"),
)
RUNS = (
    *(FAMILY, configured("shapes", "task", "shapes"), configured("views", "task", "views"), *IDENTITY),
    *metrics("chamfer_l1", "iou", "normal_consistency", "mask_iou"),
)
Budget = tuple[int, int]  # training shapes, and images of each


def make(runs: Runs) -> Result:
    """A line per family, row and budget."""
    lines = [line for own in _trainings(runs).values() for line in _lines(runs, own)]
    return Result(
        runs,
        "Shape from one image, by the size of the training.",
        "Chamfer-L1 in scene units, times 1000, medians over shapes.",
        question="How many shapes, and images of each, does a training need?",
        verdict=_verdict(lines),
        interval=INTERVALS,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        data=to_data(RUNS, runs.records),
        table=to_table(COLUMNS, lines),
        figure=draw(runs),
    )


def _trainings(runs: Runs) -> dict[tuple[str, Row], dict[Budget, list[Record]]]:
    """The runs of each family and row by their budgets, the smallest first."""
    of_row = grouped(runs.records, lambda record: (family(record), row_of(record)))
    return {key: dict(sorted(grouped(records, _budget).items())) for key, records in of_row.items()}


def _budget(record: Record) -> Budget:
    return setting(record["config"], "task", "shapes"), setting(record["config"], "task", "views")


def _error(records: list[Record]) -> Interval:
    return bootstrap(by_shape(errors_of(records)), median, seed=0).times(SCALE)


def _lines(runs: Runs, budgets: dict[Budget, list[Record]]) -> list[dict[str, Any]]:
    """A line per budget of a family and row, with its ratio to the largest."""
    largest = max(budgets, key=lambda one: one[0] * one[1])
    errors = {budget: errors_of(records) for budget, records in budgets.items()}
    return [
        medians(replace(runs, records=records), ["iou"])[0]
        | {"family": family(records[0]), "shapes": str(budget[0]), "views": str(budget[1]), "largest": largest}
        | {"error": _error(records), "ratio": over(errors[budget], errors[largest]) if budget != largest else None}
        for budget, records in budgets.items()
    ]


def _verdict(lines: list[dict[str, Any]]) -> str:
    """How many ratios to the largest training of a family have an interval that excludes 1."""
    known = [line["ratio"] for line in lines if line["ratio"] is not None and line["ratio"].known]
    if not known:
        return ""
    shapes, views = lines[-1]["largest"]
    sure, n = sum(ratio.excludes(1) for ratio in known), max(len(ratio.points) for ratio in known)
    return (
        f"The interval excludes 1 for *{sure} of {len(known)}* ratios to the training on {shapes} shapes with {views} "
        f"images each; n = {n} shapes."
    )


@style.styled
def draw(runs: Runs) -> Figure:
    """A line of panels per family: the error over the images of each shape, and over the shapes."""
    families = list(runs.families())
    figure, axes = chart.sheet(2.6 * len(families), len(families), 2, sharey="row")
    for (name, row), budgets in _trainings(runs).items():
        left, right = axes[families.index(name)]
        shapes, views = (max(budget[part] for budget in budgets) for part in (0, 1))
        _curve(left, row, {one[1]: found for one, found in budgets.items() if one[0] == shapes})
        _curve(right, row, {one[0]: found for one, found in budgets.items() if one[1] == views})
        left.set(
            xlabel=f"images of each of {shapes} training shapes", ylabel=f"{name}: Chamfer-L1 × 1000 (scene units)"
        )
        right.set_xlabel(f"training shapes, {views} images of each")
    style.legend_below(figure, axes[0, 0])
    return figure


def _curve(axis: Axes, row: Row, found: dict[int, list[Record]]) -> None:
    sizes = sorted(found)
    chart.estimates(axis, row.preset, sizes, [_error(found[size]) for size in sizes], bars=True, label=row.name)
    axis.set_xscale("log", base=2)
    axis.set_xticks(sizes, [str(size) for size in sizes])
    axis.minorticks_off()


PAGES = {"single_view_budget": make}
