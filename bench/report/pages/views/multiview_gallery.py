"""Figs. 11 and 23 of DIST: shapes from many views in pictures, beside the mesh-based method."""

from bench.report import gallery
from bench.report.data.experiments import Experiment
from bench.report.data.records import ONE_WAY, Record, grouped, row_of
from bench.report.gallery import FOUND, START, TRUE, Block, Cell, Scene
from bench.report.pages.views import table3
from bench.report.write.result import Result
from bench.report.write.shapes import scene_of
from bench.report.write.table import FAMILY, IDENTITY, metrics, to_data

PLACE = 44
READS = table3.READS
MOST_SHAPES = 4  # of each family
ARRAYS = tuple(kind + part for kind in (START, FOUND, TRUE) for part in ("normals", "hit"))
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
    shown = gallery.first_shapes(experiment, MOST_SHAPES)
    names = [row.name for row in shown.rows()]
    of_scene = grouped(shown.records, scene_of)
    scenes = {name: Scene(shown, records, ARRAYS) for name, records in of_scene.items()}
    lines = {name: _line(names, records, scenes[name]) for name, records in of_scene.items()}
    return Result(
        shown,
        "Shapes from many views in pictures.",
        "The truth, the start, and the shape that each row found.",
        remarks=(*NOTES, *gallery.missing(scenes.values())),
        data=to_data(RUNS, shown.records),
        figure=gallery.draw([Block("", ["truth", "start", *names], lines)]),
    )


def _line(names: list[str], records: list[Record], scene: Scene) -> list[Cell]:
    of_row = {row_of(record).name: record for record in records}
    shared = [scene.shared(records, gallery.normals(kind)) for kind in (TRUE, START)]
    return [*shared, *(scene.cell(of_row.get(name), gallery.normals(FOUND)) for name in names)]
