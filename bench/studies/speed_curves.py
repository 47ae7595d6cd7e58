"""Error over time and over field values as shapes are completed, and the time to a target error."""

import math
from typing import Any

import pandas as pd

from bench.report.data.records import SCALE, Record, base_renderer, family, index, median_of_known
from bench.report.study import Result, Runs, Selection, chart, curves, format, statistics, table

PLACE = 90
READS = (Selection("speed_completion"),)
TARGET = 1e-3  # Chamfer distance (squared scene units); the time to reach it is measured
ALONG = {"seconds": "time (seconds)", "value_evaluations": "field values"}
ERROR = "Chamfer × 1000 (scene units²)"
NOTES = (
    "The figure has a line per run of each renderer's first setting, as far as the run came.",
    f"The table has all settings, how many of their runs reached {SCALE * TARGET:g} × 10⁻³, and the median time to it "
    "over all runs, infinite for a run that did not end ok or never was at it.",
    "ρ is the median over runs of Spearman's rank correlation of loss and Chamfer distance over a run's checkpoints.",
)
COLUMNS = (
    *(table.text("setting", "Setting"), table.text("runs", "Runs"), table.text("reached", "Reached")),
    *(table.Column("time", "Median time to it", show=format.seconds), table.Column("rank", "ρ of loss and error")),
)
Line = dict[str, Any]  # of a setting of a renderer, with its records and histories


def make(runs: Runs) -> Result:
    """A line per setting: its runs, how many reached the target, and their median time."""
    lines = [_line(runs, records) | {"setting": row.name, "preset": row.preset} for row, records in runs.rows().items()]
    own = (*table.IDENTITY, table.FAMILY)
    data = [
        history.assign(**{column.key: column.of(record) for column in own})
        for line in lines
        for record, history in zip(line["records"], line["histories"], strict=True)
    ]
    panels = [_panel(lines, along) for along in ALONG if along != "seconds" or runs.timed]
    return Result(
        runs,
        "Error over time and over field values.",
        f"Chamfer distance over {'seconds and over ' if runs.timed else ''}field values.",
        question="How fast does the error fall?",
        verdict=_verdict(lines),
        remarks=NOTES,
        data=pd.concat(data)[[*(column.key for column in own), *curves.HISTORY]],
        columns=COLUMNS,
        lines=lines,
        figure=chart.draw(panels, 2.9, legend=5, sharey=True),
        chart={"panels": panels, "note": "A line is a run, which a click opens."},
    )


def _line(runs: Runs, records: list[Record]) -> Line:
    histories = [curves.history_of(runs, record) for record in records]
    times = [time_to(history, record) for history, record in zip(histories, records, strict=True)]
    return {
        **{"renderer": base_renderer(records[0]), "records": records, "histories": histories},
        **{"runs": len(times), "reached": sum(map(math.isfinite, times)), "time": float(statistics.median(times))},
        "rank": median_of_known(curves.spearman(history.dropna()) for history in histories),
    }


def time_to(history: pd.DataFrame, record: Record) -> float:
    """The seconds at a run's first checkpoint at the target; infinite where it did not end ok or reach it."""
    below = history[history["error"] <= SCALE * TARGET]
    return float(below["seconds"].iloc[0]) if record["status"] == "ok" and len(below) else math.inf


def _verdict(lines: list[Line]) -> str:
    """The times of the settings that reach the target on most shapes."""
    reached = {line["setting"]: line["time"] for line in lines if math.isfinite(line["time"])}
    what = f"Median time to an error of {SCALE * TARGET:g} (Chamfer × 1000)"
    n = min(line["runs"] for line in lines)
    runs = f"{n} runs each, and {len(reached)} of {len(lines)} settings reach it in most"
    return format.ends(what, reached, runs, show=format.seconds)


def _panel(lines: list[Line], along: str) -> dict[str, Any]:
    """A line per run over seconds or field values; of the first setting of each renderer at first."""
    first = {line["renderer"]: line["setting"] for line in reversed(lines)}
    drawn = []
    for line in lines:
        for record, history in zip(line["records"], line["histories"], strict=True):
            one = history[history[along] > 0]
            scene = f"{family(record)} {index(record)}, seed {record['seed']}"
            costs = [
                f"{format.seconds(s)}, error × 1000 {format.number(e)}" for s, e in one[["seconds", "error"]].values
            ]
            look = {"text": [[scene, cost] for cost in costs], "link": [f"#/run/{record['folder']}"] * len(one)}
            look |= {"size": 4} | ({} if first[line["renderer"]] == line["setting"] else {"off": True})
            drawn.append(chart.curve(line["setting"], record["renderer"], one[along], one["error"], **look))
    return chart.panel_data("", ALONG[along], ERROR, drawn, height=420)


PAGES = {"speed_curves": make}
