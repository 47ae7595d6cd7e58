"""The printed summary of a finished run or sweep, and the summary of a run in its log."""

import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bench.records.format import count, number, plural, seconds, values_in_words
from bench.records.metrics import LISTED_METRICS, RENDERING_METRICS, Metric
from bench.records.record import NOT_RUN, PICTURE_FILES, Record, RunStatus
from bench.records.results import RESULTS, Plan

CUSTOM_RENDERER = "custom"  # the choice of renderer for a class of the user
# See CONTRIBUTING.md.
CONTRACT_TEST = "python -m pytest tests/renderers/test_renderer_contract.py -k custom --renderer="


def print_run_summary(folder: Path, record: Record) -> None:
    """Prints the results of a run; the last line on standard output is its folder."""
    console = Console(highlight=False)
    if record.verdict:
        print(record.verdict)
    if rows := record.compared():
        lines = [(label, *values.values(), better) for label, values, better in rows]
        console.print(_table(record.title, ("", *rows[0][1], "better"), lines))
    elif record.metrics:
        console.print(_table(record.title, ("", "measured"), [*_measured_metrics(record)]))
    if "iterations" in record.evaluations:
        console.print(_cost_line(record))
    for note in record.notes:
        print(f"note: {note}")
    for picture in [path for name in PICTURE_FILES if (path := folder / name).is_file()][:1]:
        print(f"picture: {picture}")
    _print_contract_test(folder.parent, [] if record.reused else [vars(record)])
    _print_report_command(folder.parents[1])
    if record.reused:
        print(f"reused: the run of {record.started}; rerun=all runs it again")
    if record.status != RunStatus.OK and not record.reason.startswith("stopped by"):  # the command line prints that
        Console(stderr=True, highlight=False, soft_wrap=True).print(f"{record.status}: {record.reason}", markup=False)
    print(folder)


def print_sweep_summary(plan: Plan, index: Path, tables: Sequence[str] = ()) -> list[str]:
    """Prints the results of a sweep, with the plan's folder last; returns the status of every planned cell.

    Args:
        tables: lines on the sweep's tables.
    """
    statuses = print_statuses(plan)
    print(*tables, f"report: {index}", sep="\n")
    records = filter(None, map(plan.record, plan.cells))
    _print_contract_test(index.parent / "runs", [record for record in records if not record["reused"]])
    _print_report_command(index.parent)
    print(plan.folder)
    return statuses


def print_statuses(plan: Plan) -> list[str]:
    """Prints the number of planned cells of each status, and the first failure; returns the status of every cell."""
    records = [plan.record(cell) for cell in plan.cells]
    statuses = [record["status"] if record else NOT_RUN for record in records]
    counts = ", ".join(f"{count} {status}" for status, count in Counter(statuses).most_common())
    print(f"{len(plan.cells)} planned: {counts}")
    if set(statuses) - {"ok", "unsupported"}:
        print("the same command runs what was not run or was killed; with rerun=failed, also the cells that failed")
    for record in [record for record in records if record and record["status"] != "ok"][:1]:
        print(f"first failure: {plan.results_dir}/runs/{record['folder']} ({record['status']}: {record['reason']})")
    return statuses


def _print_contract_test(runs: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """Prints the command of the contract test after the first runs of `renderer=custom`, and after one that failed."""
    custom = {record["id"]: record for record in records if record["renderer"] == CUSTOM_RENDERER}
    faulty = [record for record in custom.values() if record["status"] in ("crashed", "nan")]
    all_runs = {path.parent.name for path in runs.glob(f"*-{CUSTOM_RENDERER}-*/record.json")}
    if custom and (faulty or all_runs <= {*custom}):
        target = [*faulty, *custom.values()][0]["config"]["renderer"]["_target_"]
        print(f"does the renderer hold its contract? in a clone: {CONTRACT_TEST}{shlex.quote(target)}")


def _print_report_command(results_dir: Path) -> None:
    """Prints the command that writes the page and the tables."""
    option = "" if results_dir == Path(RESULTS) else f" results_dir={shlex.quote(str(results_dir))}"
    print(f"page and tables: python -m bench.report{option}")


def log_lines(record: Record) -> Iterator[str]:
    """The end of a run's log: the command, the machine, the errors before and after, the times, notes and status."""
    machine = record.environment
    yield record.title
    yield f"command: {shlex.join(('python', '-m', 'bench', *record.overrides))}"
    if machine.get("cpu"):
        yield (
            f"machine: {machine['cpu']}; device {machine['device']}; {plural(machine['threads'], 'thread')}; "
            f"torch {machine['torch']}; kernels {machine['kernels']}"
        )
    compared = record.compared()
    yield from filter(None, (record.verdict,))
    yield from (f"{label}: {values_in_words(values)}" for label, values, _ in compared)
    if not compared:
        yield from (f"{label}: {value}" for label, value in _measured_metrics(record))
    if "iterations" in record.evaluations:
        yield _cost_line(record)
    yield f"started {record.started}, ended {record.ended}, {seconds(record.seconds['total'])} in all"
    yield from (f"note: {note}" for note in record.notes)
    yield f"status: {record.status}{f' ({record.reason})' if record.reason else ''}"


def _measured_metrics(record: Record) -> Iterator[tuple[str, str]]:
    """The metrics of a task that measures without optimising: those of renderings or of a recommendation, else all."""
    listed = [name for name in record.metrics if name.startswith("recommended") or name in RENDERING_METRICS]
    for name in listed or record.metrics:
        metric = LISTED_METRICS.get(name, Metric(name))
        yield metric.label, number(record.metrics[name], metric.factor)


def _table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, title=escape(title))
    for heading in headings:
        table.add_column(heading, justify="left" if heading in ("", "better") else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _cost_line(record: Record) -> str:
    """A line on the time and the field evaluations of an optimisation."""
    loop, spent = record.seconds["forward"] + record.seconds["backward"], record.evaluations
    return (
        f"{seconds(loop)} in the loop, {seconds(record.seconds['total'])} in all; field evaluations: "
        f"{count(spent['value'])} values, {count(spent['gradient'])} gradients, "
        f"{number(spent['per_ray'])} values per ray and iteration"
    )
