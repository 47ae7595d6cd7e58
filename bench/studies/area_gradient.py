"""The gradient of a silhouette's area over the number of rays per pixel: its error, noise and bias."""

from math import nan

from bench.report.study import Selection, condition_curves

PLACE = 202
RAYS = "view.rays_per_pixel"
READS = (Selection("area_gradient", (RAYS,)),)
NOTES = [
    "The area is the sum of the opacities of an image of 24 x 24 pixels, each the mean over the pixel's rays. Its "
    "gradient is for the prior's code, along 8 random directions, at training shapes of the prior.",
    "The true gradient is by central differences of the covered area in float64, with 16 x 16 rays per pixel. A step "
    "moves most of the outline by 0.15 pixels. Other steps and more rays changed it by about 1 % on a sofa.",
    "With 1 ray, it goes through the centre of each pixel, and nothing is random, so there is no noise. With 4 and 16, "
    "a random ray is drawn in each of 2 x 2 or 4 x 4 squares of the pixel. Error and noise are root mean squares over "
    "16 draws, relative to the true gradient. Scale is that of the mean over the draws, and 1 if exact.",
    "The scale of UNISURF is small because its 24 samples are farther apart than its width: on a ball with 16 rays, it "
    "is 0.55, and 0.93 with 128 samples.",
    "Each renderer has its default blur. DIST, DVR, IDR, Newton, Naive, range analysis and the mesh proxy have no "
    "opacity with a gradient: `silhouette=area` refuses them.",
]

PAGES = {
    "area_gradient": condition_curves.ConditionCurves(
        condition=RAYS,
        heading="Rays per pixel",
        first=1,
        absent=1,
        compared=4,
        measures=(
            condition_curves.Measure("area_error", "Error over the true gradient"),
            condition_curves.Measure("area_noise", "Noise over the true gradient", failed=nan),
            condition_curves.Measure("area_scale", "Scale"),
        ),
        title="Gradients of a silhouette's area.",
        question="How accurate is the gradient of a silhouette's area?",
        verdict="Error of the gradient with 4 rays per pixel over that with 1",
        notes=lambda _: NOTES,
    )
}
