"""Figs. 6 to 8 of DVR: shapes with colours and normals, beside the visual hull and Poisson at each trim."""

from bench.report.data.experiments import Experiment
from bench.report.data.records import grouped
from bench.report.pages.images import dvr_table2
from bench.report.write.result import Result
from bench.report.write.shapes import draw_pictures, scene_of
from bench.report.write.table import FAMILY, IDENTITY, metrics, to_data

PLACE = 47
READS = dvr_table2.READS
MOST_SCENES = 2
NOTES = (
    "Each picture is of the extracted surface of a mesh row, or of the field as one fast renderer draws it, from a "
    "camera whose photograph was held out. Colours of mesh rows are those of the photographs that see a vertex.",
)
RUNS = (FAMILY, *IDENTITY, *metrics("seen_chamfer_l1", "psnr"))


def make(experiment: Experiment) -> Result:
    """Makes the page, with the pictures of the first scenes."""
    every = list(grouped(experiment.records, scene_of))
    scenes = every[:MOST_SCENES]
    left = f" The first {len(scenes)} of {len(every)} scenes." if len(every) > len(scenes) else ""
    figure, missing = draw_pictures(experiment, list(experiment.rows()), scenes)
    return Result(
        experiment,
        "Shapes from photographs in pictures.",
        f"Colours above, normals (right, up, towards the camera as red, green, blue) below.{left}",
        remarks=(*NOTES, *missing),
        data=to_data(RUNS, experiment.records),
        figure=figure,
    )
