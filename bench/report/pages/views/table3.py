"""Table 3 of DIST: shape from many views, from random initial codes, measured and published."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import (
    ONE_WAY,
    SCALE,
    Record,
    by_shape,
    error,
    grouped,
    loop_seconds,
    median_of_known,
    row_of,
    run_key,
    solid,
    value_evaluations,
)
from bench.report.data.statistics import Interval, bootstrap, interquartile_mean, median, share
from bench.report.oracle import LABEL, NOTE, oracles
from bench.report.write import chart
from bench.report.write.answer import Answer, ranked
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, counted, metrics, text, to_data, to_table

PLACE = 40
READS = (Selection("table3", ("multiview",), ("dataset", "task", "view")),)
# DIST (Liu et al. 2020), Table 3: mean Chamfer from truth to prediction x 1000, 50 shapes of PMO's test set.
PUBLISHED = {
    "car": {"PMO": 0.661, "PMO, random start": 1.187, "DIST, random start": 0.919},
    "plane": {"PMO": 1.129, "PMO, random start": 6.124, "DIST, random start": 1.595},
}
NOTES = (
    "Error: mean squared distance from points of the true surface to the nearest of the found one, in that direction "
    "only, in squared scene units, times 1000. A run that did not end ok counts as infinite (a cross at the edge); "
    "times and evaluations are over the other runs.",
    "All runs start from random codes, one per shape, the same for each method. “End / start” is the median of the "
    "shapes' ratios, “End / oracle” the ratio of the medians. Failed: did not end ok, however far it ended.",
    NOTE + " Dotted: three times its error.",
    "“Published” is DIST, Table 3: 50 shapes of PMO's renderings of ShapeNet, with another prior and metric scale, so "
    "it cannot be compared directly with the measured rows.",
)
MESH = "multiview_mesh"  # the preset that PMO's rows are to be read beside
ON_MESH = (
    "“{row}” moves the vertices of the prior's mesh by the photometric error, as PMO (Lin et al. 2019) does, from the "
    "same random codes as the other rows: read it beside “published: PMO, random start”. “Published: PMO” starts from "
    "the code of an encoder, which PMO trained on shapes of the same kind as its test."
)
RUNS = (
    *(FAMILY, *IDENTITY),
    *metrics(ONE_WAY, "chamfer_l2", "accuracy", "completeness", "mask_iou"),
    Column(f"{ONE_WAY}_start", value=lambda record: record["metrics_start"].get(ONE_WAY)),
    *LOOP,
)


def _words(key: str, heading: str) -> Column:
    """A column that is empty in the lines of the oracle and of published numbers."""
    return Column(key, heading, show=lambda words: words or "")


COLUMNS = (
    *(text("family", "Family"), text("method", "Method"), _words("start", "Start")),
    Column("end", "End", show=lambda end: end if isinstance(end, str) else format.number(end)),
    *(_words("middle", "Interquartile mean"), _words("of_start", "End / start"), _words("of_oracle", "End / oracle")),
    *(_words("failed", "Failed"), _words("seconds", "Loop"), _words("evaluations", "Evaluations")),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family and method."""
    oracle = oracles(experiment, ONE_WAY)
    families = experiment.families().items()
    lines = [line for name, records in families for line in _lines(name, records, oracle.get(name))]
    return Result(
        experiment,
        "Shape from many views, without a mask.",
        "Median initial and final error over {shapes and seeds}, and its cost.",
        interval="95 % bootstrap intervals of interquartile means over {shapes and seeds}, Clopper and Pearson's of "
        "failures over shapes",
        estimates=[_middle(of) for all in experiment.families().values() for of in grouped(all, row_of).values()],
        remarks=(*NOTES, *(ON_MESH.format(row=row.name) for row in experiment.rows() if row.preset == MESH)),
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines),
        figure=draw(experiment, oracle),
    )


def _lines(name: str, records: list[Record], oracle: float | None) -> list[dict[str, Any]]:
    """The lines of a family: the rows, the oracle, and the published ones."""
    rows = grouped(records, row_of)
    lines = [{"method": row.name, **_line(of_row, oracle)} for row, of_row in rows.items()]
    lines += [] if oracle is None else [{"method": LABEL, "end": oracle}]
    lines += [{"method": f"published: {row}", "end": str(number)} for row, number in PUBLISHED.get(name, {}).items()]
    return [{"family": name, **line} for line in lines]


def _line(records: list[Record], oracle: float | None) -> dict[str, Any]:
    starts, ends = [_start(record) for record in records], [_end(record) for record in records]
    finished = [record for record in records if record["status"] == "ok"]
    failed = len(records) - len(finished)
    last = float(median(ends))
    left = float(median([_share(end, start) for end, start in zip(ends, starts, strict=True)]))
    return {
        "start": format.number(float(median(starts))),
        "end": last,
        "middle": str(_middle(records)),
        "of_start": format.number(left),
        "of_oracle": format.number(last / oracle if oracle else None),
        "failed": counted(failed, len(records), _rate(records)),
        "seconds": format.seconds(median_of_known(map(loop_seconds, finished))),
        "evaluations": format.count(median_of_known(map(value_evaluations, finished))),
    }


def _middle(records: list[Record]) -> Interval:
    """The interquartile mean of the final errors."""
    return bootstrap(by_shape({run_key(record): _end(record) for record in records}), interquartile_mean, seed=0)


def _rate(records: list[Record]) -> Interval:
    """The share of runs that failed."""
    of_shape = grouped(records, solid).values()
    return share([sum(run["status"] != "ok" for run in runs) for runs in of_shape], [len(runs) for runs in of_shape])


def _start(record: Record) -> float:
    return SCALE * record["metrics_start"].get(ONE_WAY, np.inf)


def _end(record: Record) -> float:
    return SCALE * error(record, ONE_WAY)


def _share(end: float, start: float) -> float:
    """The final error over the initial one; infinite for a run that failed, or has no initial error."""
    return end / start if np.isfinite(end) and np.isfinite(start) else np.inf


@style.styled
def draw(experiment: Experiment, oracle: dict[str, float]) -> Figure:
    """Draws a panel per family with a line per method: each run's initial (grey) and final error."""
    families, rows = experiment.families(), list(experiment.rows())
    figure, (axes,) = chart.sheet(0.28 * len(rows) + 1.1, 1, len(families), sharey=True)
    for axis, (name, records) in zip(axes, families.items(), strict=True):
        of_row = grouped(records, row_of)
        for place, row in enumerate(rows):
            _row(axis, place, row.preset, of_row.get(row, []))
        axis.plot([], [], "D", color="#444444", ms=3.5, label="end")
        if name in oracle:
            chart.reference(axis.axvline, oracle[name], 3, "oracle")
        style.log_axis(axis, "x", [value for record in records for value in (_start(record), _end(record))])
        axis.set(title=name, xlabel="Chamfer, truth to prediction\n× 1000 (scene units²)")
    axes[0].set_yticks(range(len(rows)), [row.name for row in rows])
    axes[0].invert_yaxis()
    style.legend_below(figure, *axes)
    return figure


def _row(axis: Axes, place: int, preset: str, records: list[Record]) -> None:
    """Draws the runs of a row, one above the other."""
    starts, ends = (style.finite(map(value, records)) for value in (_start, _end))
    spread = place + np.linspace(-0.25, 0.25, len(records)) if len(records) > 1 else np.full(len(records), place)
    axis.plot(starts, spread, ".", color="#b0b0b0", ms=3, label="start" if place == 0 else None)
    chart.points(axis, preset, ends, spread, ms=3.5)
    lost = [where for where, end in zip(spread, ends, strict=True) if np.isnan(end)]
    chart.points(axis, preset, [0.99] * len(lost), lost, marker="x", transform=axis.get_yaxis_transform())


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row with the lowest error from truth to prediction."""
    verdict = ranked(data, ONE_WAY).said("error, from truth to prediction × 1000", scale=SCALE)
    return Answer("Which method finds a shape by photographs from many views, without a mask?", verdict)
