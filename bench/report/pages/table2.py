"""Table 2 of DIST: shape completion over the sparsity of the depth image, measured and published."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.completions import ERROR, POINTS, TABLE2, Completions, heading, shapes_per_cell
from bench.report.data.experiments import Experiment
from bench.report.data.oracle import LABEL, NOTE, oracles
from bench.report.data.records import iterations_of, row_of
from bench.report.write.caption import captioned
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, configured, metrics, text, to_data, to_table

PLACE = 20
READS = (TABLE2,)
# DIST (Liu et al. 2020), Table 2: median Chamfer x 1000 over 200 shapes of ShapeNet, in the order of POINTS.
PUBLISHED = {
    "sofa": {
        "DeepSDF": (5.37, 5.56, 5.50, 5.93, 6.03, 7.63),
        "DIST": (4.12, 5.75, 5.49, 5.72, 5.57, 6.95),
        "DIST with mask": (4.12, 3.98, 4.31, 3.98, 4.30, 4.94),
    },
    "plane": {
        "DeepSDF": (3.71, 3.73, 4.29, 4.44, 4.40, 5.39),
        "DIST": (2.18, 4.08, 4.81, 4.44, 4.51, 5.30),
        "DIST with mask": (2.18, 2.08, 2.62, 2.26, 2.55, 3.60),
    },
    "table": {
        "DeepSDF": (12.93, 12.78, 11.67, 12.87, 13.76, 15.77),
        "DIST": (5.37, 12.05, 11.42, 11.70, 13.76, 15.83),
        "DIST with mask": (5.37, 5.15, 5.16, 5.26, 6.33, 7.62),
    },
}
NOTES = (
    "Dense depth implies the mask. “Paper's” is the setting of DIST, B.4 (the mean of the squared code from the "
    "official code); README, “Paper-literal”, says what the other rows are.",
    NOTE,
    "“Published” is DIST, Table 2: 200 shapes of ShapeNet, with another prior and camera, and another number of points "
    "per share, so it cannot be compared directly with the measured rows.",
)
RUNS = (
    FAMILY,
    configured("points", "task", "points"),
    *IDENTITY,
    *metrics("chamfer_l2", "chamfer_l1", "normal_consistency", "mask_iou"),
    Column("chamfer_l2_start", value=lambda record: record["metrics_start"].get("chamfer_l2")),
    *LOOP,
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and method: the median at each number of points."""
    runs = Completions(experiment)
    oracle = oracles(experiment, "chamfer_l2")
    columns = [
        *(text("family", "Family"), text("method", "Method")),
        *(Column(points, heading(points)) for points in runs.points),
        text("failed", "Failed"),
    ]
    return Result(
        title="Shape completion from one depth image, over its sparsity.",
        **captioned(
            experiment,
            "Median error of shapes and seeds over the number of given depth points.",
            notes=(ERROR, shapes_per_cell(runs), _given(runs), _iterations(experiment), *NOTES),
        ),
        data=to_data(RUNS, experiment.records),
        table=to_table(columns, [line for name in runs.families for line in _lines(runs, name, oracle.get(name))]),
        figure=draw(runs, oracle),
    )


def _lines(runs: Completions, name: str, oracle: float | None) -> list[dict[str, Any]]:
    """The lines of a family: the oracle, the rows, and the published ones."""
    lines = [] if oracle is None else [{"method": LABEL, "failed": "", **dict.fromkeys(runs.points, oracle)}]
    for row in runs.rows_of(name):
        medians = {points: runs.median(name, row, points) for points in runs.points}
        lines.append({"method": row.name, "failed": "{} of {}".format(*runs.failures(name, row)), **medians})
    for row, numbers in PUBLISHED.get(name, {}).items():
        lines.append({"method": f"published: {row}", "failed": "", **dict(zip(POINTS, numbers, strict=True))})
    return [{"family": name, **line} for line in lines]


@style.styled
def draw(runs: Completions, oracle: dict[str, float]) -> Figure:
    """Draws a panel per family: medians over the number of given points, and the oracle."""
    columns = min(len(runs.families), 4)
    lines = -(-len(runs.families) // columns)
    figure = Figure(figsize=(style.WIDTH, 2.4 * lines + 0.7), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
    everything = []
    for axis, name in zip(axes.flat, runs.families, strict=False):
        everything += _panel(axis, runs, name)
        if name in oracle:
            axis.axhline(oracle[name], color="#777777", lw=0.9, label=LABEL)
            axis.axhline(1.5 * oracle[name], color="#777777", lw=0.9, ls=":", label="1.5 times that")
    for axis in axes.flat[len(runs.families) :]:
        axis.axis("off")
    for axis in axes[:, 0]:
        axis.set_ylabel("Chamfer × 1000 (scene units²)")
    style.log_axis(axes[0, 0], "y", everything)
    style.legend_below(figure, *axes.flat)
    return figure


def _panel(axis: Axes, runs: Completions, name: str) -> list[float]:
    """Draws a line per row of a family, and gives the medians."""
    given = [runs.given(name, points) for points in runs.points]
    places = range(len(given)) if None in given else given
    order, everything = np.argsort(places), []
    for row in runs.rows_of(name):
        medians = style.finite(runs.median(name, row, points) for points in runs.points)
        everything += medians
        look = style.look(row.preset)
        how = {"linestyle": look.line, "color": look.colour, "marker": look.marker, "label": row.name}
        axis.plot([places[i] for i in order], [medians[i] for i in order], **how)
    axis.set(title=name, xlabel="depth points given")
    style.log_axis(axis, "x", [] if None in given else places)
    return everything


def _given(runs: Completions) -> str:
    """A note on the median numbers of points of the shares in each family."""
    families = []
    for name in runs.families:
        known = {p: runs.given(name, p) for p in runs.points if not p.isdigit()}
        if all(value is not None for value in known.values()) and known:
            families.append(f"{name} " + ", ".join(f"{p} {value:.0f}" for p, value in known.items()))
    return f"Points given, medians: {'; '.join(families)}." if families else ""


def _iterations(experiment: Experiment) -> str:
    """A note on the rows' iterations: the most frequent number, then the rows with another one."""
    found: dict[Any, list[str]] = {}
    for record in experiment.records:
        names = found.setdefault(iterations_of(record), [])
        if row_of(record).name not in names:
            names.append(row_of(record).name)
    known = {count: names for count, names in found.items() if count is not None}
    most = max(known, key=lambda count: len(known[count]), default=None)
    others = [f"{', '.join(names)} {count}" for count, names in known.items() if count != most]
    return f"Iterations: {most}{'; '.join(['', *others])}." if known else ""
