"""Fig. 10 of DIST: what another focal length, and noise in the code at the start, do to shape from many views."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report import format, style
from bench.report.caption import counted_outcome, joined, omitted, setup
from bench.report.experiments import Experiment, error, family, identity, measured, row_name, setting
from bench.report.oracle import SCALE
from bench.report.statistics import Interval, bootstrap, median
from bench.report.table2_runs import by_shape
from bench.report.table3 import METRIC
from bench.report.tables import Result

PANELS = {"focal": "focal length / the scene's", "start_scale": "noise in the code at the start (prior's σ)"}
NEUTRAL = {"focal": 1.0, "start_scale": 1.0}
CAPTION = (
    "Median Chamfer distance from truth to prediction (squared scene units, times 1000) with its bootstrap interval "
    "over shapes. One condition varies, the other is at 1. The noise is that of a random code, in standard deviations "
    "of the prior's training codes: 0 is the mean shape. A run that did not end ok counts as infinite, drawn at the "
    "upper edge. The paper (Fig. 10, a chart without numbers) finds its method robust to both."
)


def make(experiment: Experiment) -> Result:
    """A row a family, method and condition."""
    cells = _cells(experiment)
    rows = [
        [name, row, f"{PANELS[key]}: {value:g}", format.number(cell.value), format.interval(cell.low, cell.high)]
        for (name, row, key, value), cell in cells.items()
    ]
    return Result(
        name="fig10",
        title="Shape from many views under other focal lengths and starts.",
        caption=joined(setup(experiment), CAPTION, counted_outcome(experiment), omitted(experiment)),
        data=pd.DataFrame([_raw(record) for record in experiment.records], dtype=object),
        table=pd.DataFrame(rows, columns=["Family", "Method", "Condition", "Median", "95 % interval"]),
        figure=draw(cells),
    )


def _cells(experiment: Experiment) -> dict[tuple[str, str, str, float], Interval]:
    """The median of each family, method and value of a condition, with the other condition as it is by default."""
    found: dict[tuple[str, str, str, float], dict[Any, float]] = {}
    for record in experiment.records:
        values = {key: float(setting(record["config"], "task", key)) for key in PANELS}
        for key, value in values.items():
            if all(values[other] == NEUTRAL[other] for other in PANELS if other != key):
                cell = found.setdefault((family(record), row_name(record), key, value), {})
                cell[record["config"].get("index"), record["seed"]] = SCALE * error(record, METRIC)
    return {cell: bootstrap(by_shape(errors), median, seed=0) for cell, errors in sorted(found.items())}


@style.styled
def draw(cells: dict[tuple[str, str, str, float], Interval]) -> Figure:
    """A row of panels a family, one a condition, a line a method."""
    families = list(dict.fromkeys(name for name, *_ in cells))
    figure = Figure(figsize=(style.WIDTH, 2.1 * len(families) + 0.5), layout="constrained")
    axes = figure.subplots(len(families), len(PANELS), squeeze=False, sharey="row")
    for line, name in zip(axes, families, strict=True):
        for axis, (key, label) in zip(line, PANELS.items(), strict=True):
            known = [end for (n, *_), c in cells.items() if n == name for end in (c.value, c.high) if np.isfinite(end)]
            edge = 2 * max(known, default=1.0)
            for row in dict.fromkeys(row for own, row, *_ in cells if own == name):
                points = [(x, cell) for (n, r, k, x), cell in cells.items() if (n, r, k) == (name, row, key)]
                look = style.look(row)
                places, middles = [x for x, _ in points], [min(cell.value, edge) for _, cell in points]
                axis.plot(places, middles, ls=look.line, color=look.colour, marker=look.marker, label=row)
                ends = [min(c.low, edge) for _, c in points], [min(c.high, edge) for _, c in points]
                axis.fill_between(places, *ends, color=look.colour, alpha=0.15, lw=0)
            axis.set(xlabel=label, title=name)
        style.log_axis(line[0], "y", known)
        line[0].set_ylabel("truth to prediction × 1000\n(scene units²)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def _raw(record: dict[str, Any]) -> dict[str, Any]:
    conditions = {key: setting(record["config"], "task", key) for key in PANELS}
    names = (METRIC, "chamfer_l2")
    return {"family": family(record), **conditions, **identity(record), **{n: measured(record, n) for n in names}}
