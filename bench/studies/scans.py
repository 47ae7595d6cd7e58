"""Completion from a scanner's measured depths, compared with exact depths at the same pixels."""

from typing import Any

import pandas as pd

from bench.report.study import Result, Runs, Selection, format, records, statistics, table

PLACE = 48
READS = (Selection("scans", ("task.depths",), setup=("scenes", "pixels")),)
METRICS = {"chamfer_l2": "Chamfer", records.ONE_WAY: "truth to prediction", "depth_mae": "depth error"}
EXACT, MEASURED, RATIO = "exact", "measured", "ratio"  # two values of task.depths, and the ratio of their errors
COLUMNS = (
    table.text("row", "Method"),
    *(
        table.Column(f"{name}_{kind}", f"{label.capitalize()}, {kind}")
        for name, label in METRICS.items()
        for kind in (EXACT, MEASURED, RATIO)
    ),
    table.text("failed", "Failed"),
)
RUNS = (
    *(table.FAMILY, table.configured("depths", "task", "depths"), *table.IDENTITY),
    *(*table.metrics(*METRICS), *table.LOOP),
)
NOTES = (
    "Scans of one object depend on each other, so there is no interval. A ratio is the median over scans of the error "
    "with measured depths divided by the error with exact depths; it is 1 if both failed.",
    "The depth error is that of the observed view. The Chamfer distance is that of the whole shape.",
    "Exact depths are depths of the mesh at the pixels that the scanner measured. Both use the mask of the mesh.",
    "A failed run counts as infinite. A refused run is left out.",
)
Line = dict[str, Any]


def make(runs: Runs) -> Result:
    counted = runs.executed
    pairs = {metric: _pairs(counted, metric) for metric in METRICS}
    lines = [_line(row.name, counted, pairs) for row in runs.rows()]
    scans = len(pairs["chamfer_l2"].groupby(["family", "solid", "seed"]))
    return Result(
        runs,
        "Shape from depths that a scanner measured.",
        "Median errors over scans with exact and with measured depths, and their ratio (times 1000; depths in scene "
        "units, distances between surfaces in squared scene units).",
        question="Does shape completion work as well with depths from a scanner as with exact depths?",
        verdict=table.extremes(
            "Chamfer distance with measured depths, relative to exact depths",
            {line["row"]: line.get(f"chamfer_l2_{RATIO}") for line in lines},
            f"{format.plural(scans, 'scan')} of {format.plural(len(runs.families()), 'object')}, without an interval",
        ),
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        run_columns=RUNS,
    )


def _pairs(runs: Runs, metric: str) -> pd.DataFrame:
    """The errors with exact and with measured depths, of each row, scan and seed with both runs."""
    frame = runs.frame.assign(error=runs.error(metric), depths=runs.setting("task.depths"))
    both = frame.pivot(index=["row", "preset", "family", "solid", "view", "seed"], columns="depths", values="error")
    return both.reindex(columns=[EXACT, MEASURED]).dropna()


def _line(row: str, runs: Runs, pairs: dict[str, pd.DataFrame]) -> Line:
    status = runs.frame.status[runs.frame.row == row]
    line: Line = {"row": row, "failed": f"{(status != 'ok').sum()} of {len(status)}"}
    for metric, errors in pairs.items():
        row_errors = errors[errors.index.get_level_values("row") == row]
        if len(row_errors):
            line |= {f"{metric}_{depths}": float(row_errors[depths].median()) for depths in (EXACT, MEASURED)}
            exact, measured = (row_errors[depths].to_numpy()[:, None] for depths in (EXACT, MEASURED))
            line[f"{metric}_{RATIO}"] = statistics.ratio([*measured], [*exact]).value
    return line


PAGES = {"scans": make}
