"""Figs. 4 and 5 of DVR: shapes from one image in pictures, the best and the worst among them."""

from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, Row, error, row_of
from bench.report.pages.single_view import dvr_table1
from bench.report.write.result import Result
from bench.report.write.shapes import draw_pictures, scene_of
from bench.report.write.table import FAMILY, IDENTITY, metrics, to_data

PLACE = 42
READS = dvr_table1.READS
PHOTOGRAPHS = {"given": "given", "photograph": "another image"}
NOTES = (
    "Of each family the shape with the least and that with the largest Chamfer-L1 of the first row. The given image is "
    "all that the encoder sees; shapes are drawn from the camera of another image, which no row was given.",
    "Colours above, normals (right, up, towards the camera as red, green, blue) below. What knows no colours is grey, "
    "and so is what the given image does not show where a row takes its colours; "
    "rows without a training have the colours of the images of the shape that they take.",
)
RUNS = (FAMILY, *IDENTITY, *metrics("chamfer_l1", "iou"))


def make(experiment: Experiment) -> Result:
    """Makes the page, with the pictures of a success and a failure of each family."""
    rows = list(experiment.rows())
    scenes = [scene for records in experiment.families().values() for scene in _extremes(records, rows[0])]
    figure, missing = draw_pictures(experiment, rows, scenes, PHOTOGRAPHS, most=12)
    return Result(
        experiment,
        "Shapes from one image in pictures.",
        "The first row's best and worst shape of each family.",
        remarks=(*NOTES, *missing),
        data=to_data(RUNS, experiment.records),
        figure=figure,
    )


def _extremes(records: list[Record], row: Row) -> list[str]:
    """The names of a family's shapes with the least and the largest error of a row."""
    ordered = sorted((r for r in records if row_of(r) == row), key=lambda record: error(record, "chamfer_l1"))
    if not ordered:
        return []
    return list(dict.fromkeys([scene_of(ordered[0]), scene_of(ordered[-1])]))
