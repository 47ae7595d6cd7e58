"""The short table that a run ends with."""

from collections import Counter
from pathlib import Path

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bench.plan import Plan
from bench.records import Record, RunStatus
from bench.report.format import count, number, seconds
from bench.report.html import write_index
from bench.report.planned import NOT_RUN

ROWS = (  # metric, what it is called, factor, better when
    ("chamfer_l2", "Chamfer (x1000)", 1000.0, "lower"),
    ("accuracy", "accuracy (x1000)", 1000.0, "lower"),
    ("completeness", "completeness (x1000)", 1000.0, "lower"),
    ("fscore", "F-score", 1.0, "higher"),
    ("normal_consistency", "normal consistency", 1.0, "higher"),
    ("depth_mae", "depth error (x1000)", 1000.0, "lower"),
    ("mask_iou", "mask IoU", 1.0, "higher"),
    ("rotation_error_deg", "rotation error (degrees)", 1.0, "lower"),
    ("translation_error", "translation error (x1000)", 1000.0, "lower"),
)


def show(folder: Path, record: Record, index: Path) -> None:
    """Prints what a run came to; the last line on standard output is its folder."""
    console = Console(highlight=False)
    table = Table(box=box.SIMPLE_HEAD, title=escape(f"{record.task}, {record.name}, {record.scene or record.dataset}"))
    for heading in ("", "before", "after", "better"):
        table.add_column(heading, justify="left" if heading in ("", "better") else "right")
    for name, label, factor, better in ROWS:
        if name in record.metrics_start:
            before, after = record.metrics_start[name], record.metrics.get(name)
            table.add_row(label, number(before, factor), number(after, factor), better)
    if table.row_count:
        console.print(table)
    elif "recommended_field" in record.metrics:
        console.print(_ladder(record))
    elif record.metrics:
        console.print(_measured(record))
    if "iterations" in record.evaluations:
        loop = record.seconds["forward"] + record.seconds["backward"]
        console.print(
            f"{seconds(loop)} in the loop, {seconds(record.seconds['total'])} in all; field evaluations: "
            f"{count(record.evaluations['value'])} values, {count(record.evaluations['gradient'])} gradients, "
            f"{number(record.evaluations['per_ray'])} values a ray and iteration"
        )
    for note in record.notes:
        print(f"note: {note}")
    print(f"report: {index}")
    if record.reused:
        print(f"reused: the run of {record.started}; rerun=all runs it again")
    if record.status != RunStatus.OK and not record.reason.startswith("stopped by"):  # the program tells of that
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"{record.status}: {record.reason}", markup=False)
    print(folder)


def show_sweep(plan: Plan) -> list[str]:
    """Prints what a sweep came to; its last line is the plan's folder. Gives the status of every planned cell."""
    statuses = [record["status"] if (record := plan.record(cell)) else NOT_RUN for cell in plan.cells]
    counts = ", ".join(f"{count} {status}" for status, count in Counter(statuses).most_common())
    print(f"{len(plan.cells)} planned: {counts}")
    if set(statuses) - {"ok", "unsupported"}:
        print("the same command runs what was not run or was killed; with rerun=failed, also what failed")
    print(f"report: {write_index(plan.results_dir)}")
    print(plan.folder)
    return statuses


def _ladder(record: Record) -> Table:
    """What each rung of a capacity run came to; the recommended one is marked."""
    from bench.report.ladder import Ladder  # only here: it loads matplotlib, which the command can do without

    ladder = Ladder.of(record.metrics)
    title = f"{record.task}, {record.name}, {record.scene}; half a pixel is {number(1000 * ladder.footprint)} (x1000)"
    table = Table(box=box.SIMPLE_HEAD, title=escape(title))
    for heading in ("", "field", "numbers", "bytes", "FLOPs a query", "error (x1000)", "s.e.", "fit"):
        table.add_column(heading, justify="left" if heading in ("", "field") else "right", no_wrap=heading == "field")
    for rung in ladder.rungs:
        own = rung.numbers
        mark = "=>" if rung is ladder.chosen else "best" if rung is ladder.best else ""
        size = f"{own['parameters']:,}", count(own["bytes"]), count(own["flops_per_query"])
        error = number(own.get("error"), 1000), number(own.get("standard_error"), 1000)
        table.add_row(mark, rung.label, *size, *error, seconds(own["seconds"]))
    return table


def _measured(record: Record) -> Table:
    """All numbers of a task that measures and does not optimise."""
    table = Table(box=box.SIMPLE_HEAD, title=escape(f"{record.task}, {record.name}, {record.scene}"))
    table.add_column("")
    table.add_column("measured", justify="right")
    for name, value in record.metrics.items():
        table.add_row(name, number(value))
    return table
