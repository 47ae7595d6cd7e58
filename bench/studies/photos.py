"""Shape and colour from real photographs: the rows of DVR's Table 2 that need no true shape."""

from bench.report.data.records import definitions, family
from bench.report.data.runs import Runs, Selection
from bench.report.medians import COST, best, draw_runs, medians, plural, scored
from bench.report.write.result import Result
from bench.report.write.table import FAMILY, IDENTITY, LOOP, Column, metrics, text, to_data, to_table

PLACE = 46
READS = (Selection("photos", setup=("scenes", "machine")),)
NAMES = ("psnr", "ssim", "mask_iou", "mask_iou_least")
DEFINED = {"psnr": "PSNR", "ssim": "SSIM", "mask_iou": "Mask IoU"}
COLUMNS = (
    text("method", "Method"),
    *(Column("psnr", "PSNR (dB)"), Column("ssim", "SSIM"), Column("mask_iou", "Mask IoU")),
    Column("mask_iou_least", "least"),
    *COST,
)
RUNS = (FAMILY, *IDENTITY, *metrics(*NAMES, "own_psnr", "own_mask_iou"), *LOOP)


def make(runs: Runs) -> Result:
    """A line per row."""
    lines, folders = medians(runs, NAMES), plural(len({family(record) for record in runs.records}), "folder")
    return Result(
        runs,
        "Shape and colour from real photographs.",
        "Held-out photographs: how well the shape and its colours match them, medians over folders; in the figure a "
        "point per folder, and the median.",
        question="Which method is best on real photographs?",
        verdict=best(lines, "psnr", "PSNR of held-out photographs in dB", folders, most="largest"),
        remarks=definitions(runs.records, DEFINED),
        data=to_data(RUNS, runs.records),
        table=to_table(COLUMNS, lines),
        figure=draw_runs(runs, {"PSNR (dB)": scored(runs, "psnr"), "seconds in the loop": runs.frame.loop}),
    )


PAGES = {"photos": make}
