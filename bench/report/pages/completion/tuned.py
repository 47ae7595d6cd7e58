"""Each method at its defaults, tuned, and at its paper's setting, side by side."""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Row, median_of_known, value_evaluations
from bench.report.data.statistics import geometric_mean
from bench.report.data.subjects.completions import ERROR, EVERY, FAILURE, Completions, heading, shapes_per_cell
from bench.report.data.subjects.wins import Gap, excluding_one, gap
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import COMPLETION, FAMILY, LOOP, Column, configured, text, to_data, to_table

PLACE = 38
READS = (Selection("tuned", ("completion",), ("dataset", "task"), ("points",)),)
FOLDER = "tuned/"  # of the presets that `python -m bench.tune` writes
PAPERS = ("_paper", "_official")  # ends of the names of presets with a paper's setting
NOTES = (
    "The ratio is that of geometric means over shapes, of each shape's geometric mean over all numbers of points, to "
    "those of the same method at its defaults; behind it the number of shapes on which the row is better, ties half.",
    "Tuned rows: conf/tuned.yaml, chosen on validation shapes by `python -m bench.tune`; `chosen` says from "
    "which runs. At desk these are of sofas and planes from 20 points: other families and numbers of points are not "
    "what the rows were tuned for.",
    "In the figure cost is the median number of a run's field values; hollow points are methods at their defaults, "
    "filled ones are tuned or at the paper's setting.",
)
RUNS = (FAMILY, configured("points", "task", "points"), *COMPLETION, *LOOP)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and row: medians, and the ratio to the method's defaults."""
    runs = Completions(experiment)
    lines = [_line(runs, name, row) for name in runs.families for row in runs.rows_of(name)]
    columns = [
        *(text("family", "Family"), text("row", "Method")),
        *(Column(points, heading(points)) for points in runs.points),
        *(
            text("gap", "Ratio to the default", lambda line: "" if line["gap"] is None else line["gap"]),
            text("failed", "Failed"),
        ),
    ]
    return Result(
        experiment,
        "Methods at their defaults, tuned, and at their papers' settings.",
        "Median error at each number of given depth points; in the figure, the geometric mean of all errors over cost.",
        interval="95 % intervals of the ratios over shapes (Student's, of logarithms)",
        estimates=[line["gap"].ratio for line in lines if line["gap"] is not None],
        remarks=(*verdict(lines), ERROR, FAILURE, shapes_per_cell(runs), *NOTES),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, lines),
        figure=draw(experiment, runs),
    )


def verdict(lines: list[dict[str, Any]]) -> list[str]:
    """Where a tuned setting is better or worse than the method's defaults by its interval, in words."""
    tuned = [(line, line["gap"].ratio) for line in lines if line["tuned"] and line["gap"] is not None]
    ratios = [(f"{line['row']} on {line['family']}, {ratio}", ratio) for line, ratio in tuned]
    return excluding_one(ratios, "of tuned settings to the defaults")


def _line(runs: Completions, name: str, row: Row) -> dict[str, Any]:
    medians = {points: runs.median(name, row, points) for points in runs.points}
    failed = "{} of {}".format(*runs.failures(name, row))
    tuned = row.preset.startswith(FOLDER)
    return {"family": name, "row": row.name, "gap": _gap(runs, name, row), "failed": failed, "tuned": tuned, **medians}


def _gap(runs: Completions, name: str, row: Row) -> Gap | None:
    """The gap to the row's method at its defaults; None for that itself."""
    default = next((other for other in runs.rows if other.preset == default_of(row.preset)), row)
    return None if default == row else gap(*runs.pair(name, row, default, finite=True))


@style.styled
def draw(experiment: Experiment, runs: Completions) -> Figure:
    """Draws each row's error over all families and its cost, with an arrow from a method to its tuned row."""
    figure, axes = chart.sheet(3.4, width=5.0)
    axis, places = axes[0, 0], {}
    for row, records in experiment.rows().items():
        errors = [*runs.over_points(EVERY, row, finite=True).values()]
        cost = median_of_known(map(value_evaluations, records))
        place = style.finite([cost, geometric_mean(errors) if errors else None])
        default = default_of(row.preset)
        how = {"mfc": "none"} if default == row.preset else {}
        look = default if row.preset.startswith(FOLDER) else row.preset
        chart.points(axis, look, place[:1], place[1:], label=row.name, ms=5, **how)
        places[row.preset] = place
    for preset, end in places.items():
        start = places.get(preset.removeprefix(FOLDER))
        if preset.startswith(FOLDER) and start is not None:
            colour = style.look(preset.removeprefix(FOLDER)).colour
            axis.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": colour, "lw": 0.8})
    axis.set(xlabel="field values per run", ylabel="Chamfer × 1000 (scene units²)")
    for letter, values in zip(("x", "y"), zip(*places.values(), strict=True), strict=True):
        style.log_axis(axis, letter, values)
    style.legend_below(figure, axis, columns=2)
    return figure


def default_of(preset: str) -> str:
    """The preset of which another is the tuned or the paper's setting."""
    name = preset.removeprefix(FOLDER)
    return next((name.removesuffix(end) for end in PAPERS if name.endswith(end)), name)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """How many tuned settings differ from the defaults, as the notes have it."""
    said = next((note for note in notes if note.startswith("The interval excludes 1 for ")), "")
    head, _, rest = said.removeprefix("The interval excludes 1 for ").partition(" ratios")
    verdict = f"The interval excludes 1 for *{head}* ratios{rest}" if said else ""
    return Answer("Are our defaults as good as tuned settings?", verdict)
