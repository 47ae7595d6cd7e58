"""Shape from the outline in one view: the error of the covered area over the number of rays per pixel."""

from dataclasses import replace

from bench.report.study import Result, Runs, Selection, condition_curves, format

PLACE = 27
RAYS = "view.rays_per_pixel"
READS = (Selection("outline", (RAYS,)),)
CONTROLS = tuple(f"outline_{name}_{kept}" for name in ("relaxed", "neus") for kept in ("mask", "fraction"))
NOTES = (
    "A prior's code is fitted to the mask of one image of 24 x 24 pixels, without depth. The code is penalised little.",
    "The area error sums the differences between the fractions of pixels that the fitted and the true mesh cover, each "
    "by 8 x 8 rays. At the start, the mean shape has an error of {start:.3g} pixels (median).",
    "Rows with area in their name compare a pixel's mean opacity with the fraction that the shape covers. The others "
    "compare single rays: in a pixel of which a fraction k of n rays is covered, k rays should hit. Rays that hit come "
    "first, in random order, and then the rays nearest to the surface.",
    "With 1 ray, it goes through the centre of each pixel. With 4 and 16, each iteration draws a random ray in each of "
    "2 x 2 or 4 x 4 squares of the pixel. All rows have 60 iterations, so four times the rays cost four to five times "
    "as much. Runs with 16 rays are of eight of the twelve shapes.",
    "A run that is not ok ended with no smaller loss than at its start (`not_reached`). Its result counts.",
    "With 1 ray, a pixel's observation is its mask at the centre. With several, it is the covered fraction. Rows with "
    "mask or fraction in their name keep that observation for any number of rays. The figure leaves them out.",
)


def notes(runs: Runs) -> list[str]:
    """The notes with the error of the mean shape."""
    return [note.format(start=runs.number("start_area_error").median()) for note in NOTES]


PAGE = condition_curves.ConditionCurves(
    condition=RAYS,
    heading="Rays per pixel",
    first=1,
    absent=1,
    compared=4,
    measures=(
        condition_curves.Measure("area_error", "Area error (pixels)"),
        condition_curves.Measure("chamfer_l1", "Chamfer-L1 × 1000", 1e3),
    ),
    title="Outlines by several rays per pixel.",
    question="Does a silhouette loss fit an outline better with several rays per pixel?",
    verdict="Area error with 4 rays per pixel over that with 1",
    notes=notes,
    only_in_table=CONTROLS,
)


def make(runs: Runs) -> Result:
    """The page, with the two rows that explain its verdict."""
    result = PAGE(runs)
    lines = {(line["preset"], line["value"]): line for line in result.lines}
    stuck, centres = lines.get(("outline_relaxed", 1)), lines.get(("outline_neus_mask", 4))
    parts = []
    if stuck is not None:
        start, end = (format.number(x) for x in (runs.number("start_area_error").median(), stuck["area_error"]))
        parts.append(f"With 1 ray, the relaxed boundary does not improve ({start} to {end} pixels).")
    if centres is not None and centres["ratio"] is not None:
        ratio = format.number(centres["ratio"])
        parts.append(f"NeuS with masks, not fractions: {ratio}.")
    return replace(result, verdict=" ".join([result.verdict, *parts]) if result.verdict else "")


PAGES = {"outline": make}
