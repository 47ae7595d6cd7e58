"""The gradient of a silhouette's area over the number of rays per pixel: its error, bias and noise."""

from math import nan

from bench.report.study import Selection, condition_curves

PLACE = 202
RAYS = "view.rays_per_pixel"
READS = (Selection("area_gradient", (RAYS,), setup=Selection.WITHOUT_MACHINE),)
NOTES = [
    "The area is the sum of the opacities of an image of 24 x 24 pixels. A pixel's opacity is the mean over its rays."
    " The gradient is for the prior's code, along 4 random directions, at training shapes of the prior.",
    "The true gradient is by central differences of the covered area in float64, with 32 x 32 rays per pixel. A step "
    "moves 90 % of the surface near the outline by less than 0.05 pixels. On a thin shape, smaller steps changed the "
    "true gradient by 5 %.",
    "With 1 ray per pixel, the ray goes through the centre. With 4 and 16, a random ray is drawn in each of 2 x 2 or "
    "4 x 4 squares of the pixel.",
    "The error is that of a gradient with one draw of the rays. The bias is the error of the mean over 16 draws. The "
    "noise is the standard deviation of the draws. The mean of 16 draws still has a quarter of the noise, so a smaller "
    "bias cannot be distinguished from 0. With 1 ray nothing is drawn, so the error is the bias. All three are "
    "relative to the length of the true gradient.",
    "Each renderer has its default blur. Field evaluations are those of one draw. DIST, DVR, IDR, Newton, Naive, range "
    "analysis and the mesh proxy have no opacity with a gradient: `silhouette=area` refuses them.",
]

PAGES = {
    "area_gradient": condition_curves.ConditionCurves(
        condition=RAYS,
        heading="Rays per pixel",
        first=1,
        absent=1,
        compared=4,
        measures=(
            condition_curves.Measure("area_error", "Relative error"),
            condition_curves.Measure("area_bias", "Relative bias"),
            condition_curves.Measure("area_noise", "Relative noise", failed=nan),
        ),
        title="Gradients of a silhouette's area.",
        question="How accurate is the gradient of a silhouette's area?",
        leading="Relative error of the gradient",
        verdict="Error with 4 rays per pixel over that with 1",
        notes=lambda _: NOTES,
    )
}
