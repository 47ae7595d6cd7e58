"""Table 2 of DVR: shape and colour from rendered photographs, measured and published."""

import pandas as pd

from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import SCALE, definitions, grouped, setting
from bench.report.write.answer import Answer, ranked
from bench.report.write.result import Result
from bench.report.write.shapes import COST, draw_curves, lines_of, scene_of
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, metrics, text, thousandfold, to_data, to_table

PLACE = 45
TASKS = ("reconstruction", "hull", "poisson", "stereo")
READS = (Selection("dvr_table2", TASKS, ("dataset", "task", "field", "silhouette"), setup=("scenes", "machine")),)
# DVR (Niemeyer et al. 2020), Table 2: accuracy, completeness and Chamfer-L1 on DTU's scans 65, 106 and 118, in mm.
PUBLISHED = {
    "Colmap + sPSR, trim 0": (1.881, 0.726, 1.303),
    "Colmap + sPSR, trim 5": (1.400, 0.782, 1.091),
    "Colmap + sPSR, trim 7": (0.446, 1.020, 0.733),
    "DVR (RGB)": (1.054, 0.760, 0.907),
    "DVR (RGB and depth)": (0.789, 0.775, 0.782),
}
NAMES = ("seen_accuracy", "seen_completeness", "seen_chamfer_l1", "chamfer_l1", "psnr", "ssim", "mask_iou")
DEFINED = {"seen_chamfer_l1": "Chamfer-L1, seen", "chamfer_l1": "all", "psnr": "PSNR", "ssim": "SSIM"}
NOTES = (
    "Photographs are on a circle, so that none sees the underside: “seen” is what a given photograph sees of either "
    "surface. Distances in scene units, times 1000; a pixel is 24 of them wide at 96 x 96.",
    "Two samplings of one surface by 30,000 points have a Chamfer-L1 of 5.7 to 7.1, below which no row comes. All "
    "surfaces are cut off at the unit sphere.",
    "All rows but DVR's own share one field (4 layers of 128, a distance with colours), rate and iterations; all but "
    "DVR's own and the volumes' share the mask loss and weights. Volumes have the cross entropy of their opacity for "
    "the masks, at NeuS's weight where the foreground is a third, and a budget of samples a ray: NeuS 40, "
    "VolSDF up to 96 in its search and 40 summed, UNISURF 64 in its search and 32 summed.",
    "Colours are compared at hits; with volumes and the relaxed boundary on all rays of the foreground, in front of "
    "black. Evaluations are of the field, without those of colours: one per hit, of volumes one per weighted sample.",
    "The depths of “RGB and depth” are a tenth of all, those of Poisson all of them; both have noise of 0.01.",
    "DVR's own rows have their paper's rate of 1e-4 and no more iterations than others, not the paper's hundreds of "
    "thousands: they are far from their end.",
    "“Published” is DVR, Table 2: photographs of three scans of DTU at 1200 x 1600, in mm, which cannot be compared "
    "directly with the measured rows.",
)
COLUMNS = (
    text("method", "Method"),
    Column("seen_accuracy", "Accuracy", show=thousandfold),
    Column("seen_completeness", "Completeness", show=thousandfold),
    Column("seen_chamfer_l1", "Chamfer-L1, seen", show=thousandfold),
    Column("chamfer_l1", "all", show=thousandfold),
    *(Column("psnr", "PSNR"), Column("ssim", "SSIM"), Column("mask_iou", "Mask IoU")),
    *COST,
)
RUNS = (FAMILY, *IDENTITY, *metrics(*NAMES, "seen_fscore", "mask_iou_least", "own_psnr", "own_mask_iou"), *LOOP)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per row and the published ones."""
    published = [
        {"method": f"published: {name}", **dict(zip(NAMES, (value / 1000 for value in values), strict=False))}
        for name, values in PUBLISHED.items()
    ]
    scenes = len(grouped(experiment.records, scene_of))
    return Result(
        experiment,
        "Shape and colour from photographs.",
        f"Medians over {scenes} scene{'s' if scenes > 1 else ''} of errors on what the photographs see; in the figure, "
        f"the error over time and over field values at each checkpoint.{_conditions(experiment)}",
        remarks=(*NOTES, *definitions(experiment.records, DEFINED)),
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, [*lines_of(experiment, NAMES), *published]),
        figure=draw_curves(experiment, "seen_chamfer_l1", "Chamfer-L1, seen\n× 1000 (scene units)", 1000.0),
    )


def _conditions(experiment: Experiment) -> str:
    """What photographs there were, and how long was optimised."""
    task = next((r["config"]["task"] for r in experiment.records if setting(r["config"], "task", "optimiser")), None)
    if task is None or setting(task, "images", "views") is None:
        return ""
    return (
        f" {task['images']['views']} photographs, {task['longest']} pixels along the longer side, one in "
        f"{task['held_out']} held out; {task['optimiser']['iterations']} iterations."
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row with the lowest Chamfer-L1 of what is seen."""
    verdict = ranked(data, "seen_chamfer_l1").said("Chamfer-L1 of what the photographs see, × 1000", scale=SCALE)
    return Answer("Which method finds shape and colour from photographs?", verdict)
