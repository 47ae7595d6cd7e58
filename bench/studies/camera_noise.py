"""Reconstruction from photographs with wrong cameras, which are kept or learnt with the shape."""

from bench.report.study import Selection, condition_curves

PLACE = 47
NOISE = "task.camera_noise"
READS = (Selection("camera_noise", (NOISE,)),)
NOTES = [
    "Each input photograph's camera but the first is wrong by this angle, about a random axis through the object's "
    "centre. Held-out photographs have true cameras.",
    "Rows with learnt cameras optimise a rigid motion of each camera but the first, with the shape and its colours.",
    "Chamfer-L1 is over what photographs see, in the coordinates of the first photograph's camera. One fixed camera "
    "does not fix the size of the shape, so a part of the error may be an error of size alone.",
]


PAGES = {
    "camera_noise": condition_curves.ConditionCurves(
        condition=NOISE,
        heading="Camera error at the start (degrees)",
        first=0,
        compared=3,
        measures=(
            condition_curves.Measure("seen_chamfer_l1", "Chamfer-L1 × 1000 (scene units)", 1e3),
            condition_curves.Measure("psnr", "PSNR of held-out photographs (dB)", failed=0.0),
            condition_curves.Measure("camera_error_deg", "Camera error (degrees)"),
        ),
        title="Reconstruction with wrong cameras.",
        question="Is the shape better if wrong cameras are learnt with it?",
        verdict="Chamfer-L1 with learnt cameras over that with kept ones, if cameras are 3 degrees wrong at the start",
        reference="cameras_kept",
        notes=lambda _: NOTES,
    )
}
