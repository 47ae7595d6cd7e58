"""Figs. 11 and 23 of DIST: shapes from many views in pictures, beside the mesh-based method."""

from bench.report.data.experiments import Experiment
from bench.report.data.records import ONE_WAY, Record, grouped, row_of
from bench.report.pages.views import table3
from bench.report.write.gallery import FOUND, FRONT, START, TRUE, Block, Cell, Scene, draw, first_shapes
from bench.report.write.result import Result
from bench.report.write.shapes import scene_of
from bench.report.write.table import FAMILY, IDENTITY, metrics, to_data

PLACE = 44
READS = table3.READS
MOST_SHAPES = 4  # of each family
KINDS = (START, FOUND, TRUE)
NOTES = (
    f"Of each family the {MOST_SHAPES} shapes with the least numbers, not chosen ones. Normals are red, green and blue "
    "(right, up, towards the camera) of the mesh that is judged, seen from the first photograph's side.",
    "Start: the shape of the random code that all rows begin with. A mesh row moves the vertices of the prior's mesh, "
    "as PMO does; it is no run of PMO's code.",
    "DIST, Figs. 11 and 23, shows shapes of ShapeNet beside PMO; these are of other families and another prior.",
)
RUNS = (FAMILY, *IDENTITY, *metrics(ONE_WAY, "chamfer_l2"))


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per shape: the truth, the start, and what each row found."""
    shown = first_shapes(experiment, MOST_SHAPES)
    names = [row.name for row in shown.rows()]
    lines, missing = {}, []
    for name, records in grouped(shown.records, scene_of).items():
        scene = Scene(shown, records, KINDS)
        lines[name] = _line(names, records, scene)
        missing += scene.missing(name)
    return Result(
        shown,
        "Shapes from many views in pictures.",
        "The truth, the start, and the shape that each row found.",
        remarks=(*NOTES, *missing),
        data=to_data(RUNS, shown.records),
        figure=draw([Block("", ["truth", "start", *names], lines)], across=1),
    )


def _line(names: list[str], records: list[Record], scene: Scene) -> list[Cell]:
    of_row = {row_of(record).name: record for record in records}
    found = [scene.shape(of_row[name], views=(FRONT,)) if name in of_row else Cell(note="no run") for name in names]
    return [*(scene.any(records, kind, (FRONT,)) for kind in (TRUE, START)), *found]
