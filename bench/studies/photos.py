"""Shape and colour from real photographs: the rows of DVR's Table 2 that need no true shape."""

from bench.report.study import Result, Runs, Selection, format, medians, records, table

PLACE = 46
READS = (Selection("photos", setup=("scenes", "machine")),)
NAMES = ("psnr", "ssim", "mask_iou", "mask_iou_least")
DEFINED = {"psnr": "PSNR", "ssim": "SSIM", "mask_iou": "Mask IoU"}
COLUMNS = (
    table.text("method", "Method"),
    table.Column("psnr", "PSNR (dB)"),
    table.Column("ssim", "SSIM"),
    table.Column("mask_iou", "Mask IoU"),
    table.Column("mask_iou_least", "least"),
    *medians.COST,
)
RUNS = (table.FAMILY, *table.IDENTITY, *table.metrics(*NAMES, "own_psnr", "own_mask_iou"), *table.LOOP)


def make(runs: Runs) -> Result:
    """A line per row."""
    lines, folders = medians.medians(runs, NAMES), format.plural(len(runs.families()), "folder")
    return Result(
        runs,
        "Shape and colour from real photographs.",
        "Held-out photographs: how well the shape and its colours match them, medians over folders; in the figure a "
        "point per folder, and the median.",
        question="Which method is best on real photographs?",
        verdict=format.ends("PSNR of held-out photographs (dB)", medians.whole(lines, "psnr"), folders, most=True),
        remarks=records.definitions(runs.records, DEFINED),
        columns=COLUMNS,
        lines=lines,
        run_columns=RUNS,
        figure=medians.draw_runs(runs, {"PSNR (dB)": medians.scored(runs, "psnr"), **medians.cost(runs)}),
    )


PAGES = {"photos": make}
