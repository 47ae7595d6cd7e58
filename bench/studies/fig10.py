"""Fig. 10 of DIST: shape from many views under other focal lengths and other noise in the initial code."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, conditions, medians, records, statistics, table

PLACE = 50
CONDITIONS = (
    conditions.Condition("focal", "focal length / the scene's", 1.0),
    conditions.Condition("start_scale", "noise in the initial code (prior's σ)", 1.0),
)
KEYS = tuple(f"task.{condition.key}" for condition in CONDITIONS)
READS = (Selection("fig10", KEYS, setup=Selection.WITHOUT_MACHINE, may_differ=("prior.truncation",)),)
NOTES = (
    "One condition varies, and the other is at 1. The noise is in standard deviations σ of the prior's training codes. "
    "At 0, a run starts from the mean shape or, with an encoder, from the encoder's code.",
    "Mesh rows have gradients through the vertices of the prior's mesh, like PMO, the paper's other curve.",
    "A failed run counts as infinite and is drawn at the upper edge.",
    "The paper (Fig. 10, a chart without numbers) reports that its method is robust to other focal lengths "
    "and initial codes.",
)


def make(runs: Runs) -> Result:
    lines = conditions.lines_of(runs.executed.records, CONDITIONS)
    return Result(
        runs,
        "Shape from many views under other focal lengths and initial codes.",
        f"{conditions.ERROR_TEXT[0].upper()}{conditions.ERROR_TEXT[1:]}; in the figure, the median ratio to the error "
        "of the same shape at 1.",
        question="Does another focal length or initial code change the reconstructed shape?",
        verdict=_verdict(runs.executed),
        interval=conditions.INTERVALS,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=(*conditions.NAME_COLUMNS, *conditions.MEDIAN_COLUMNS),
        lines=lines,
        run_columns=conditions.run_columns(CONDITIONS),
        figure=draw(lines),
    )


def draw(lines: Sequence[dict[str, Any]]) -> Figure:
    """Draws a panel per condition: a line per method, with the ratio of its error to its error at 1."""
    panels = []
    for condition in CONDITIONS:
        varied = [line for line in lines if line["key"] == condition.key]
        rows = records.grouped(varied, lambda line: (line["method"], line["preset"]))
        drawn = [chart.curve(*row, ratio, ratio.values()) for row, group in rows.items() if (ratio := _ratios(group))]
        panels.append(chart.panel_data("", condition.label, "error / error at 1", drawn))
    return chart.draw(panels, 2.9, legend=3)


def _ratios(lines: Sequence[dict[str, Any]]) -> dict[float, statistics.Interval]:
    """Of a method's errors to its errors on the same shapes at value 1, by value of a condition."""
    errors = {
        value: medians.errors_of((run for line in value_lines for run in line["runs"]), records.ONE_WAY)
        for value, value_lines in sorted(records.grouped(lines, lambda line: line["value"]).items())
    }
    ratios = {value: medians.paired_ratio(value_lines, errors.get(1.0, {})) for value, value_lines in errors.items()}
    return {value: ratio for value, ratio in ratios.items() if ratio}


def _verdict(runs: Runs) -> str:
    """The factor between the smallest and largest median error over conditions, of each row and family."""
    keys = [runs.frame.row, runs.frame.family, *map(runs.setting, KEYS)]
    errors = runs.error(records.ONE_WAY).groupby(keys, sort=False).median().groupby(level=[0, 1])
    factors = {", ".join(names): ratio for names, ratio in (errors.max() / errors.min()).items()}
    return table.extremes(
        "Largest median error of all conditions, relative to the smallest",
        factors,
        conditions.shapes_text(runs.records),
    )


PAGES = {"fig10": make}
