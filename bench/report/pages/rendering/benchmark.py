"""Renderers that were timed in turn in one process: their costs over those of the first one, and their errors."""

from dataclasses import replace
from typing import Any

import pandas as pd

from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Record, definitions, measured, setting
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import Column, shown, text, to_data, to_table, together, whole

PLACE = 15
BASE = "base"  # the run's own renderer among the numbers of a record, as in bench.tasks.ablation
READS = (Selection("benchmark", ("ablation",), ("task",), ("size", "threads"), setup=("scenes", "network", "machine")),)
HEADINGS = {
    "forward": "Forward ratio",
    "forward_cpu": "Forward ratio, CPU",
    "step": "Step ratio",
    "step_cpu": "Step ratio, CPU",
}
COSTS = tuple(HEADINGS)
DEFINED = {
    "forward_ratio": "Forward, step, CPU",
    "coarse_queries": "Values",
    "work_over_bound": "Work over bound",
    "peak_memory_bytes": "Memory",
    "lost": "Missed, spurious",
    "wrong": "Wrong depth",
    "depth_error_median": "Depth error",
}


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per image size, number of threads and renderer."""
    experiment = replace(experiment, records=[_of_any_threads(record) for record in experiment.records])
    lines = [line for record in sorted(experiment.records, key=_place) for line in _lines(record)]
    rounds = sorted({line["rounds"] for line in lines if line["rounds"]})
    return Result(
        experiment,
        "Renderers timed in turn, in one process.",
        "Seconds of one rendering and of one step of an optimisation, and their ratios to those of the first renderer "
        f"of the same round: medians of {' or '.join(map(str, rounds))} rounds, in brackets the least and the largest.",
        remarks=definitions(experiment.records, DEFINED),
        data=to_data(COLUMNS, lines),
        table=to_table(COLUMNS, lines),
    )


def _of_any_threads(record: Record) -> Record:
    """The record without the run's threads, since the task sets its own: a column has them, and no caption."""
    return record | {"environment": record["environment"] | {"threads": None}}


def _place(record: Record) -> tuple[int, int]:
    """The size of the image and the number of threads."""
    return setting(record["config"], "task", "size"), setting(record["config"], "task", "threads")


def _lines(record: Record) -> list[dict[str, Any]]:
    """A line per renderer of a run."""
    names = dict.fromkeys(name.split(".")[0] for name in record["metrics"] if "." in name)
    return [_line(record, name) for name in names] or [_line(record, BASE)]


def _line(record: Record, name: str) -> dict[str, Any]:
    numbers = {key.split(".", 1)[1]: measured(record, key) for key in record["metrics"] if key.split(".")[0] == name}
    size, threads = _place(record)
    return {
        "size": size,
        "threads": threads,
        "renderer": record["renderer"] if name == BASE else name,
        "first": name == BASE,
        "rounds": record["metrics"].get("rounds"),
        **{key: record[key] for key in ("status", "reason", "folder")},
        **numbers,
    }


def _ratio(cost: str) -> Column:
    """The median of a ratio, and between which ends it lay."""

    def words(line: dict[str, Any]) -> str:
        middle, low, high = (line.get(f"{cost}_ratio{end}") for end in ("", "_low", "_high"))
        if middle is None:
            return format.MISSING
        return "1" if line["first"] else f"{middle:.2f} ({low:.2f}–{high:.2f})"

    return Column(f"{cost}_ratio", HEADINGS[cost], words=words)


COLUMNS = (
    Column("size", "Size", show=whole),
    Column("threads", "Threads", show=whole),
    text("renderer", "Renderer"),
    *(text(key) for key in ("status", "reason", "folder")),
    Column("rounds"),
    Column("queries", "Values", words=lambda line: format.queries(line.get("queries"), line.get("coarse_queries"))),
    Column("coarse_queries"),
    Column("forward_seconds", "Forward", show=format.seconds),
    Column("step_seconds", "Step", show=format.seconds),
    *(Column(key) for key in ("forward_cpu", "step_cpu")),
    *(_ratio(cost) for cost in COSTS),
    *(Column(f"{cost}_ratio_{end}") for cost in COSTS for end in ("low", "high")),
    Column("peak_memory_bytes", "Memory of a step", show=format.size),
    Column("work_over_bound", "Work over bound"),
    *(Column(key) for key in ("rays", "hits", "lost", "false", "wrong")),
    shown("Missed / spurious / wrong depth", together(dict.get, whole, "lost", "false", "wrong")),
    *(Column(key) for key in ("depth_error_median", "depth_error_p99", "depth_error_max")),
    shown("Depth error median / p99", together(dict.get, format.number, "depth_error_median", "depth_error_p99")),
)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The least ratio of a step at the largest size."""
    question = "Which renderer is fastest, timed in turn in one process?"
    large = data[(data["size"] == data["size"].max()) & (data["status"] == "ok")].dropna(subset="step_ratio")
    others = large[large["renderer"] != large["renderer"].iloc[0]] if len(large) else large
    if not len(others):
        return Answer(question)
    best = others.loc[others["step_ratio"].idxmin()]
    ends = f"({format.number(best['step_ratio_low'])} to {format.number(best['step_ratio_high'])})"
    said = (
        f"At {best['size']:.0f} × {best['size']:.0f} pixels a step of {best['renderer']} takes "
        f"*{format.number(best['step_ratio'])}* {ends}"
    )
    return Answer(question, f"{said} of the time of {large['renderer'].iloc[0]}.")
