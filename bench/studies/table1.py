"""Table 1 of DIST: the cost of each strategy of sphere tracing, measured and published."""

from dataclasses import replace
from itertools import pairwise

from bench.report.study import Result, Runs, Selection, format, merge_runs, published, records, table

PLACE = 10
ALIKE = ("dataset", "view", "prior", "task")
READS = (Selection("table1", alike=ALIKE), Selection("table1_large", alike=ALIKE))  # 64 pixels, and the paper's 512
NOTES = (
    "Forward is one rendering without gradients. A step is a rendering with gradients, the loss and the backward pass. "
    "It takes longer than forward and backward together. In brackets: the smallest and the largest time of several "
    "repeats.",
    "“+ dynamic” also clamps field values to 0.1, like all rows below except “no clamp”. Naive tracing has no clamp.",
    "Field evaluations are those of one rendering. Coarse evaluations use bfloat16, away from the surface.",
    "Pixels and depths are compared with a float64 reference. Depth errors are in scene units, over the pixels that "
    "are hits in both images.",
    "Behind the surface: the percentage of field evaluations, coarse ones included, that are negative (DIST, Fig. 14).",
    "“Published” is DIST, Table 1, on a GTX 1080Ti with another network and scene. Compare ratios, not numbers.",
)
ANSWER_END = "; n = one shape."
WRONG = "Missed / spurious / wrong depth"
_TIME_METRICS = ("forward_seconds", "backward_seconds", "step_seconds")
# Metrics of the CSV at the requested size; empty if only a smaller size was finished.
CSV_METRICS = (
    *("queries", "coarse_queries", "step_queries", "step_coarse_queries", "step_gradients", *_TIME_METRICS),
    *(f"{time}_{end}" for time in _TIME_METRICS for end in ("low", "high")),
    *("repeats", "forward_gemm", "step_gemm", "rays", "peak_memory_bytes", "hits", "lost", "false", "wrong", "behind"),
    *("depth_error_p99", "depth_error_max", "depth_error_median"),
)


def make(small: Runs | None, large: Runs | None) -> Result:
    runs = merge_runs(small, large)
    rank = {preset: number for number, preset in enumerate(published("dist_table1"))}
    ranks = {id(record): rank.get(records.row_of(record).preset, len(rank)) for record in runs.records}
    runs = replace(runs, records=sorted(runs.records, key=lambda run: (_requested(run) or 0, ranks[id(run)])))
    times = records.repeated(runs.records)
    return Result(
        runs,
        "The cost of each strategy of sphere tracing.",
        "Field evaluations, times and errors of one rendering and its gradient"
        + (f"; times are medians of {times} repeats." if times else "."),
        question="What does one rendering with its gradient cost, and how much does each strategy save?",
        verdict=_verdict(runs),
        remarks=NOTES,
        columns=COLUMNS,
        lines=runs.named(),
        run_columns=RUNS,
    )


def _verdict(runs: Runs) -> str:
    answers = (_speedups(runs, size) for size in dict.fromkeys(map(_requested, runs.records)))
    texts = [answer.removesuffix(ANSWER_END) for answer in answers if answer]
    return ". ".join(texts) + (ANSWER_END if texts else "")


def _speedups(runs: Runs, size: int | None) -> str:
    steps = {
        records.row_of(record).preset: (records.row_of(record).name, _at_size(record, "step_seconds"))
        for record in runs.records
        if _requested(record) == size and record["status"] == "ok"
    }
    chain = [steps.get(preset, ("", None)) for preset in list(published("dist_table1"))[:-1]]
    factors = [f"{name} *{above / time:.1f}×*" for (_, above), (name, time) in pairwise(chain) if above and time]
    if not factors:
        return table.extremes(f"Step runtime at {size} pixels", dict(steps.values()), "one shape", show=format.seconds)
    ends = [f"{format.seconds(time)} ({name})" for name, time in chain if time]
    title = f"A step at {size} pixels takes {ends[0]} to {ends[-1]}"
    return f"{title}. Speedup over the previous one: {', '.join(factors)}"


def _requested(record: records.Record) -> int | None:
    return records.setting(record["config"], "view", "resolution")


def _at_size(record: records.Record, metric: str) -> float | None:
    return records.measured(record, metric) if records.measured(record, "size") == _requested(record) else None


def _size(record: records.Record) -> str:
    size, requested = records.measured(record, "size"), _requested(record)
    status = "" if record["status"] == "ok" else record["status"]
    if size is not None and size == requested:
        return f"{requested} ({status})" if status else str(requested)
    prefix = f"{requested}: " if requested else ""
    return f"{table.integer(size)} ({prefix}{record['status']})"


def _step(record: records.Record) -> str:
    """The median of the step's time, with minimum and maximum in brackets, without units if these are equal."""
    spread = [records.measured(record, f"step_seconds{end}") for end in ("", "_low", "_high")]
    texts = [format.seconds(x) for x in spread]
    if None in spread or len({*spread}) == 1:
        return texts[0]
    same = len({time.split()[-1] for time in texts}) == 1
    return f"{texts[0]} ({texts[1].split()[0]}–{texts[2].split()[0]})" if same else "{} ({}–{})".format(*texts)


def _published(record: records.Record, column: str) -> str | None:
    return published("dist_table1").get(records.row_of(record).preset, {}).get(column)


def _shown(record: records.Record, column: str) -> str:
    return str(_published(record, column) or "") if _published(record, "size") == str(_requested(record)) else ""


RUNS = (
    *table.IDENTITY,
    table.Column("size", value=_requested),
    table.configured("steps", "renderer", "steps"),
    *(
        table.Column(name.replace("_seconds", "_s"), value=lambda record, name=name: _at_size(record, name))
        for name in CSV_METRICS
    ),
    *(
        table.Column(f"published_{name}", value=lambda record, name=name: _published(record, name))
        for name in ("size", "steps", "queries", "time")
    ),
)
COLUMNS = (  # shown columns of a record; metrics are those of the largest finished size
    table.text("name", "Strategy"),
    table.shown("Size", _size),
    table.configured("", "renderer", "steps", heading="Marching steps"),
    table.shown(
        "Field evaluations",
        lambda r: table.queries(records.measured(r, "queries"), records.measured(r, "coarse_queries")),
    ),
    table.metric("forward_seconds", "Forward", format.seconds),
    table.metric("backward_seconds", "Backward", format.seconds),
    table.shown("Time of a step", _step),
    table.metric("hits", "Reference hits", table.integer),
    table.joined(WRONG, records.measured, table.integer, "lost", "false", "wrong"),
    table.joined("Depth error median / max", records.measured, format.number, "depth_error_median", "depth_error_max"),
    table.metric("behind", "Behind the surface (%)", lambda share: format.number(share, 100)),
    table.shown("Published evaluations", lambda record: _shown(record, "queries")),
    table.shown("Published time of a step", lambda record: _shown(record, "time")),
)

PAGES = {"table1": make}
