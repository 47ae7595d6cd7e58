"""Error over time and over field values as shapes are completed, and the time to a target error."""

import math
from typing import Any

import pandas as pd

from bench.report.data.records import CHAMFER_SCALE, Record, base_renderer, median_or_none
from bench.report.study import Result, Runs, Selection, chart, curves, format, statistics, table

PLACE = 90
READS = (Selection("speed_completion"),)
TARGET_ERROR = 1e-3  # Chamfer distance in squared scene units
COST_AXES = {"seconds": "time (seconds)", "value_evaluations": "field evaluations"}
ERROR = "Chamfer × 1000 (scene units²)"
NOTES = (
    "The figure has a curve for the first setting of each renderer: medians over runs of cost and error at the "
    "checkpoints, after 1, 2, 4, ... iterations.",
    f"The table has all settings, the number of runs that reached an error × 1000 of {CHAMFER_SCALE * TARGET_ERROR:g}, "
    "and the median time to this error. The time is that of the first checkpoint with the error, so it is up to twice "
    "the true time. For a run that failed or never reached the error, it is infinite.",
    "ρ is the median over runs of Spearman's rank correlation of loss and Chamfer distance over a run's checkpoints.",
)
COLUMNS = (
    *table.columns(table.word, setting="Setting", runs="Runs", reached="Reached"),
    *(*table.columns(format.seconds, time="Median time to error"), *table.columns(rank="ρ of loss and error")),
)
Line = dict[str, Any]  # a setting of a renderer, with its records and histories


def make(runs: Runs) -> Result:
    lines = [_line(runs, records) | {"setting": row.name, "preset": row.preset} for row, records in runs.rows().items()]
    identity_columns = (*table.IDENTITY, table.FAMILY)
    data = [
        history.assign(**{column.key: column.of(record) for column in identity_columns})
        for line in lines
        for record, history in zip(line["records"], line["histories"], strict=True)
    ]
    panels = [_panel(lines, axis) for axis in COST_AXES if axis != "seconds" or runs.timed]
    return Result(
        runs,
        "Error over time and over field evaluations.",
        f"Chamfer distance over {'seconds and over ' if runs.timed else ''}field evaluations.",
        question="How fast does the error decrease?",
        verdict=_verdict(lines),
        remarks=NOTES,
        data=pd.concat(data)[[*(column.key for column in identity_columns), *curves.HISTORY]],
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw(panels, 2.9, legend=5, sharey=True),
        chart={
            "panels": panels,
            "note": "A curve: medians over the runs of a setting. Click on it for the runs.",
        },
    )


def _line(runs: Runs, records: list[Record]) -> Line:
    histories = [curves.history_of(runs, record) for record in records]
    times = [time_to(history, record) for history, record in zip(histories, records, strict=True)]
    return {
        **{"renderer": base_renderer(records[0]), "records": records, "histories": histories},
        **{"runs": len(times), "reached": sum(map(math.isfinite, times)), "time": float(statistics.median(times))},
        "rank": median_or_none(curves.spearman(history.dropna()) for history in histories),
    }


def time_to(history: pd.DataFrame, record: Record) -> float:
    """The seconds at a run's first checkpoint at the target; infinite if it failed or did not reach the target."""
    below = history[history["error"] <= CHAMFER_SCALE * TARGET_ERROR]
    return float(below["seconds"].iloc[0]) if record["status"] == "ok" and len(below) else math.inf


def _verdict(lines: list[Line]) -> str:
    reached = {line["setting"]: line["time"] for line in lines if math.isfinite(line["time"])}
    title = f"Median time to an error of {CHAMFER_SCALE * TARGET_ERROR:g} (Chamfer × 1000)"
    n = min(line["runs"] for line in lines)
    runs = f"{n} runs per setting; {len(reached)} of {len(lines)} settings reach it in most runs"
    return table.extremes(title, reached, runs, show=format.seconds)


def _panel(lines: list[Line], axis: str) -> dict[str, Any]:
    """A line per setting over seconds or field evaluations; only the first setting of each renderer is switched on."""
    first_settings, drawn = {line["renderer"]: line["setting"] for line in reversed(lines)}, []
    for line in lines:
        failed = [record["status"] != "ok" for record in line["records"]]
        medians = curves.median(line["histories"], failed, "error").set_index("iteration")
        costs = curves.median(line["histories"], [False] * len(failed), axis).set_index("iteration")["median"]
        medians = medians.assign(cost=costs)  # of an iteration that all runs have
        medians = medians[(medians["cost"] > 0) & medians["median"].map(math.isfinite)]
        points = medians[["cost", "median"]].values
        show = format.seconds if axis == "seconds" else format.count
        text = [[line["setting"], f"{show(cost)}, error × 1000 {format.number(error)}"] for cost, error in points]
        look = {"text": text, "link": [chart.link_to_runs(line["setting"])] * len(points), "size": 4}
        look |= {} if first_settings[line["renderer"]] == line["setting"] else {"off": True}
        drawn.append(chart.curve(line["setting"], line["preset"], *points.T, **look))
    return chart.panel_data("", COST_AXES[axis], ERROR, drawn, height=420)


PAGES = {"speed_curves": make}
