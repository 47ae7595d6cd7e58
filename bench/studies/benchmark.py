"""Renderers timed in turn in one process: their costs relative to the first renderer, and their errors."""

from dataclasses import replace
from typing import Any

from bench.report.data.records import Record, measured, setting
from bench.report.study import Result, Runs, Selection, format, table

PLACE = 15
COARSE = "coarse_queries"
BASE = "base"  # prefix of the run's renderer in the metrics, as in bench.tasks.ablation
READS = (
    Selection(
        "benchmark",
        ("task.size", "task.threads"),
        setup=("scenes", "network", "machine"),
        alike=("dataset", "view", "prior", "task"),
    ),
)
COSTS = {
    "forward": "Forward ratio",
    "forward_cpu": "Forward ratio, CPU",
    "step": "Step ratio",
    "step_cpu": "Step ratio, CPU",
}
NOTES = (
    "Field evaluations are those of one rendering. Coarse evaluations use bfloat16, away from the surface.",
    "Work over bound: the operations of a step divided by those of one field evaluation and one gradient per hit.",
    "Pixels and depths are compared with a float64 reference. Depth errors are in scene units, over the pixels that "
    "are hits in both images.",
)


def make(runs: Runs) -> Result:
    # The task sets the number of threads: it is a column, not part of the caption.
    records = [record | {"environment": record["environment"] | {"threads": None}} for record in runs.records]
    lines = [line for record in sorted(records, key=_size_and_threads) for line in _lines(record)]
    rounds = sorted({line["rounds"] for line in lines if line["rounds"]})
    return Result(
        replace(runs, records=records),
        "Renderers timed in turn, in one process.",
        "Seconds of one rendering and of one optimisation step, and their ratios to the first renderer in the same "
        f"round; medians of {' or '.join(map(str, rounds))} rounds, in brackets the smallest and the largest.",
        question="Which renderer is fastest, if all are timed in turn in one process?",
        verdict=_verdict(lines),
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
    )


def _verdict(lines: list[dict[str, Any]]) -> str:
    """The ratios of a step's time at the largest size that ended ok."""
    measured_lines = [line for line in lines if line["status"] == "ok" and line.get("step_ratio") is not None]
    size = max((line["size"] for line in measured_lines), default=0)
    ratios = {
        f"{line['renderer']}, {format.plural(line['threads'], 'thread')}": line["step_ratio"]
        for line in measured_lines
        if line["size"] == size and not line["first"]
    }
    first = next((line["renderer"] for line in measured_lines if line["first"]), "")
    return table.extremes(f"Step runtime at {size} × {size} pixels, relative to {first}", ratios, "one shape")


def _size_and_threads(record: Record) -> tuple[int, int]:
    return setting(record["config"], "task", "size"), setting(record["config"], "task", "threads")


def _lines(record: Record) -> list[dict[str, Any]]:
    numbers: dict[str, dict[str, Any]] = {}
    for key in record["metrics"]:
        name, _, metric = key.rpartition(".")
        if name:
            numbers.setdefault(name, {})[metric] = measured(record, key)
    size, threads = _size_and_threads(record)
    shared = {"size": size, "threads": threads, "rounds": record["metrics"].get("rounds")}
    shared |= {key: record[key] for key in ("status", "reason", "folder")}
    return [
        {**shared, "renderer": record["renderer"] if name == BASE else name, "first": name == BASE, **renderer_numbers}
        for name, renderer_numbers in (numbers or {BASE: {}}).items()
    ]


def _ratio(cost: str) -> table.Column:
    def text(line: dict[str, Any]) -> str:
        median, low, high = (line.get(f"{cost}_ratio{end}") for end in ("", "_low", "_high"))
        if median is None:
            return format.MISSING
        return "1" if line["first"] else f"{median:.2f} ({low:.2f}–{high:.2f})"

    return table.Column(f"{cost}_ratio", COSTS[cost], words=text)


COLUMNS = (
    *table.columns(table.integer, size="Size", threads="Threads"),
    *table.columns(table.word, renderer="Renderer", status="", reason="", folder=""),
    *table.raw("rounds"),
    table.Column("queries", "Field evaluations", words=lambda x: table.queries(x.get("queries"), x.get(COARSE))),
    *table.raw(COARSE),
    *table.columns(format.seconds, forward_seconds="Forward", step_seconds="Step"),
    *table.raw("forward_cpu", "step_cpu"),
    *map(_ratio, COSTS),
    *table.raw(*(f"{cost}_ratio_{end}" for cost in COSTS for end in table.ENDS), "peak_memory_bytes"),
    table.Column("work_over_bound", "Work over bound"),
    *table.raw("rays", "hits", "lost", "false", "wrong"),
    table.joined("Missed / spurious / wrong depth", dict.get, table.integer, "lost", "false", "wrong"),
    *table.raw("depth_error_median", "depth_error_p99", "depth_error_max"),
    table.joined("Depth error median / p99", dict.get, format.number, "depth_error_median", "depth_error_p99"),
)

PAGES = {"benchmark": make}
