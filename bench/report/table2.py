"""Table 2 of DIST: shape completion over sparsity, with the published numbers beside ours."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import counted_outcome, joined, omitted, setup
from bench.report.experiments import (
    Experiment,
    family,
    identity,
    loop_seconds,
    measured,
    row_name,
    setting,
    value_evaluations,
)
from bench.report.oracle import LABEL, oracles
from bench.report.table2_runs import ERROR, POINTS, Runs, heading, shapes_told
from bench.report.tables import Result

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
TITLE = "Shape completion from one depth image, over its sparsity."
CAPTION = (
    "Medians over shapes. Dense depth implies the mask. “Paper's” is the setting of DIST, B.4 (the mean of the squared "
    "code from the official code); the other rows are as README, “Paper-literal”, says. The oracle is a code fitted to "
    "the distances of the true mesh (+experiment=priors), where that was run on all of these shapes. “Published” is "
    "DIST, Table 2: 200 shapes of ShapeNet, another prior and camera, another number of points in a share, not to be "
    "ranked with ours."
)


def make(experiment: Experiment) -> Result:
    """A row a family and method: the median at each number of points."""
    runs = Runs(experiment)
    oracle = oracles(experiment, "chamfer_l2")
    rows = []
    for name in runs.families:
        if name in oracle:
            rows.append([name, LABEL, *[format.number(oracle[name])] * len(runs.points), ""])
        for row in runs.rows_of(name):
            failed, total = runs.failures(name, row)
            medians = [runs.median(name, row, points) for points in runs.points]
            rows.append([name, row, *map(format.number, medians), f"{failed} of {total}"])
        for row, numbers in PUBLISHED.get(name, {}).items():
            known = dict(zip(POINTS, numbers, strict=True))
            rows.append([name, f"published: {row}", *[format.number(known.get(p)) for p in runs.points], ""])
    return Result(
        name="table2",
        title=TITLE,
        caption=joined(
            setup(experiment),
            _iterations(experiment),
            ERROR,
            CAPTION,
            _given(runs),
            shapes_told(runs),
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([_raw(record) for record in experiment.records], dtype=object),
        table=pd.DataFrame(rows, columns=["Family", "Method", *map(heading, runs.points), "Failed"]),
        figure=draw(runs, oracle),
    )


@style.styled
def draw(runs: Runs, oracle: dict[str, float]) -> Figure:
    """A panel a family: medians over the number of points given, and the prior's fit."""
    columns = min(len(runs.families), 4)
    lines = -(-len(runs.families) // columns)
    figure = Figure(figsize=(style.WIDTH, 2.4 * lines + 0.7), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, sharey=True)
    everything = []
    for axis, name in zip(axes.flat, runs.families, strict=False):
        given = [runs.given(name, points) for points in runs.points]
        places = range(len(given)) if None in given else given
        order = np.argsort(places)
        for row in runs.rows_of(name):
            medians = style.finite(runs.median(name, row, points) for points in runs.points)
            everything += medians
            look = style.look(row)
            how = {"linestyle": look.line, "color": look.colour, "marker": look.marker, "label": row}
            axis.plot([places[i] for i in order], [medians[i] for i in order], **how)
        if name in oracle:
            axis.axhline(oracle[name], color="#777777", lw=0.9, label=LABEL)
            axis.axhline(1.5 * oracle[name], color="#777777", lw=0.9, ls=":", label="1.5 times that")
        axis.set(title=name, xlabel="depth points given")
        style.log_axis(axis, "x", [] if None in given else places)
    for axis in axes.flat[len(runs.families) :]:
        axis.axis("off")
    for axis in axes[:, 0]:
        axis.set_ylabel("Chamfer × 1000 (scene units²)")
    style.log_axis(axes[0, 0], "y", everything)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _given(runs: Runs) -> str:
    """How many points the shares are in each family."""
    told = []
    for name in runs.families:
        known = {p: runs.given(name, p) for p in runs.points if not p.isdigit()}
        if all(value is not None for value in known.values()) and known:
            told.append(f"{name} " + ", ".join(f"{p} {value:.0f}" for p, value in known.items()))
    return f"Points given, medians: {'; '.join(told)}." if told else ""


def _iterations(experiment: Experiment) -> str:
    found: dict[Any, list[str]] = {}
    for record in experiment.records:
        names = found.setdefault(setting(record["config"], "task", "iterations"), [])
        if row_name(record) not in names:
            names.append(row_name(record))
    known = {count: names for count, names in found.items() if count is not None}
    most = max(known, key=lambda count: len(known[count]), default=None)
    others = [f"{', '.join(names)} {count}" for count, names in known.items() if count != most]
    return f"Iterations: {most}{'; '.join(['', *others])}." if known else ""


def _raw(record: dict[str, Any]) -> dict[str, Any]:
    return {
        "family": family(record),
        "points": setting(record["config"], "task", "points"),
        **identity(record),
        **{name: measured(record, name) for name in ("chamfer_l2", "chamfer_l1", "normal_consistency", "mask_iou")},
        "chamfer_l2_start": record["metrics_start"].get("chamfer_l2"),
        "loop_seconds": loop_seconds(record),
        "value_evaluations": value_evaluations(record),
    }
