"""Figs. 20 to 22 of DIST: completed shapes in pictures, over the sparsity of the depth image."""

from bench.report import gallery
from bench.report.compare import Comparison, heading
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, grouped, row_of, setting
from bench.report.data.runs import Selection
from bench.report.gallery import BEHIND, FOUND, FRONT, TRUE, Block, Scene
from bench.report.write.result import Result
from bench.report.write.table import COMPLETION, FAMILY, configured, to_data

TABLE2 = Selection("table2", ("task.points",))
POINTS = Comparison().order
PLACE = 22
READS = (TABLE2,)
PRESETS = ("deepsdf", "dist_depth", "dist_mask")  # rows that are shown, where they were run
NOTES = (
    "The shape is the one with the least number, not a chosen one. Normals are red, green and blue (right, up, towards "
    "the camera) of the mesh that is judged, seen from the given camera on the left and from behind on the right.",
    "Above them the given depths, near ones yellow; all rows but “DIST with mask” see nothing else, and that sees the "
    "mask as well. Dense depth implies the mask. DeepSDF is given the true normals at these points.",
    "DIST, Figs. 20 to 22, shows shapes of ShapeNet from three sides; these are of other families and another prior.",
)
ARRAYS = ("given", *(kind + part for kind in (FOUND, TRUE) for part in ("normals", "hit")))
BOTH = (FRONT, BEHIND)
RUNS = (FAMILY, configured("points", "task", "points"), *COMPLETION)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a block per family: the given depths, and each row's shape below them."""
    shown = gallery.first_shapes(experiment, 1, PRESETS)
    scenes = {name: Scene(shown, records, ARRAYS) for name, records in shown.families().items()}
    blocks = [_block(name, records, scenes[name]) for name, records in shown.families().items()]
    return Result(
        shown,
        "Completed shapes in pictures.",
        "The first shape of each family at each number of given depth points, from the given camera and from behind.",
        remarks=(*NOTES, *gallery.missing(scenes.values())),
        data=to_data(RUNS, shown.records),
        figure=gallery.draw(blocks, across=2),
    )


def _block(name: str, records: list[Record], scene: Scene) -> Block:
    """The rows of a family over the number of points, behind them the truth."""
    by_row = grouped(records, row_of)
    found = {points: of for points, of in grouped(records, _points).items()}
    points = [p for p in POINTS if p in found] + sorted(found.keys() - {*POINTS})
    given = [scene.shared(found[p][:1], gallery.depth) for p in points]
    rows = {"given depths": [*given, scene.shared(records, gallery.normals(TRUE), BOTH)]}
    for row, of_row in by_row.items():
        at = {_points(record): record for record in of_row}
        rows[row.name] = [scene.cell(at.get(p), gallery.normals(FOUND), BOTH) for p in points]
    return Block(name, [*map(heading, points), "truth"], rows)


def _points(record: Record) -> str:
    return str(setting(record["config"], "task", "points"))
