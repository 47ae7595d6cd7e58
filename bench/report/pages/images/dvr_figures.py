"""Figs. 6 to 8 of DVR: shapes with colours and normals, beside the visual hull and Poisson at each trim."""

from bench.report import gallery
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, grouped, row_of
from bench.report.gallery import Block, Cell, Scene
from bench.report.pages.images import dvr_table2
from bench.report.write.result import Result
from bench.report.write.shapes import scene_of
from bench.report.write.table import FAMILY, IDENTITY, metrics, to_data

PLACE = 47
READS = dvr_table2.READS
MOST_SCENES = 2
ALIKE = {  # rows that are not shown, since they look as another does
    *("rgb_dist", "rgb_idr", "rgb_naive", "rgb_relaxed_boundary", "rgb_volsdf", "rgb_unisurf"),
    *("rgbd_dvr", "dvr_paper_depth", "stereo", "poisson_5"),
}
ARRAYS = ("photograph", "colours", "normals", "hit")
NOTES = (
    "Each picture is of the extracted surface of a mesh row, or of the field as one fast renderer draws it, from a "
    "camera whose photograph was held out. Colours of mesh rows are those of the photographs that see a vertex.",
    "Of rows that look alike one is shown; summary.png in a run's folder is its own picture.",
)
RUNS = (FAMILY, *IDENTITY, *metrics("seen_chamfer_l1", "psnr"))


def make(experiment: Experiment) -> Result:
    """Makes the page, with a block per scene, of the first ones."""
    rows = [row.name for row in experiment.rows() if row.preset not in ALIKE] or [row.name for row in experiment.rows()]
    every = grouped(experiment.records, scene_of)
    shown = dict(list(every.items())[:MOST_SCENES])
    scenes = {name: Scene(experiment, [r for r in of if row_of(r).name in rows], ARRAYS) for name, of in shown.items()}
    left = f" The first {len(shown)} of {len(every)} scenes." if len(every) > len(shown) else ""
    return Result(
        experiment,
        "Shapes from photographs in pictures.",
        f"Colours above, normals (right, up, towards the camera as red, green, blue) below.{left}",
        remarks=(*NOTES, *gallery.missing(scenes.values())),
        data=to_data(RUNS, experiment.records),
        figure=gallery.draw([_block(name, rows, of, scenes[name]) for name, of in shown.items()]),
    )


def _block(name: str, rows: list[str], records: list[Record], scene: Scene) -> Block:
    """The held-out photograph and the colours of each row, normals below."""
    at = {row_of(record).name: record for record in records}
    photograph = scene.shared(records, lambda found: [found["photograph"]])
    colours = [scene.cell(at.get(row), gallery.colours()) for row in rows]
    normals = [scene.cell(at.get(row), gallery.normals()) for row in rows]
    return Block(name, ["held out", *rows], {"colours": [photograph, *colours], "normals": [Cell(), *normals]})
