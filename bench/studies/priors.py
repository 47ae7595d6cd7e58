"""The oracle of each prior: its best fit to unseen shapes, with pictures and the length of its gradient."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report import gallery
from bench.report.data.records import Record, definitions, measured
from bench.report.data.runs import Runs
from bench.report.data.statistics import median
from bench.report.gallery import REFERENCE, Block, Scene
from bench.report.medians import plural
from bench.report.oracle import PRIORS
from bench.report.write import chart
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
    "A code of each prior is fitted to the signed distances of an unseen shape (DeepSDF, Eq. 10); the floor is the "
    "Chamfer distance between two samplings of the true surface, and a run that did not end ok counts as infinite.",
    "Histograms: length of the field's gradient within 0.02 of the true surface, over all shapes of a family; 1 for a "
    "distance.",
)


def _ratio(record: Record) -> float | None:
    fit, floor = measured(record, "chamfer_l2"), measured(record, "floor_chamfer_l2")
    return None if fit is None or not floor else fit / floor


RUNS = (FAMILY, *IDENTITY, *metrics(*DEFINED), Column("ratio", value=_ratio))
COLUMNS = (
    *(text("family", "Family"), text("shapes", "Shapes")),
    *(Column(name, DEFINED[name], show=thousandfold) for name in ("chamfer_l2", "floor_chamfer_l2")),
    *(Column("ratio", "Fit / floor"), Column("largest", "largest")),
    *(Column(name, DEFINED[name]) for name in ("distance_error", "slope_median", "slope_p99")),
)


def make(runs: Runs) -> Result:
    """A line per family: the fit of its shapes, and the floor."""
    found = [_ratio(record) if record["status"] == "ok" else None for record in runs.records]
    ratios = np.array([np.inf if ratio is None else ratio for ratio in found])
    values = pd.DataFrame({name: runs.error(name, 1) for name in DEFINED}).assign(ratio=ratios)
    lines = [
        {"family": name, "shapes": len(own), "largest": float(own.ratio.max())}
        | {column: float(median(own[column].to_numpy())) for column in own}
        for name, own in values.groupby(runs.frame.family, sort=False)
    ]
    return Result(
        runs,
        "The best fit of each prior to unseen shapes.",
        "Chamfer distance times 1000 (squared scene units) of each prior's best fit, and its floor; medians over "
        "shapes.",
        question="How well can a prior show an unseen shape?",
        verdict=f"The best fit has *{format.number(float(median(ratios)))}* times the least error that can be measured "
        f"(median), at most {format.number(ratios.max())} times; n = {plural(len(ratios), 'shape')}.",
        remarks=(*NOTES, *definitions(runs.records, DEFINED)),
        data=to_data(RUNS, runs.records),
        table=to_table(COLUMNS, lines),
        figure=draw(runs),
    )


@style.styled
def draw(runs: Runs) -> Figure:
    """Draws a line per family: pairs of pictures, then the histogram."""
    families = runs.families()
    wide = 1.6 * min(SHOWN, max(map(len, families.values())))  # inches of the pictures
    how = {"width": wide + 2.2, "width_ratios": (wide + 0.6, 1.6)}
    figure, axes = chart.sheet(1.2 * len(families), len(families), 2, **how)
    for (left, right), (name, records) in zip(axes, families.items(), strict=True):
        gallery.fill(left, _block(runs, name, records[:SHOWN]), inches=0.8)
        _histogram(right, runs, records)
    axes[0, -1].set_title("length of the gradient", fontsize=7)
    return figure


def _block(runs: Runs, name: str, records: list[Record]) -> Block:
    """The truth and the fit of each record, which names how far the fit is from the floor."""
    cells, titles = [], []
    for record in records:
        scene, ratio = Scene(runs, [record], REFERENCE), _ratio(record)
        cells += [scene.shared([record], gallery.normals("reference_")), scene.cell(record, gallery.normals())]
        titles += ["truth", "fit" if ratio is None else f"fit: {format.number(ratio)} × floor"]
    return Block("", titles, {name: cells})


def _histogram(axis: Axes, runs: Runs, records: list[Record]) -> None:
    found = [gallery.arrays(runs.folder(record), ("gradient_length",))[0] for record in records]
    lengths = np.concatenate([np.empty(0), *(arrays["gradient_length"] for arrays in found if arrays)])
    lengths = lengths[np.isfinite(lengths)]
    if lengths.size:
        axis.hist(lengths.clip(0, 2), bins=np.linspace(0, 2, 41), color="#0072b2", density=True)
    axis.axvline(1.0, color="#777777", lw=0.8, ls=":")
    axis.set(yticks=[], xlim=(0, 2))


PAGES = {"priors": make}
