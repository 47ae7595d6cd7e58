"""Table 3 and Figs. 11 and 23 of DIST: shape from many views, from random initial codes."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report import gallery
from bench.report.data.records import ONE_WAY, SCALE, Record, by_shape, grouped, row_of, run_key, solid
from bench.report.data.runs import Runs, Selection
from bench.report.data.statistics import Interval, bootstrap, interquartile_mean, median, share
from bench.report.gallery import FOUND, SHAPES, START, TRUE, Block, Cell, Scene
from bench.report.medians import best, draw_runs, medians, plural, scene_of
from bench.report.oracle import LABEL, NOTE, oracles
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, counted, metrics, text, to_data, to_table

PLACE = 40
READS = (Selection("table3"),)
# DIST (Liu et al. 2020), Table 3: mean Chamfer from truth to prediction x 1000, 50 shapes of PMO's test set.
PUBLISHED = {
    "car": {"PMO": 0.661, "PMO, random start": 1.187, "DIST, random start": 0.919},
    "plane": {"PMO": 1.129, "PMO, random start": 6.124, "DIST, random start": 1.595},
}
NOTES = (
    "Error: mean squared distance from points of the true surface to the nearest of the found one, in that direction "
    "only, in squared scene units, times 1000; that of a run that did not end ok is infinite, a cross at the edge.",
    "All runs start from random codes, one per shape, the same for each method (grey); “End / start” is the median of "
    "the shapes' ratios, “End / oracle” the ratio of the medians.",
    f"{NOTE} Dotted: three times its error.",
    "“Published” is DIST, Table 3: 50 shapes of PMO's renderings of ShapeNet, with another prior and metric scale, so "
    "it cannot be compared directly with the measured rows.",
)
MESH = "multiview_mesh"  # the preset that PMO's rows are to be read beside
ON_MESH = (
    "“{row}” moves the vertices of the prior's mesh by the photometric error, as PMO (Lin et al. 2019) does, from the "
    "same codes as other rows: read it beside “published: PMO, random start”."
)
RUNS = (
    *(FAMILY, *IDENTITY),
    *metrics(ONE_WAY, "chamfer_l2", "accuracy", "completeness", "mask_iou"),
    Column(f"{ONE_WAY}_start", value=lambda record: record["metrics_start"].get(ONE_WAY)),
    *LOOP,
)
PICTURED = (FAMILY, *IDENTITY, *metrics(ONE_WAY, "chamfer_l2"))
MOST_SHAPES = 4  # of each family, in pictures


def _words(key: str, heading: str) -> Column:
    """A column that is empty in the lines of the oracle and of published numbers."""
    return Column(key, heading, show=lambda words: words or "")


COLUMNS = (
    *(text("family", "Family"), text("method", "Method"), _words("start", "Start"), Column("end", "End")),
    *(_words("middle", "Interquartile mean"), _words("of_start", "End / start"), _words("of_oracle", "End / oracle")),
    *(_words("lost", "Failed"), _words("loop", "Loop"), _words("values", "Evaluations")),
)


def make(runs: Runs) -> Result:
    """A line per family and method."""
    oracle, shapes = oracles(runs, ONE_WAY), {solid(record) for record in runs.records}
    lines = [line for name in runs.families() for line in _lines(runs, name, oracle.get(name))]
    return Result(
        runs,
        "Shape from many views, without a mask.",
        "Median initial and final error over {shapes and seeds}, and its cost.",
        question="Which method finds a shape by photographs from many views, without a mask?",
        verdict=best(
            *(medians(runs, [ONE_WAY]), ONE_WAY, "error, from truth to prediction × 1000"),
            plural(len(shapes), "shape"),
            scale=SCALE,
        ),
        interval="95 % bootstrap intervals of interquartile means over {shapes and seeds}, Clopper and Pearson's of "
        "failures over shapes",
        estimates=[line["interval"] for line in lines if "interval" in line],
        remarks=(*NOTES, *(ON_MESH.format(row=row.name) for row in runs.rows() if row.preset == MESH)),
        data=to_data(RUNS, runs.records),
        table=to_table(COLUMNS, lines),
        figure=draw(runs, oracle),
    )


def _errors(runs: Runs) -> tuple[pd.Series, pd.Series]:
    """The error of each run at its start and at its end; infinite where it did not end ok, or has none."""
    return SCALE * runs.number(f"start_{ONE_WAY}").fillna(np.inf), runs.error(ONE_WAY)


def _lines(runs: Runs, name: str, oracle: float | None) -> list[dict[str, Any]]:
    """The lines of a family: the rows, the oracle, and the published ones."""
    own = runs.where(runs.frame.family == name)
    lines = [
        {"family": name, **line, **_line(own.where(own.frame.row == line["method"]), oracle)}
        | {"loop": format.seconds(line["seconds"]), "values": format.count(line["evaluations"])}
        for line in medians(own, [])
    ]
    lines += [] if oracle is None else [{"family": name, "method": LABEL, "end": oracle}]
    published = PUBLISHED.get(name, {}).items()
    return lines + [{"family": name, "method": f"published: {row}", "end": str(number)} for row, number in published]


def _line(runs: Runs, oracle: float | None) -> dict[str, Any]:
    starts, ends = _errors(runs)
    middle = _middle(runs.records, ends)
    left = (ends / starts).where(np.isfinite(starts) & np.isfinite(ends), np.inf)
    last = float(median(ends.to_numpy()))
    failed = [[run["status"] != "ok" for run in of] for of in grouped(runs.records, solid).values()]
    rate = share(list(map(sum, failed)), list(map(len, failed)))
    return {
        "start": format.number(float(median(starts.to_numpy()))),
        "end": last,
        "interval": middle,
        "middle": str(middle),
        "of_start": format.number(float(median(left.to_numpy()))),
        "of_oracle": format.number(last / oracle if oracle else None),
        "lost": counted(sum(map(sum, failed)), len(runs.records), rate),
    }


def _middle(records: list[Record], ends: pd.Series) -> Interval:
    """The interquartile mean of the final errors."""
    values = {run_key(record): end for record, end in zip(records, ends, strict=True)}
    return bootstrap(by_shape(values), interquartile_mean, seed=0)


@style.styled
def draw(runs: Runs, oracle: dict[str, float]) -> Figure:
    """Draws a panel per family with a line per method: each run's initial (grey) and final error."""
    starts, ends = _errors(runs)
    labels = {name: f"{name}: Chamfer, truth to\nprediction × 1000 (scene units²)" for name in runs.families()}
    panels = {label: ends.where(runs.frame.family == name) for name, label in labels.items()}
    figure = draw_runs(runs, panels, starts, log=False)
    for axis, (name, label) in zip(figure.axes, labels.items(), strict=True):
        style.log_axis(axis, "x", [*panels[label].dropna(), *starts[panels[label].notna()]])
        if name in oracle:
            chart.reference(axis.axvline, oracle[name], 3, "oracle")
    style.legend_below(figure, *figure.axes)
    return figure


def pictures(runs: Runs) -> Result:
    """A line per shape: the truth, the start, and what each row found."""
    shown = gallery.first_shapes(runs, MOST_SHAPES)
    names, of_scene = [row.name for row in shown.rows()], grouped(shown.records, scene_of)
    scenes = {name: Scene(shown, records, SHAPES) for name, records in of_scene.items()}
    lines = {name: _cells(names, records, scenes[name]) for name, records in of_scene.items()}
    return Result(
        shown,
        "Shapes from many views in pictures.",
        f"The truth, the start, and the shape that each row found, of the {MOST_SHAPES} shapes of each family with the "
        "least numbers.",
        remarks=(
            "Normals are red, green and blue (right, up, towards the camera) of the mesh that is judged, seen from the "
            "first photograph's side.",
            "Start: the shape of the random code that all rows begin with; a mesh row moves the vertices of the "
            "prior's mesh, as PMO does, and is no run of PMO's code.",
            "DIST, Figs. 11 and 23, shows shapes of ShapeNet beside PMO; these are of other families.",
            *gallery.missing(scenes.values()),
        ),
        data=to_data(PICTURED, shown.records),
        figure=gallery.draw([Block("", ["truth", "start", *names], lines)]),
    )


def _cells(names: list[str], records: list[Record], scene: Scene) -> list[Cell]:
    of_row = {row_of(record).name: record for record in records}
    shared = [scene.shared(records, gallery.normals(kind)) for kind in (TRUE, START)]
    return [*shared, *(scene.cell(of_row.get(name), gallery.normals(FOUND)) for name in names)]


PAGES = {"table3": make, "multiview_gallery": pictures}
