"""Fig. 10 of DIST: shape from many views under other focal lengths and other noise in the initial code."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import (
    ONE_WAY,
    SCALE,
    Record,
    Row,
    by_shape,
    error,
    family,
    grouped,
    row_of,
    run_key,
    setting,
)
from bench.report.data.statistics import Interval, bootstrap, median
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, Column, configured, metrics, shown, text, to_data, to_table

PLACE = 50
READS = (Selection("fig10", ("multiview",), ("dataset", "task"), ("focal", "start_scale")),)
PANELS = {"focal": "focal length / the scene's", "start_scale": "noise in the initial code (prior's σ)"}
NEUTRAL = 1.0  # default value of both conditions
NOTES = (
    "One condition varies, the other is at 1. The noise is that of a random code, in standard deviations of the "
    "prior's training codes: 0 is the mean shape.",
    "A run that did not end ok counts as infinite, drawn at the upper edge. The paper (Fig. 10, a chart without "
    "numbers) finds its method robust to both.",
)
Cell = tuple[str, Row, str, float]  # family, row, condition, value of the condition
RUNS = (
    *(FAMILY, *(configured(key, "task", key) for key in PANELS), *IDENTITY),
    *metrics(ONE_WAY, "chamfer_l2"),
)
COLUMNS = (
    *(text("family", "Family"), text("method", "Method"), text("condition", "Condition"), Column("median", "Median")),
    shown("95 % interval", lambda line: line["cell"].ends()),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family, method and value of a condition."""
    cells = _cells(experiment)
    lines = [
        {"family": name, "method": row.name, "condition": f"{PANELS[key]}: {value:g}"}
        | {"median": cell.value, "cell": cell}
        for (name, row, key, value), cell in cells.items()
    ]
    return Result(
        experiment,
        "Shape from many views under other focal lengths and starts.",
        "Median Chamfer distance from truth to prediction (squared scene units, times 1000).",
        interval="95 % bootstrap intervals over {shapes and seeds}",
        estimates=cells.values(),
        remarks=NOTES,
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw(cells),
    )


def _cells(experiment: Experiment) -> dict[Cell, Interval]:
    """The median for each family, method and value of a condition, with the other condition at its default."""
    cells: dict[Cell, Interval] = {}
    for key in PANELS:
        others = [other for other in PANELS if other != key]
        alone = [r for r in experiment.records if all(_condition(r, other) == NEUTRAL for other in others)]
        at = grouped(alone, lambda record, key=key: (family(record), row_of(record), key, _condition(record, key)))
        for cell, records in at.items():
            errors = {run_key(record): SCALE * error(record, ONE_WAY) for record in records}
            cells[cell] = bootstrap(by_shape(errors), median, seed=0)
    return dict(sorted(cells.items(), key=lambda item: (item[0][0], item[0][1].name, *item[0][2:])))


def _condition(record: Record, key: str) -> float:
    return float(setting(record["config"], "task", key))


@style.styled
def draw(cells: dict[Cell, Interval]) -> Figure:
    """Draws a row of panels per family, with a panel per condition and a line per method."""
    families = list(dict.fromkeys(name for name, *_ in cells))
    figure, axes = chart.sheet(2.1 * len(families) + 0.5, len(families), len(PANELS), sharey="row")
    for line, name in zip(axes, families, strict=True):
        for axis, key in zip(line, PANELS, strict=True):
            selected = {(row, x): cell for (n, row, k, x), cell in cells.items() if (n, k) == (name, key)}
            found = [cell for (n, *_), cell in cells.items() if n == name]
            known = style.finite(end for cell in found for end in (cell.value, cell.high, *cell.points))
            _panel(axis, selected, 2 * np.nanmax([*known, 0.5]) if np.isfinite(known).any() else 2.0)
            axis.set(xlabel=PANELS[key], title=name)
        style.log_axis(line[0], "y", known)
        line[0].set_ylabel("truth to prediction × 1000\n(scene units²)")
    style.legend_below(figure, *axes.flat, columns=3)
    return figure


def _panel(axis: Axes, cells: dict[tuple[Row, float], Interval], edge: float) -> None:
    """Draws the medians of each row with their intervals or points; values beyond the edge are drawn at it."""
    for row, keys in grouped(cells, lambda key: key[0]).items():
        found = [cells[key].below(edge) for key in keys]
        chart.estimates(axis, row.preset, [x for _, x in keys], found, label=row.name)
