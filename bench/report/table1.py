"""Table 1 of DIST: what each strategy of sphere tracing costs, with the published numbers beside ours."""

from typing import Any

import pandas as pd

from bench.report import format
from bench.report.caption import joined, omitted, outcome, setup
from bench.report.experiments import Experiment, definitions, identity, measured, repeated, row_name, setting
from bench.report.tables import Result

# DIST (Liu et al. 2020), Table 1: steps, queries, time of a row; 512×512 pixels on a GTX 1080Ti. In the paper's order.
PUBLISHED_SIZE = 512
PUBLISHED = {
    "Naive sphere tracing": (50, "N/A", "N/A"),
    "+ practical grad.": (50, "6.06M", "1.6h"),
    "+ parallel": (50, "6.06M", "3.39s"),
    "+ dynamic": (50, "1.99M", "1.23s"),
    "+ aggressive": (50, "1.43M", "1.08s"),
    "+ coarse-to-fine": (50, "887K", "0.99s"),
    "+ coarse-to-fine, 100 steps": (100, "898K", "1.24s"),
}
COUNTS = ("queries", "step_queries", "step_gradients")
COSTS = ("repeats", "forward_gemm", "step_gemm", "peak_memory_bytes", "rays")
TIMES = ("forward", "backward", "step")
QUALITY = ("hits", "lost", "false", "wrong", "depth_error_median", "depth_error_p99", "depth_error_max")
FINISHED = (
    "size",
    "queries",
    "forward_s",
    "backward_s",
    "step_s",
    "peak_memory_bytes",
    "hits",
    "lost",
    "false",
    "wrong",
)
DEFINED = {
    "queries": "Queries",
    "forward_seconds": "Forward",
    "backward_seconds": "Backward",
    "step_seconds": "Step",
    "peak_memory_bytes": "Peak memory",
    "hits": "Hits",
    "lost": "Lost",
    "false": "False",
    "wrong": "Wrong",
    "depth_error_median": "Depth error",
    "depth_error_max": "Depth error",
}
TITLE = "What each strategy of sphere tracing costs."
CAPTION = (
    "Forward and backward pass apart, and a step of an optimisation, which is both and the loss; in brackets the least "
    "and the largest time. Counts of pixels against the reference, depth errors in scene units. "
    "“Published” is DIST, Table 1: 512×512 pixels on a GTX 1080Ti, another network and scene, so not to be ranked "
    "with ours."
)


def make(experiment: Experiment) -> Result:
    """A row a strategy, in the paper's order, then all others in the order in which they started."""
    order = list(PUBLISHED)
    pairs = list(zip(experiment.names(), experiment.records, strict=True))
    pairs.sort(key=lambda pair: order.index(name) if (name := row_name(pair[1])) in PUBLISHED else len(order))
    records = [record for _, record in pairs]
    times = repeated(records)
    caption = joined(
        setup(experiment),
        f"Times are medians of {times} repeats." if times else "",
        CAPTION,
        outcome(experiment),
        omitted(experiment),
    )
    return Result(
        name="table1",
        title=TITLE,
        caption=caption,
        data=pd.DataFrame([_raw(record) for record in records], dtype=object),
        table=pd.DataFrame([_readable(name, record) for name, record in pairs]),
        notes=definitions(records, DEFINED),
    )


def _raw(record: dict[str, Any]) -> dict[str, Any]:
    """The measured columns are those of the asked size; what was measured at another stands as `finished_`."""
    asked, size = _asked(record), measured(record, "size")
    numbers = {name: measured(record, name) for name in COUNTS}
    for name in TIMES:
        numbers |= {f"{name}_s{end}": measured(record, f"{name}_seconds{end}") for end in ("", "_low", "_high")}
    numbers |= {name: measured(record, name) for name in (*COSTS, *QUALITY)}
    finished = size is not None and size == asked
    row = identity(record) | {"size": asked, "steps": setting(record["config"], "renderer", "steps")}
    row |= numbers if finished else dict.fromkeys(numbers)
    published = (PUBLISHED_SIZE, *PUBLISHED[row["row"]]) if row["row"] in PUBLISHED else (None,) * 4
    row |= dict(zip([f"published_{name}" for name in ("size", "steps", "queries", "time")], published, strict=True))
    smaller = {"size": size, **numbers}
    return row | {f"finished_{name}": None if finished else smaller[name] for name in FINISHED}


def _readable(name: str, record: dict[str, Any]) -> dict[str, str]:
    published = PUBLISHED.get(row_name(record))
    return {
        "Strategy": name,
        "Size": _size(record),
        "Steps": str(setting(record["config"], "renderer", "steps") or format.MISSING),
        "Queries": format.count(measured(record, "queries")),
        "Forward": format.seconds(measured(record, "forward_seconds")),
        "Backward": format.seconds(measured(record, "backward_seconds")),
        "Step": _spread(record, "step_seconds"),
        "Peak memory": format.size(measured(record, "peak_memory_bytes")),
        "Hits": _whole(record, "hits"),
        "Lost / false / wrong": _together(record, _whole, "lost", "false", "wrong"),
        "Depth error median / max": _together(record, _number, "depth_error_median", "depth_error_max"),
        "Published queries": published[1] if published else "",
        "Published time": published[2] if published else "",
    }


def _asked(record: dict[str, Any]) -> int | None:
    return setting(record["config"], "view", "resolution")


def _size(record: dict[str, Any]) -> str:
    """The size at which the row was measured; where it is not the asked one, or the run failed, that too."""
    size, asked, status = measured(record, "size"), _asked(record), record["status"]
    if size is not None and size == asked:
        return str(asked) if status == "ok" else f"{asked} ({status})"
    shown = format.MISSING if size is None else f"{size:.0f}"
    return f"{shown} ({asked}: {status})" if asked else f"{shown} ({status})"


def _whole(record: dict[str, Any], name: str) -> str:
    value = measured(record, name)
    return f"{value:.0f}" if value is not None else format.MISSING


def _number(record: dict[str, Any], name: str) -> str:
    return format.number(measured(record, name))


def _together(record: dict[str, Any], shown: Any, *names: str) -> str:
    texts = [shown(record, name) for name in names]
    return format.MISSING if set(texts) == {format.MISSING} else " / ".join(texts)


def _spread(record: dict[str, Any], name: str) -> str:
    """A median and, in brackets, the least and the largest; their unit is the median's where they give none."""
    middle, low, high = (measured(record, name + end) for end in ("", "_low", "_high"))
    if None in (middle, low, high):
        return format.seconds(middle)
    texts = [format.seconds(x) for x in (middle, low, high)]
    same = len({text.split()[-1] for text in texts}) == 1
    return f"{texts[0]} ({texts[1].split()[0]}–{texts[2].split()[0]})" if same else "{} ({}–{})".format(*texts)
