"""Shape and colour from real photographs: the rows of DVR's Table 2 that need no true shape."""

import pandas as pd

from bench.report.data.experiments import Experiment, Selection
from bench.report.data.records import definitions
from bench.report.pages.images.dvr_table2 import TASKS
from bench.report.write.answer import Answer, ranked
from bench.report.write.result import Result
from bench.report.write.shapes import COST, draw_curves, lines_of
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, metrics, text, to_data, to_table

PLACE = 46
READS = (Selection("photos", TASKS, ("dataset", "task", "field", "silhouette"), setup=("scenes", "machine")),)
NAMES = ("psnr", "ssim", "mask_iou", "mask_iou_least")
DEFINED = {"psnr": "PSNR", "ssim": "SSIM", "mask_iou": "Mask IoU"}
COLUMNS = (
    text("method", "Method"),
    *(Column("psnr", "PSNR (dB)"), Column("ssim", "SSIM"), Column("mask_iou", "Mask IoU")),
    Column("mask_iou_least", "least"),
    *COST,
)
RUNS = (FAMILY, *IDENTITY, *metrics(*NAMES, "own_psnr", "own_mask_iou"), *LOOP)


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per row."""
    return Result(
        experiment,
        "Shape and colour from real photographs.",
        "Held-out photographs: how well the shape and its colours match them, the median over folders; in the figure, "
        "the same over time and over field values at each checkpoint.",
        remarks=definitions(experiment.records, DEFINED),
        data=to_data(RUNS, experiment.records),
        table=to_table(COLUMNS, lines_of(experiment, NAMES)),
        figure=draw_curves(experiment, "psnr", "PSNR (dB)", 1.0),
    )


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The row with the highest PSNR of held-out photographs."""
    verdict = ranked(data, "psnr", better="higher").said("PSNR of held-out photographs in dB", most="highest")
    return Answer("Which method is best on real photographs?", verdict)
