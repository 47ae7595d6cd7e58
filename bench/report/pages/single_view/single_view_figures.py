"""Figs. 4 and 5 of DVR: shapes from one image in pictures, the best and the worst among them."""

from bench.report import gallery
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, Row, error, grouped, row_of
from bench.report.gallery import Block, Cell, Scene
from bench.report.pages.single_view import dvr_table1
from bench.report.write.result import Result
from bench.report.write.shapes import scene_of
from bench.report.write.table import FAMILY, IDENTITY, metrics, to_data

PLACE = 42
READS = dvr_table1.READS
PHOTOGRAPHS = {"given": "given", "photograph": "another\nimage"}
NOTES = (
    "Of each family the shape with the least and that with the largest Chamfer-L1 of the first row.",
    "The given image is all that the encoder sees; normals (right, up, towards the camera as red, green, blue) are "
    "seen by the camera of another image, which no row was given.",
)
RUNS = (FAMILY, *IDENTITY, *metrics("chamfer_l1", "iou"))


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line for a success and a failure of each family."""
    rows, of_scene = list(experiment.rows()), grouped(experiment.records, scene_of)
    shown = {k: v for of in experiment.families().values() for k, v in _extremes(of, rows[0]).items()}
    scenes = {name: Scene(experiment, of_scene[name], (*PHOTOGRAPHS, "normals", "hit")) for name in shown}
    lines = {shown[name]: _line(rows, of_scene[name], scene) for name, scene in scenes.items()}
    return Result(
        experiment,
        "Shapes from one image in pictures.",
        "The first row's best and worst shape of each family: images, and the normals that each row found.",
        remarks=(*NOTES, *gallery.missing(scenes.values())),
        data=to_data(RUNS, experiment.records),
        figure=gallery.draw([Block("", [*PHOTOGRAPHS.values(), *(row.name for row in rows)], lines)]),
    )


def _line(rows: list[Row], records: list[Record], scene: Scene) -> list[Cell]:
    at = {row_of(record): record for record in records}
    images = [scene.whole(records, name) for name in PHOTOGRAPHS]
    return [*images, *(scene.cell(at.get(row), gallery.normals()) for row in rows)]


def _extremes(records: list[Record], row: Row) -> dict[str, str]:
    """The scenes of a family's shapes with the least and the largest error of a row, and what they are."""
    ordered = sorted((r for r in records if row_of(r) == row), key=lambda record: error(record, "chamfer_l1"))
    ends = {scene_of(ordered[0]): "best", scene_of(ordered[-1]): "worst"} if ordered else {}
    return {scene: f"{scene}, {end}" for scene, end in ends.items()}
