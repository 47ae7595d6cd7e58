"""Table 3 of DIST: shape from many views, from random codes, with the published numbers beside ours."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import counted_outcome, joined, omitted, setup
from bench.report.experiments import (
    Experiment,
    error,
    family,
    identity,
    loop_seconds,
    measured,
    median_of_known,
    row_name,
    value_evaluations,
)
from bench.report.oracle import LABEL, SCALE, oracles
from bench.report.statistics import bootstrap, interquartile_mean, median, wilson
from bench.report.table2_runs import by_shape
from bench.report.tables import Result

# DIST (Liu et al. 2020), Table 3: mean Chamfer from truth to prediction x 1000, 50 shapes of PMO's test set.
PUBLISHED = {
    "car": {"PMO": 0.661, "PMO, random start": 1.187, "DIST, random start": 0.919},
    "plane": {"PMO": 1.129, "PMO, random start": 6.124, "DIST, random start": 1.595},
}
METRIC = "chamfer_gt_to_pred"
CAPTION = (
    "Mean squared distance from points of the true surface to the nearest of the found one, that direction only, in "
    "squared scene units, times 1000. All start from random codes, one a shape, the same for each method. A run that "
    "did not end ok counts as infinite (a cross at the edge); times and evaluations are of the others. The oracle is a "
    "code fitted to the distances of the true mesh (+experiment=priors), where that was run on all of these shapes; "
    "dotted is three times its distance. “Published” is DIST, Table 3: 50 shapes of PMO's renderings of ShapeNet, "
    "another prior and metric scale, not to be ranked with ours."
)


def make(experiment: Experiment) -> Result:
    """A row a family and method."""
    oracle = oracles(experiment, METRIC)
    rows: list[list[str]] = []
    for name in dict.fromkeys(family(record) for record in experiment.records):
        own = [record for record in experiment.records if family(record) == name]
        for row in dict.fromkeys(row_name(record) for record in own):
            rows.append([name, row, *_row([r for r in own if row_name(r) == row], oracle.get(name))])
        if name in oracle:
            rows.append([name, LABEL, "", format.number(oracle[name]), *[""] * 6])
        for row, number in PUBLISHED.get(name, {}).items():
            rows.append([name, f"published: {row}", "", format.number(number), *[""] * 6])
    columns = [
        "Family",
        "Method",
        "Start",
        "End",
        "Interquartile mean",
        "End / start",
        "End / oracle",
        "Failed",
        "Loop",
    ]
    return Result(
        name="table3",
        title="Shape from many views, without a mask.",
        caption=joined(
            setup(experiment),
            "Medians over shapes and seeds.",
            CAPTION,
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([_raw(record) for record in experiment.records], dtype=object),
        table=pd.DataFrame(rows, columns=[*columns, "Evaluations"]),
        figure=draw(experiment, oracle),
    )


def _row(records: list[dict[str, Any]], oracle: float | None) -> list[str]:
    starts = [SCALE * record["metrics_start"].get(METRIC, np.inf) for record in records]
    ends = [SCALE * error(record, METRIC) for record in records]
    keyed = {(r["config"].get("index"), r["seed"]): end for r, end in zip(records, ends, strict=True)}
    middle = bootstrap(by_shape(keyed), interquartile_mean, seed=0)
    finished = [record for record in records if record["status"] == "ok"]
    failed = len(records) - len(finished)
    rate = wilson(failed, len(records))
    last = float(median(ends))
    return [
        format.number(float(median(starts))),
        format.number(last),
        f"{format.number(middle.value)} {format.interval(middle.low, middle.high)}",
        format.number(float(median([_share(end, start) for end, start in zip(ends, starts, strict=True)]))),
        format.number(last / oracle if oracle else None),
        f"{failed} of {len(records)} {format.interval(100 * rate.low, 100 * rate.high)} %",
        format.seconds(median_of_known(map(loop_seconds, finished))),
        format.count(median_of_known(map(value_evaluations, finished))),
    ]


def _share(end: float, start: float) -> float:
    """What is left of the error; infinite for a run that failed, and for one that has no start."""
    return end / start if np.isfinite(end) and np.isfinite(start) else np.inf


@style.styled
def draw(experiment: Experiment, oracle: dict[str, float]) -> Figure:
    """A panel a family: each run from its start (grey) to its end, a line a method."""
    families = list(dict.fromkeys(family(record) for record in experiment.records))
    rows = list(dict.fromkeys(row_name(record) for record in experiment.records))
    figure = Figure(figsize=(style.WIDTH, 0.28 * len(rows) + 1.1), layout="constrained")
    axes = figure.subplots(1, len(families), squeeze=False, sharey=True)[0]
    for axis, name in zip(axes, families, strict=True):
        everything = []
        for place, row in enumerate(rows):
            own = [r for r in experiment.records if family(r) == name and row_name(r) == row]
            starts = style.finite(SCALE * r["metrics_start"].get(METRIC, np.inf) for r in own)
            ends = style.finite(SCALE * error(r, METRIC) for r in own)
            spread = place + np.linspace(-0.25, 0.25, len(own)) if len(own) > 1 else [place]
            look = style.look(row)
            axis.plot(starts, spread, ".", color="#b0b0b0", ms=3, label="start" if place == 0 else None)
            axis.plot(ends, spread, look.marker, color=look.colour, ms=3.5)
            lost = [where for where, end in zip(spread, ends, strict=True) if np.isnan(end)]
            axis.plot([0.99] * len(lost), lost, "x", color=look.colour, transform=axis.get_yaxis_transform())
            everything += [*starts, *ends]
        axis.plot([], [], "D", color="#444444", ms=3.5, label="end")
        if name in oracle:
            axis.axvline(oracle[name], color="#777777", lw=0.9, label="oracle")
            axis.axvline(3 * oracle[name], color="#777777", lw=0.9, ls=":", label="3 times that")
        style.log_axis(axis, "x", everything)
        axis.set(title=name, xlabel="Chamfer, truth to prediction × 1000 (scene units²)")
    axes[0].set_yticks(range(len(rows)), rows)
    axes[0].invert_yaxis()
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _raw(record: dict[str, Any]) -> dict[str, Any]:
    return {
        "family": family(record),
        **identity(record),
        **{name: measured(record, name) for name in (METRIC, "chamfer_l2", "accuracy", "completeness", "mask_iou")},
        f"{METRIC}_start": record["metrics_start"].get(METRIC),
        "loop_seconds": loop_seconds(record),
        "value_evaluations": value_evaluations(record),
    }
