"""Pieces that the pages on shapes from photographs share: lines of the table, and curves."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format, metrics
from bench.report.data import curves
from bench.report.data.experiments import Experiment
from bench.report.data.records import (
    Record,
    error,
    family,
    grouped,
    index,
    loop_seconds,
    measured,
    median_of_known,
    row_of,
    value_evaluations,
)
from bench.report.data.statistics import median
from bench.report.write import chart
from bench.report.write.table import Column, text


def _values(value: float | None) -> str:
    """A number of field values; a method without a field needs none."""
    return "none" if value == 0 else format.count(value)


COST = (
    text("failed", "Failed"),
    Column("seconds", "Loop", show=format.seconds),
    Column("evaluations", "Evaluations", show=_values),
)


def lines_of(experiment: Experiment, names: Sequence[str]) -> list[dict[str, Any]]:
    """A line per row with the medians of metrics over scenes, what failed and what it cost; failed runs are worst."""
    return [{"method": row.name, **_line(records, names)} for row, records in experiment.rows().items()]


def _line(records: list[Record], names: Sequence[str]) -> dict[str, Any]:
    finished = [record for record in records if record["status"] == "ok"]
    return {
        **{name: middle(records, name) for name in names},
        "failed": f"{len(records) - len(finished)} of {len(records)}",
        "seconds": median_of_known(map(loop_seconds, finished)),
        "evaluations": median_of_known(map(value_evaluations, finished)),
    }


def middle(records: list[Record], name: str) -> float | None:
    """The median of a metric, with failed runs worst; None where runs that ended ok do not have it."""
    if any(measured(record, name) is None for record in records if record["status"] == "ok"):
        return None
    if metrics.better(name) == "higher":
        found = [measured(record, name) if record["status"] == "ok" else 0.0 for record in records]
        return float(median([value or 0.0 for value in found]))
    return float(median([error(record, name) for record in records]))


def history(experiment: Experiment, record: Record, name: str) -> list[tuple[float, float, float]]:
    """Seconds, field values and a metric, at the checkpoints of a run and at its end.

    A line of a curve has the metric before its step, but the costs after it, so a checkpoint gets the costs of the line
    before it.
    """
    found, spent = [], (0.0, 0.0)
    for line in curves.lines(experiment.folder(record)) or []:
        if isinstance(line.get(name), int | float):
            found.append((*spent, float(line[name])))
        spent = float(line.get("seconds", spent[0])), float(line.get("value_evaluations", spent[1]))
    last = measured(record, name) if record["status"] == "ok" else None
    return found if last is None else [*found, (*spent, float(last))]


@style.styled
def draw_curves(experiment: Experiment, name: str, label: str, scale: float) -> Figure:
    """A column per scene: the metric over seconds above, over field values below; rows without a loop as levels."""
    scenes = grouped(experiment.records, scene_of)
    figure, axes = chart.sheet(3.4 + 0.11 * len(experiment.rows()), 2, len(scenes), sharey="col")  # legend below
    for column, (scene, records) in zip(axes.T, scenes.items(), strict=True):
        column[0].set_title(scene)
        for record in records:
            _draw_run(experiment, record, column, name, scale)
        for axis, unit in zip(column, ("seconds in the loop", "field values"), strict=True):
            axis.set(xscale="log", xlabel=unit)
            if scale != 1:
                axis.set_yscale("log")
    for axis in axes[:, 0]:
        axis.set_ylabel(label)
    style.legend_below(figure, *axes.flat)
    return figure


def _draw_run(experiment: Experiment, record: Record, column: Any, name: str, scale: float) -> None:
    row, points = row_of(record), history(experiment, record, name)
    last = measured(record, name)
    if record["evaluations"].get("value"):
        for axis, part in zip(column, (0, 1), strict=True):
            shown = [(point[part], scale * point[2]) for point in points if point[part] > 0]
            if shown:
                chart.line(axis, row.preset, *zip(*shown, strict=True), ms=3, label=row.name)
    elif last is not None and record["status"] == "ok":
        look = style.look(row.preset)
        for axis in column:
            axis.axhline(scale * last, color=look.colour, ls=look.line, lw=0.9, label=row.name)
        if spent := loop_seconds(record):
            chart.points(column[0], row.preset, [spent], [scale * last])


def scene_of(record: Record) -> str:
    """The name of a run's scene, for titles: with its number, unless it is a file's or a folder's own object."""
    dataset = record["config"].get("dataset", {})
    own = dataset.get("path") and not dataset.get("strength") and not index(record)
    return family(record) if own else f"{family(record)} {index(record)}"
