"""Table 1 of DIST: the cost of each strategy of sphere tracing, measured and published."""

from dataclasses import replace

import pandas as pd

from bench.report.study import Result, Runs, Selection, format, records, table
from bench.report.write.table import metric

PLACE = 10
READS = (Selection("table1", alike=("dataset", "view", "prior", "task")),)
# DIST (Liu et al. 2020), Table 1: size, steps, queries, time; on a GTX 1080Ti. In the paper's order.
PUBLISHED = {
    "naive_serial": (512, 50, "N/A", "N/A"),
    "naive_practical": (512, 50, "6.06M", "1.6h"),
    "naive_practical_parallel": (512, 50, "6.06M", "3.39s"),
    "dist_dynamic": (512, 50, "1.99M", "1.23s"),
    "dist_aggressive": (512, 50, "1.43M", "1.08s"),
    "dist_coarse_to_fine": (512, 50, "887K", "0.99s"),
    "dist_coarse_to_fine_100": (512, 100, "898K", "1.24s"),
}
NOTES = (
    "Forward is one rendering without gradient, backward the backward pass of a step, and a step both and the loss; in "
    "brackets the least and the largest.",
    "Queries are points whose field value one rendering computes; coarse ones are computed in bfloat16, where they "
    "decide nothing.",
    "Peak memory is the largest growth of the memory of the process (CPU) or of PyTorch (GPU) in a step.",
    "Pixels and depths are compared with the float64 reference; depth errors, in scene units, are of pixels that both "
    "hit.",
    "“Published” is DIST, Table 1, on a GTX 1080Ti with another network and scene: not to be compared with our rows.",
)
_TIMES = ("forward_seconds", "backward_seconds", "step_seconds")
# Metrics of the CSV: at the requested size, and at a smaller one where that alone was finished.
MEASURED = (
    *("queries", "coarse_queries", "step_queries", "step_coarse_queries", "step_gradients", *_TIMES),
    *(f"{time}_{end}" for time in _TIMES for end in ("low", "high")),
    *("repeats", "forward_gemm", "step_gemm", "rays", "peak_memory_bytes", "hits", "lost", "false", "wrong"),
    *("depth_error_p99", "depth_error_max", "depth_error_median"),
)
FINISHED = ("size", "queries", "peak_memory_bytes", "hits", "lost", "false", "wrong", *_TIMES)


def make(runs: Runs) -> Result:
    """A line per strategy: the paper's in its order, then others in the order of their runs."""
    place = {preset: number for number, preset in enumerate(PUBLISHED)}
    presets = [records.row_of(record).preset for record in runs.records]
    order = sorted(range(len(presets)), key=lambda i: place.get(presets[i], len(place)))
    runs = replace(runs, records=[runs.records[i] for i in order])
    data, times = _data(runs), records.repeated(runs.records)
    return Result(
        runs,
        "The cost of each strategy of sphere tracing.",
        "Computed field values (queries), times, peak memory and errors of one rendering and its gradient"
        + (f", times as medians of {times} repeats." if times else "."),
        question="What does one rendering and its gradient cost, and what does each strategy save?",
        verdict=_verdict(data),
        remarks=NOTES,
        data=data,
        columns=COLUMNS,
        lines=runs.named(),
    )


def _data(runs: Runs) -> pd.DataFrame:
    """A line per run: what was measured at the requested size, what was published, what was finished at a smaller."""
    requested, steps = runs.number("config.view.resolution"), runs.number("config.renderer.steps")
    number = {
        name: pd.Series([records.measured(r, name) for r in runs.records], dtype=float)
        for name in {*MEASURED, *FINISHED}
    }
    done = number["size"] == requested
    full = {_key(name): number[name].where(done) for name in MEASURED}
    paper = pd.DataFrame([PUBLISHED.get(preset, (None,) * 4) for preset in runs.frame.preset], dtype=object)
    said = {f"published_{name}": paper[at] for at, name in enumerate(("size", "steps", "queries", "time"))}
    smaller = {f"finished_{_key(name)}": number[name].where(~done) for name in FINISHED}
    return table.to_data(table.IDENTITY, runs.records).assign(size=requested, steps=steps, **full, **said, **smaller)


def _key(metric: str) -> str:
    """The column of the CSV with a metric."""
    return metric.replace("_seconds", "_s")


def _verdict(data: pd.DataFrame) -> str:
    """The cheapest strategy and the dearest of those that finish."""
    found = data[(data["status"] == "ok") & data["step_s"].notna()]
    limits = int(data["status"].isin(["timeout", "oom"]).sum())
    said = f"A step, where it finishes ({limits} of {len(data)} rows reach a limit at this size)"
    return format.ends(said, dict(zip(found["row"], found["step_s"], strict=True)), "one shape", show=format.seconds)


def _size(record: records.Record) -> str:
    """The size at which the row was measured, with the requested size and the status where these differ."""
    size, requested = records.measured(record, "size"), records.setting(record["config"], "view", "resolution")
    status = "" if record["status"] == "ok" else record["status"]
    if size is not None and size == requested:
        return f"{requested} ({status})" if status else str(requested)
    return (
        f"{table.whole(size)} ({requested}: {record['status']})"
        if requested
        else f"{table.whole(size)} ({record['status']})"
    )


def _step(record: records.Record) -> str:
    """The median of the step's time and, in brackets, its minimum and maximum, without units where these are equal."""
    spread = [records.measured(record, f"step_seconds{end}") for end in ("", "_low", "_high")]
    texts = [format.seconds(x) for x in spread]
    if None in spread:
        return texts[0]
    same = len({time.split()[-1] for time in texts}) == 1
    return f"{texts[0]} ({texts[1].split()[0]}–{texts[2].split()[0]})" if same else "{} ({}–{})".format(*texts)


def _published(record: records.Record, part: int) -> str:
    return str(PUBLISHED.get(records.row_of(record).preset, ("",) * 4)[part])


COLUMNS = (  # of a record, for readers; metrics are those of the largest size that was finished
    *(
        table.text("name", "Strategy"),
        table.shown("Size", _size),
        table.configured("", "renderer", "steps", heading="Steps"),
    ),
    table.shown(
        "Queries", lambda r: format.queries(records.measured(r, "queries"), records.measured(r, "coarse_queries"))
    ),
    metric("forward_seconds", "Forward", format.seconds),
    metric("backward_seconds", "Backward", format.seconds),
    table.shown("Step", _step),
    metric("peak_memory_bytes", "Peak memory", format.size),
    metric("hits", "Hits", table.whole),
    table.shown(
        "Missed / spurious / wrong depth", table.together(records.measured, table.whole, "lost", "false", "wrong")
    ),
    table.shown(
        "Depth error median / max",
        table.together(records.measured, format.number, "depth_error_median", "depth_error_max"),
    ),
    table.shown("Published queries", lambda record: _published(record, 2)),
    table.shown("Published time", lambda record: _published(record, 3)),
)

PAGES = {"table1": make}
