"""The oracle of each prior: its best fit to unseen shapes, with pictures and the length of its gradient."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report import gallery
from bench.report.data import statistics
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, definitions, measured
from bench.report.gallery import REFERENCE, Block, Scene
from bench.report.oracle import PRIORS
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, Column, metrics, text, thousandfold, to_data, to_table

PLACE = 70
READS = (PRIORS,)
SHOWN = 3  # shapes per family in the figure
DEFINED = {
    "chamfer_l2": "Fit",
    "floor_chamfer_l2": "Floor",
    "distance_error": "Error of the distance",
    "slope_median": "|gradient|",
    "slope_p99": "|gradient|, 99 %",
}
NOTES = (
    "A code of each prior is fitted to the signed distances of an unseen shape (DeepSDF, Eq. 10). The floor is the "
    "Chamfer distance between two samplings of the true surface. A run that did not end ok counts as infinite.",
    "Pictures: normals of the true shape and of the fit, in pairs. Histograms: length of the field's gradient within "
    "0.02 of the true surface, over all shapes of a family; 1 for a distance.",
)


def _ratio(record: Record) -> float | None:
    fit, floor = measured(record, "chamfer_l2"), measured(record, "floor_chamfer_l2")
    return None if fit is None or not floor else fit / floor


def _values(line: tuple[str, list[Record]], value: Callable[[Record], float | None]) -> list[float]:
    """A number of each run of a family; infinite where a run did not end ok, or has none."""
    found = [value(record) if record["status"] == "ok" else None for record in line[1]]
    return [np.inf if x is None else x for x in found]


def _median(name: str, show: Callable[[float], str] = format.number) -> Column:
    """A column with the median of a metric over a family's shapes."""
    value = partial(measured, name=name)
    return Column("", DEFINED[name], lambda line: float(statistics.median(_values(line, value))), show)


RUNS = (FAMILY, *IDENTITY, *metrics(*DEFINED), Column("ratio", value=_ratio))
COLUMNS = (  # of a family and its records
    text("", "Family", lambda line: line[0]),
    text("", "Shapes", lambda line: len(line[1])),
    *(_median("chamfer_l2", thousandfold), _median("floor_chamfer_l2", thousandfold)),
    Column("", "Fit / floor", lambda line: float(statistics.median(_values(line, _ratio)))),
    Column("", "largest", lambda line: max(_values(line, _ratio))),
    *(_median("distance_error"), _median("slope_median"), _median("slope_p99")),
)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per family: the fit of its shapes, and the floor."""
    families = experiment.families()
    return Result(
        experiment,
        "The best fit of each prior to unseen shapes.",
        "Chamfer distance times 1000 (squared scene units) of each prior's best fit, and its floor; medians over "
        "shapes.",
        remarks=(*NOTES, *definitions(experiment.records, DEFINED)),
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, families.items()),
        figure=draw(experiment, families),
    )


@style.styled
def draw(experiment: Experiment, families: dict[str, list[Record]]) -> Figure:
    """Draws a line per family: pairs of pictures, then the histogram."""
    figure, axes = chart.sheet(1.25 * len(families), len(families), 2, width_ratios=(4.7, 1))
    for (left, right), (name, records) in zip(axes, families.items(), strict=True):
        gallery.fill(left, _block(experiment, name, records[:SHOWN]), inches=0.87)
        _histogram(right, experiment, records)
    axes[0, -1].set_title("length of the gradient", fontsize=7)
    return figure


def _block(experiment: Experiment, name: str, records: list[Record]) -> Block:
    """The truth and the fit of each record, which names how far the fit is from the floor."""
    cells, titles = [], []
    for record in records:
        scene, ratio = Scene(experiment, [record], REFERENCE), _ratio(record)
        cells += [scene.shared([record], gallery.normals("reference_")), scene.cell(record, gallery.normals())]
        titles += ["truth", "fit" if ratio is None else f"fit: {format.number(ratio)} × floor"]
    return Block("", titles, {name: cells})


def _histogram(axis: Axes, experiment: Experiment, records: list[Record]) -> None:
    found = [gallery.arrays(experiment.folder(record), ("gradient_length",))[0] for record in records]
    lengths = np.concatenate([np.asarray(arrays.get("gradient_length", ()), dtype=float) for arrays in found])
    lengths = lengths[np.isfinite(lengths)]
    if lengths.size:
        axis.hist(lengths.clip(0, 2), bins=np.linspace(0, 2, 41), color="#0072b2", density=True)
    axis.axvline(1.0, color="#777777", lw=0.8, ls=":")
    axis.set(yticks=[], xlim=(0, 2))


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """How far the fits are from the floor."""
    ratio = data["ratio"].where(data["status"] == "ok", np.inf).fillna(np.inf)
    said = (
        f"The best fit has *{format.number(float(ratio.median()))}* times the least error that can be measured "
        f"(median), "
    )
    return Answer(
        "How well can a prior show an unseen shape?",
        f"{said}at most {format.number(float(ratio.max()))} times (n = {len(data)} shapes).",
    )
