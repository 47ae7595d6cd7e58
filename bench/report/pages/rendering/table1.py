"""Table 1 of DIST: the cost of each strategy of sphere tracing, measured and published."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pandas as pd

from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Record, definitions, measured, repeated, row_of, setting
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, configured, shown, to_data, to_table, together, whole

PLACE = 10
READS = (Selection("table1", ("ablation",)),)
# DIST (Liu et al. 2020), Table 1: steps, queries, time; 512×512 pixels on a GTX 1080Ti. In the paper's order.
PUBLISHED_SIZE = 512
PUBLISHED = {
    "naive_serial": (50, "N/A", "N/A"),
    "naive_practical": (50, "6.06M", "1.6h"),
    "naive_practical_parallel": (50, "6.06M", "3.39s"),
    "dist_dynamic": (50, "1.99M", "1.23s"),
    "dist_aggressive": (50, "1.43M", "1.08s"),
    "dist_coarse_to_fine": (50, "887K", "0.99s"),
    "dist_coarse_to_fine_100": (100, "898K", "1.24s"),
}
DEFINED = {
    "queries": "Queries",
    "coarse_queries": "Coarse",
    "forward_seconds": "Forward",
    "backward_seconds": "Backward",
    "step_seconds": "Step",
    "peak_memory_bytes": "Peak memory",
    "hits": "Hits",
    "lost": "Missed",
    "false": "Spurious",
    "wrong": "Wrong depth",
    "depth_error_median": "Depth error",
    "depth_error_max": "Depth error",
}
NOTES = (
    "The forward and the backward pass are timed separately; a step of an optimisation is both and the loss. In "
    "brackets: the minimum and maximum.",
    "Pixels are compared with the reference; depth errors are in scene units.",
    "“Published” is DIST, Table 1: 512×512 pixels on a GTX 1080Ti, with another network and scene, so it cannot be "
    "compared directly with the measured rows.",
)


Show = Callable[[float | None], str]


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per strategy: the paper's in its order, then others in the order of their runs."""
    place = {preset: number for number, preset in enumerate(PUBLISHED)}
    lines = sorted(experiment.named(), key=lambda record: place.get(row_of(record).preset, len(place)))
    times = repeated(lines)
    return Result(
        experiment,
        "The cost of each strategy of sphere tracing.",
        "Computed field values (queries), times, peak memory and errors of one rendering and its gradient"
        + (f", times as medians of {times} repeats." if times else "."),
        remarks=(*NOTES, *definitions(lines, DEFINED)),
        data=to_data(COLUMNS, lines),
        table=to_table(COLUMNS, lines),
    )


def _finished(record: Record) -> bool:
    """Whether the row was measured at the requested size."""
    size = measured(record, "size")
    return size is not None and size == _requested(record)


def _requested(record: Record) -> int | None:
    return setting(record["config"], "view", "resolution")


def _cost(name: str, heading: str = "", show: Show = format.number, *, key: str = "") -> Column:
    """A column of a metric: the CSV has it only at the requested size, the table at the largest that finished."""
    return Column(
        key or name,
        heading,
        lambda record: measured(record, name) if _finished(record) else None,
        words=lambda record: show(measured(record, name)),
    )


def _otherwise(name: str, key: str = "") -> Column:
    """A column of the CSV with a metric that was measured at a smaller size than the requested one."""
    return Column(f"finished_{key or name}", value=lambda r: None if _finished(r) else measured(r, name))


def _published(part: int) -> Callable[[Record], Any]:
    """A published number of the row: size, steps, queries or time, by its index."""
    return lambda record: (PUBLISHED_SIZE, *p)[part] if (p := PUBLISHED.get(row_of(record).preset)) else None


def _size(record: Record) -> str:
    """The size at which the row was measured, with the requested size and the status where these differ."""
    size, requested, status = measured(record, "size"), _requested(record), record["status"]
    if _finished(record):
        return str(requested) if status == "ok" else f"{requested} ({status})"
    return f"{whole(size)} ({requested}: {status})" if requested else f"{whole(size)} ({status})"


def _step(record: Record) -> str:
    """The median of the step's time and, in brackets, its minimum and maximum, without units where these are equal."""
    middle, low, high = (measured(record, f"step_seconds{end}") for end in ("", "_low", "_high"))
    if None in (middle, low, high):
        return format.seconds(middle)
    texts = [format.seconds(x) for x in (middle, low, high)]
    same = len({time.split()[-1] for time in texts}) == 1
    return f"{texts[0]} ({texts[1].split()[0]}–{texts[2].split()[0]})" if same else "{} ({}–{})".format(*texts)


_FINISHED = ("size", "queries", "peak_memory_bytes", "hits", "lost", "false", "wrong")
_TIMES = ("forward", "backward", "step")
COLUMNS = (
    shown("Strategy", lambda record: record["name"]),
    *IDENTITY,
    Column("size", "Size", _requested, words=_size),
    configured("steps", "renderer", "steps", heading="Steps"),
    replace(
        _cost("queries", "Queries"),
        words=lambda r: format.queries(measured(r, "queries"), measured(r, "coarse_queries")),
    ),
    *(_cost(name) for name in ("coarse_queries", "step_queries", "step_coarse_queries", "step_gradients")),
    _cost("forward_seconds", "Forward", format.seconds, key="forward_s"),
    _cost("backward_seconds", "Backward", format.seconds, key="backward_s"),
    replace(_cost("step_seconds", "Step", key="step_s"), words=_step),
    *(_cost(f"{name}_seconds_{end}", key=f"{name}_s_{end}") for name in _TIMES for end in ("low", "high")),
    *(_cost(name) for name in ("repeats", "forward_gemm", "step_gemm", "rays")),
    _cost("peak_memory_bytes", "Peak memory", format.size),
    _cost("hits", "Hits", whole),
    replace(
        _cost("lost", "Missed / spurious / wrong depth"), words=together(measured, whole, "lost", "false", "wrong")
    ),
    *(_cost("false"), _cost("wrong"), _cost("depth_error_p99"), _cost("depth_error_max")),
    replace(
        _cost("depth_error_median", "Depth error median / max"),
        words=together(measured, format.number, "depth_error_median", "depth_error_max"),
    ),
    *(Column("published_size", value=_published(0)), Column("published_steps", value=_published(1))),
    Column("published_queries", "Published queries", _published(2), lambda queries: queries or ""),
    Column("published_time", "Published time", _published(3), lambda time: time or ""),
    *(_otherwise(name) for name in _FINISHED),
    *(_otherwise(f"{name}_seconds", f"{name}_s") for name in _TIMES),
)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """Which strategy costs least, of those that finish."""
    question = "What does one rendering and its gradient cost, and what does each strategy save?"
    found = data[data["status"] == "ok"].dropna(subset="step_s").sort_values("step_s")
    if len(found) < 2:
        return Answer(question)
    first, last = found.iloc[0], found.iloc[-1]
    said = (
        f"A step takes *{format.seconds(first['step_s'])}* with {first['row']} and "
        f"{format.seconds(last['step_s'])} with "
    )
    return Answer(
        question, f"{said}{last['row']}; {len(data) - len(found)} of {len(data)} rows reach a limit at this size."
    )
