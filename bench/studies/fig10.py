"""Fig. 10 of DIST: shape from many views under other focal lengths and other noise in the initial code."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, conditions, format, medians, records, statistics

PLACE = 50
CONDITIONS = (
    conditions.Condition("focal", "focal length / the scene's", 1.0),
    conditions.Condition("start_scale", "noise in the initial code (prior's σ)", 1.0),
)
READS = (Selection("fig10", tuple(f"task.{one.key}" for one in CONDITIONS)),)
NOTES = (
    "One condition varies, the other is at 1; the noise is in standard deviations of the prior's training codes, so "
    "that 0 is the mean shape or, of a row with an encoder, that of the encoder's code.",
    "A mesh row moves the vertices of the prior's mesh by the photometric error, as PMO does, the paper's other curve.",
    "A run that did not end ok counts as infinite, drawn at the upper edge.",
    "The paper (Fig. 10, a chart without numbers) finds its method robust to both.",
)


def make(runs: Runs) -> Result:
    """A line per family, method and value of a condition."""
    lines = conditions.lines_of(runs.made.records, CONDITIONS)
    return Result(
        runs,
        "Shape from many views under other focal lengths and starts.",
        f"{conditions.BELOW[0].upper()}{conditions.BELOW[1:]}; in the figure, the median ratio to the error at 1 of "
        "the same shape.",
        question="Does another focal length or start change the shape that is found?",
        verdict=_verdict(runs.made),
        interval=conditions.INTERVALS,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=(*conditions.NAMED, *conditions.MEDIAN),
        lines=lines,
        run_columns=conditions.run_columns(CONDITIONS),
        figure=draw(lines),
    )


def draw(lines: Sequence[dict[str, Any]]) -> Figure:
    """Draws a panel per condition: a line per method, with the ratio of its error to that at 1."""
    panels = []
    for one in CONDITIONS:
        own = records.grouped([x for x in lines if x["key"] == one.key], lambda line: (line["method"], line["preset"]))
        changes = {row: _changes(of_row) for row, of_row in own.items()}
        drawn = [chart.curve(*row, change, change.values()) for row, change in changes.items() if change]
        panels.append(chart.panel_data("", one.label, "error / error at 1", drawn))
    return chart.draw(panels, 2.9, legend=3)


def _changes(lines: Sequence[dict[str, Any]]) -> dict[float, statistics.Interval]:
    """By the value of a condition, the ratio of a method's errors to those of the same runs where the value is 1."""
    errors = {
        value: medians.errors_of((run for line in own for run in line["runs"]), records.ONE_WAY)
        for value, own in sorted(records.grouped(lines, lambda line: line["at"]).items())
    }
    ratios = {value: medians.paired_ratio(own, errors.get(1.0, {})) for value, own in errors.items()}
    return {value: ratio for value, ratio in ratios.items() if ratio}


def _verdict(runs: Runs) -> str:
    """By which factor the median error of each row and family changes between conditions."""
    keys = [runs.frame.row, runs.frame.family, *(runs.setting(f"task.{one.key}") for one in CONDITIONS)]
    of_rows = runs.error(records.ONE_WAY).groupby(keys, sort=False).median().groupby(level=[0, 1])
    spread = {", ".join(names): ratio for names, ratio in (of_rows.max() / of_rows.min()).items()}
    shapes = format.plural(len(runs.frame[["family", "solid"]].drop_duplicates()), "shape")
    return format.ends("Largest over least median error of all conditions", spread, shapes)


PAGES = {"fig10": make}
