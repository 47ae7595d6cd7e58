"""Shape and colour from real photographs: the rows of DVR's Table 2, and its columns if a true surface is given."""

from math import isfinite

from bench.report.study import Result, Runs, Selection, format, medians, records, table

PLACE = 46
READS = (Selection("photos", setup=("scenes", "machine")),)
NAMES = ("psnr", "ssim", "mask_iou", "mask_iou_least")
DEFINED = {"psnr": "PSNR", "ssim": "SSIM", "mask_iou": "Mask IoU"}
TRUTH_COLUMNS = (  # for runs with dataset.truth
    *table.columns(dtu_accuracy="Accuracy (mm)", dtu_completeness="Completeness (mm)", dtu_overall="Chamfer-L1 (mm)"),
    *table.columns(table.thousandfold, seen_chamfer_l1="Chamfer-L1 × 1000, seen"),
)
COLUMNS = (
    *table.columns(psnr="PSNR (dB)", ssim="SSIM", mask_iou="Mask IoU", mask_iou_least="least"),
    *medians.COST,
)
TRUTH = tuple(column.key for column in TRUTH_COLUMNS)
RUNS = (table.FAMILY, *table.IDENTITY, *table.metrics(*NAMES, *TRUTH, "own_psnr", "own_mask_iou"), *table.LOOP)


def make(runs: Runs) -> Result:
    lines, folders = medians.medians(runs, (*NAMES, *TRUTH)), format.plural(len(runs.families()), "folder")
    measured = {key for line in lines for key in TRUTH if line[key] is not None and isfinite(line[key])}
    truth_columns = [column for column in TRUTH_COLUMNS if column.key in measured]
    return Result(
        runs,
        "Shape and colour from real photographs.",
        "Agreement of shape and colours with held-out photographs, medians over folders; the figure has a point per "
        "folder and the median.",
        question="Which method is best on real photographs?",
        verdict=table.extremes(
            "PSNR of held-out photographs (dB)", medians.comparable_medians(lines, "psnr"), folders, largest_first=True
        ),
        remarks=records.definitions(runs.records, DEFINED),
        columns=(table.text("method", "Method"), *truth_columns, *COLUMNS),
        lines=lines,
        run_columns=RUNS,
        figure=medians.draw_runs(runs, {"PSNR (dB)": medians.scored(runs, "psnr"), **medians.cost(runs)}),
    )


PAGES = {"photos": make}
