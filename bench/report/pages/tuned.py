"""Each method as it stands, tuned, and at its paper's setting, side by side."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data import statistics
from bench.report.data.completions import ERROR, Completions, heading, shapes_per_cell
from bench.report.data.crossing import geometric_mean, shape_medians
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import Row, median_of_known, value_evaluations
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, configured, metrics, text, to_data, to_table

PLACE = 38
READS = (Selection("tuned", ("completion",), ("dataset", "task"), ("points",)),)
SEED = 0  # of the bootstrap
FOLDER = "tuned/"  # of the presets that `python -m bench.tune` writes
PAPERS = ("_paper", "_official")  # ends of the names of presets with a paper's setting
NOTES = (
    "The ratio is that of geometric means over shapes, of each shape's geometric mean over all numbers of points, to "
    "those of the same method as it stands; behind it on how many shapes the row is better, ties half.",
    "Tuned rows: conf/method/tuned, chosen on validation shapes by `python -m bench.tune`; their first lines say from "
    "which runs.",
    "The figure: geometric mean over all shapes and numbers of points over the median number of a run's field values; "
    "hollow as the method stands, filled tuned or the paper's setting.",
)
RUNS = (
    *(FAMILY, configured("points", "task", "points"), *IDENTITY),
    *metrics("chamfer_l2", "chamfer_l1", "normal_consistency", "mask_iou"),
    *LOOP,
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and row: medians, and the ratio to the method as it stands."""
    runs = Completions(experiment)
    lines = [_line(runs, name, row) for name in runs.families for row in runs.rows_of(name)]
    columns = [
        *(text("family", "Family"), text("row", "Method")),
        *(Column(points, heading(points)) for points in runs.points),
        *(text("ratio", "Ratio to the default"), text("failed", "Failed")),
    ]
    return Result(
        experiment,
        "Methods as they stand, tuned, and at their papers' settings.",
        "Median error of shapes over the number of given depth points.",
        interval="95 % bootstrap intervals of the ratios over {shapes and seeds}",
        estimates=[found for line in lines if (found := line["ratio_of"]) is not None],
        remarks=(ERROR, shapes_per_cell(runs), *NOTES),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, lines),
        figure=draw(experiment, runs),
    )


def _line(runs: Completions, name: str, row: Row) -> dict[str, Any]:
    medians = {points: runs.median(name, row, points) for points in runs.points}
    failed = "{} of {}".format(*runs.failures(name, row))
    ratio, words = _ratio(runs, name, row)
    return {"family": name, "row": row.name, "ratio": words, "ratio_of": ratio, "failed": failed, **medians}


def _ratio(runs: Completions, name: str, row: Row) -> tuple[statistics.Interval | None, str]:
    """The row's errors over those of its method as it stands, and on how many shapes it is better; empty for itself."""
    default = next((other for other in runs.rows if other.preset == default_of(row.preset)), row)
    mine, other = runs.pair(name, row, default)
    if default == row or not mine:
        return None, ""
    better = sum((a < b) + 0.5 * (a == b) for a, b in zip(*map(shape_medians, (mine, other)), strict=True))
    ratio = statistics.paired_bootstrap(mine, other, geometric_mean, seed=SEED)
    return ratio, f"{ratio}; {better:g} of {len(mine)}"


@style.styled
def draw(experiment: Experiment, runs: Completions) -> Figure:
    """Draws each row's error over all families and its cost, with an arrow from a method to its tuned row."""
    figure, axes = chart.sheet(3.4, width=5.0)
    axis, places = axes[0, 0], {}
    for row, records in experiment.rows().items():
        errors = [e for name in runs.families for e in runs.over_points(name, row).values()]
        cost = median_of_known(map(value_evaluations, records))
        place = style.finite([cost, geometric_mean(np.array(errors)) if errors else None])
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
