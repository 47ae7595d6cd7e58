"""Shape from the outline in one view: the error of the covered area over the number of rays per pixel."""

from typing import Any

import numpy as np

from bench.report.study import Runs, Selection, condition_curves, statistics

PLACE = 27
RAYS = "view.rays_per_pixel"
READS = (Selection("outline", (RAYS,), setup=Selection.WITHOUT_MACHINE),)
CONTROLS = tuple(f"outline_{name}_{kept}" for name in ("relaxed", "neus") for kept in ("mask", "fraction"))
NOTES = (
    "A prior's code is fitted to the mask of one image of 24 x 24 pixels, without depth. The penalty of the code has a "
    "small weight.",
    "The area error sums the differences between the fractions of pixels that the fitted and the true mesh cover, each "
    "by 8 x 8 rays. At the start, the mean shape has an error of {start:.3g} pixels (median over shapes).",
    "Rows with “area” in their name compare a pixel's mean opacity with the fraction that the shape covers. The others "
    "compare single rays: if the shape covers a fraction k of a pixel, k n of its n rays should hit. Rays that hit are "
    "chosen first, in random order, and then the rays nearest to the surface.",
    "A single ray goes through the centre of the pixel. With 4 and 16 rays, each iteration draws a random ray in each "
    "of 2 x 2 or 4 x 4 squares of the pixel. Edge sampling splits these squares, as it splits pixels with 1 ray. All "
    "rows have 60 iterations, whatever their rays cost.",
    "Rows may have fewer shapes with 16 rays than with 1. Compare their ratios, not their medians.",
    "A run that is not ok counts with its result, if it has one. With `not_reached`, its loss did not fall.",
    "With 1 ray, a pixel's observation is its mask at the centre. With several, it is the covered fraction. Rows with "
    "“mask” or “fraction” at the end of their name keep that observation for any number of rays. The figure leaves "
    "them out.",
)


def notes(runs: Runs) -> list[str]:
    """The notes, with the error of the mean shape and ratios that are not tested."""
    rays = runs.number(f"config.{RAYS}").fillna(PAGE.absent)
    metrics = {key: runs.number(key).fillna(np.inf) for key in ("area_error", "chamfer_l1", "start_area_error")}
    frame = runs.frame.assign(rays=rays, **metrics).set_index(condition_curves.SHAPE).sort_index()
    start = frame["start_area_error"].groupby(level=condition_curves.SHAPE).first()
    groups: dict[Any, Any] = dict([*frame.groupby(["preset", "row", "rays"])])
    starts, surfaces = list[str](), list[str]()
    for (preset, row, count), group in groups.items():
        first = groups.get((preset, row, PAGE.first))
        if preset == "outline_relaxed" and count == PAGE.first:
            starts.append(f"{row}, {statistics.common_ratio(group['area_error'], start)}")
        if count == PAGE.compared and first is not None and preset not in CONTROLS:
            surfaces.append(f"{row}, {statistics.common_ratio(group['chamfer_l1'], first['chamfer_l1'])}")
    further = {
        "Area error with 1 ray over that of the start": starts,
        "Chamfer-L1 with 4 rays over that with 1": surfaces,
    }
    texts = [note.format(start=start.median()) for note in NOTES]
    return [*texts, *(f"{title}, not tested: {'; '.join(rows)}." for title, rows in further.items() if rows)]


PAGE = condition_curves.ConditionCurves(
    condition=RAYS,
    heading="Rays per pixel",
    first=1,
    absent=1,
    compared=4,
    measures=(
        condition_curves.Measure("area_error", "Area error (pixels)"),
        condition_curves.Measure("chamfer_l1", "Chamfer-L1 × 1000 (scene units)", 1e3),
    ),
    title="Outlines by several rays per pixel.",
    question="Does a silhouette loss fit an outline better with several rays per pixel?",
    verdict="Area error with 4 rays per pixel over that with 1",
    notes=notes,
    only_in_table=CONTROLS,
)
PAGES = {"outline": PAGE}
