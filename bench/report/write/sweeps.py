"""Writes the table of each sweep that no page shows, beside its plan."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.records import format
from bench.records.metrics import SHOWN, Metric, better
from bench.records.read import Plan, not_run, read_run
from bench.report.data.records import definitions
from bench.report.data.statistics import Interval
from bench.report.data.sweeps import RowNumbers, SweepRuns, numbers, read_sweeps, runs_of
from bench.report.write.caption import OVER
from bench.report.write.paper import SWEEPS, TABLE, studies
from bench.report.write.result import Result, write
from bench.report.write.table import Column, counted, shown, text, to_data, to_table

MOST_VALUES = 6  # of a swept key that the caption lists
MOST_METRICS = 8  # in the readable table, of a task that none of `SHOWN` measures
FAILURE = (
    "A run that did not end ok, or was not run, is counted as failed, and has the worst value of each metric: an "
    "infinite error, or 0 of what is better higher. So medians are ∞ where half of the runs failed."
)
UNDIRECTED = "Of metrics of which neither direction is better, medians are of the runs that have them."


def write_sweeps(records: list[dict[str, Any]], results_dir: Path) -> list[Path]:
    """Writes `results_dir/sweeps/NAME/table.{csv,json,md,tex}` of every sweep without a page; gives the CSVs' paths."""
    sweeps = read_sweeps(records, results_dir, _tabled())
    return [_write(sweep, results_dir / SWEEPS / sweep.name)[0] for sweep in sweeps]


def write_sweep(plan: Plan) -> Path | None:
    """Writes the table of a sweep that has ended, if it has no page; gives the path of its readable form."""
    experiment = plan.cells[0].config.get("experiment")
    if experiment and experiment in _tabled():
        return None
    plain, known = asdict(plan), {}
    for cell in plain["cells"]:
        record, _ = read_run(plan.results_dir / "runs" / cell["id"], plan.results_dir)
        known[cell["id"]] = record or not_run(cell, plain)
    _write(runs_of(plain, known, plan.results_dir), plan.folder)
    return plan.folder / f"{TABLE}.md"


def _write(sweep: SweepRuns, folder: Path) -> list[Path]:
    table = table_of(sweep)
    return write(table, table.shown(), folder / TABLE, name=sweep.name)


def table_of(sweep: SweepRuns) -> Result:
    """The table of a sweep: a line per row with its medians, what failed and what it cost."""
    names, lines = sweep.metrics(), numbers(sweep)
    headings = _headings(names)
    stress = any(record["config"].get("stress") for record in sweep.runs.records)
    return Result(
        sweep.runs,
        f"Sweep {sweep.name}.",
        f"Medians over {OVER}; swept over {_listed(sweep)}.",
        n=f"{len(sweep.runs.records)} runs" if stress else "",
        interval="95 % bootstrap intervals over shapes" if headings else "",
        estimates=[line.medians[name] for line in lines for name in headings if name in line.medians],
        remarks=(*_notes(sweep, headings), *definitions(sweep.runs.records, {n: m.label for n, m in headings.items()})),
        data=to_data(_data_columns(names), lines),
        table=to_table(_columns(headings, lines), lines),
    )


def _tabled() -> set[str]:
    """The names of the experiments that pages read."""
    return {selection.experiment for study in studies() for selection in study.reads}


def _headings(names: list[str]) -> dict[str, Metric]:
    """The metrics of the readable table: those that tables show, or else the first ones, by their names."""
    known = {name: SHOWN[name] for name in names if name in SHOWN}
    return known or {name: Metric(name) for name in names[:MOST_METRICS]}


def _columns(headings: dict[str, Metric], lines: list[RowNumbers]) -> list[Column]:
    """The columns of the readable table."""
    several = any(line.ratio is not None for line in lines)
    first = next(iter(headings.values()), Metric(""))
    return [
        text("row", "Run", lambda line: line.name),
        *(shown(metric.label, _median(name, metric.factor)) for name, metric in headings.items()),
        *([shown(f"{first.label.split(' (')[0]} over the first row's", _ratio)] if several else []),
        shown("Failed", lambda line: counted(line.failed, line.runs, line.rate)),
        Column("", "Loop", lambda line: line.loop, format.seconds),
        Column("", "Field values", lambda line: line.values, format.count),
    ]


def _median(name: str, factor: float) -> Any:
    """The text of a metric in a line."""
    return lambda line: str(line.medians[name].times(factor)) if name in line.medians else format.MISSING


def _ratio(line: RowNumbers) -> str:
    return format.MISSING if line.ratio is None else str(line.ratio)


def _data_columns(names: list[str]) -> list[Column]:
    """The columns of the CSV: of each metric the median and the ends of its interval, in scene units."""
    return [
        text("row", value=lambda line: line.name),
        *(column for name in names for column in _ends(name, lambda line, name=name: line.medians.get(name))),
        *_ends("ratio", lambda line: line.ratio),
        *(Column(key, value=lambda line, key=key: getattr(line, key)) for key in ("runs", "failed")),
        Column("failed_low", value=lambda line: line.rate.low),
        Column("failed_high", value=lambda line: line.rate.high),
        text("reasons", value=lambda line: "; ".join(line.reasons)),
        Column("loop_seconds", value=lambda line: line.loop),
        Column("value_evaluations", value=lambda line: line.values),
    ]


def _ends(key: str, get: Any) -> list[Column]:
    """Columns of an estimate and of the ends of its interval."""

    def part(line: RowNumbers, end: str) -> float | None:
        interval: Interval | None = get(line)
        return None if interval is None else getattr(interval, end)

    ends = {"": "value", "_low": "low", "_high": "high"}
    return [Column(key + suffix, value=lambda line, end=end: part(line, end)) for suffix, end in ends.items()]


def _listed(sweep: SweepRuns) -> str:
    """The keys that were swept over, with their values or the number of these."""
    said = [
        f"{key} ({', '.join(values)})" if len(values) <= MOST_VALUES else f"{key} ({len(values)} values)"
        for key, values in sweep.swept.items()
    ]
    return ", ".join(said) or "nothing"


def _notes(sweep: SweepRuns, headings: dict[str, Metric]) -> list[str]:
    """How rows and numbers are to be read."""
    more = [name for name in sweep.metrics() if name not in headings]
    undirected = UNDIRECTED if any(not better(name) for name in headings) else ""
    csv = f"The CSV also has {', '.join(more)}." if more else ""
    return [FAILURE, undirected, csv]
