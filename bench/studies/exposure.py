"""Reconstruction from photographs whose exposures differ."""

from bench.report.study import Selection, condition_curves

PLACE = 49
EXPOSURE = "task.images.exposure"
READS = (Selection("exposure", (EXPOSURE,)),)
NOTES = [
    "The colours of each photograph, also of a held-out one, are multiplied by a random factor and limited to 1. The "
    "standard deviation is that of the logarithms of the factors: at 0.3, a typical factor is 35 % from 1. Renderers "
    "do not know the factors.",
    "Masks are given. Chamfer-L1 is over what photographs see.",
]


PAGES = {
    "exposure": condition_curves.ConditionCurves(
        condition=EXPOSURE,
        heading="Standard deviation of the log exposure",
        first=0,
        compared=0.3,
        measures=(
            condition_curves.Measure("seen_chamfer_l1", "Chamfer-L1 × 1000 (scene units)", 1e3),
            condition_curves.Measure("mask_iou", "Overlap of masks (IoU)", failed=0.0),
        ),
        title="Photographs of different exposures.",
        question="How much worse is a reconstruction if the exposures of photographs differ?",
        verdict="Chamfer-L1 with exposures that differ by 35 % (0.3 in the table), over that with equal exposures",
        notes=lambda _: NOTES,
    )
}
