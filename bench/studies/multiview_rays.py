"""Shape from many views with masks, at equal cost: losses of opacities and of masks, over rays per pixel."""

from typing import Any

import numpy as np

from bench.report.study import Runs, Selection, condition_curves, statistics

PLACE = 51
RAYS = "view.rays_per_pixel"
READS = (Selection("multiview_rays", (RAYS,), setup=Selection.WITHOUT_MACHINE),)
CONTROL_ROWS = tuple(f"multiview_area_{kind}{name}" for kind in ("fraction", "centre") for name in ("", "_neus"))
MASK_ROWS = tuple(f"multiview_mask{name}" for name in ("", "_neus", "_opaque", "_volsdf", "_unisurf"))
NOTES = (
    "A prior's code is fitted, from a random code, to the colours and silhouettes of 12 photographs of 32 x 32 pixels. "
    "With several rays, the mean colour of a pixel is compared, but only if all of its rays hit and the neighbouring "
    "photograph sees at least half of their points.",
    "All runs have the same budget of field evaluations. An iteration draws a pixel of each block of 1, 2, 4 or 8 "
    "pixels per side: the smallest block with which the budget pays for 40 iterations. With several rays, blocks "
    "are larger, so an iteration compares fewer pixels, and a run may have more iterations.",
    "With 1 ray, the observation of a pixel is its mask at the centre. With 4 and 16, it is the fraction that the "
    "shape covers. So a ratio also contains the change of the observation. Rows with “mask” or “fraction” after “area” "
    "in their name keep that observation for any number of rays. With “fraction”, a single ray goes through a random "
    "point.",
    "Rows with “area” in their name compare a pixel's mean opacity with the fraction of it that the shape covers. The "
    "other rows, also of volume renderers, have DIST's mask loss: if the shape covers a fraction k of a pixel, k n of "
    "its n rays should hit. The figure and the answer have only “area” rows without “mask” or “fraction”.",
    "The weights of the two losses were chosen on four validation shapes, for the relaxed boundary and NeuS: of 1, 10, "
    "100 and 1000 for areas with 4 rays, and of 1, 10 and 100 for masks with 1 ray.",
    "A run that is not ok counts with its result, if it has one. With `not_reached`, its loss did not fall.",
)


def notes(runs: Runs) -> list[str]:
    """The notes, with the ratio of each renderer's area loss with 4 rays to its mask loss with 1."""
    rays, errors = runs.number(f"config.{RAYS}").fillna(1), runs.number("chamfer_l1").fillna(np.inf)
    frame = runs.frame.assign(rays=rays, error=errors).set_index(condition_curves.SHAPE).sort_index()
    errors_of = {key: group["error"] for key, group in frame.groupby(["preset", "rays"])}
    names: dict[Any, str] = dict(zip(frame["preset"], frame["row"], strict=True))
    ratios = [
        f"{name}, {statistics.common_ratio(errors_of[area, 4], errors_of[mask, 1])}"
        for area, name in names.items()
        if (mask := area.replace("area", "mask")) != area and {(area, 4), (mask, 1)} <= errors_of.keys()
    ]
    compared = (
        f"Chamfer-L1 of the area loss with 4 rays over that of the mask loss with 1, not tested: {'; '.join(ratios)}."
    )
    return [*NOTES, *([compared] if ratios else [])]


PAGES = {
    "multiview_rays": condition_curves.ConditionCurves(
        condition=RAYS,
        heading="Rays per pixel",
        first=1,
        absent=1,
        compared=4,
        also_compared=(16,),
        measures=(condition_curves.Measure("chamfer_l1", "Chamfer-L1 × 1000 (scene units)", 1e3),),
        title="Many views by rays per pixel.",
        question="At equal cost, do several rays per pixel lower the error of a shape from many views?",
        verdict="Chamfer-L1 with 4 or 16 rays per pixel over that with 1, at equal cost",
        notes=notes,
        only_in_table=(*MASK_ROWS, *CONTROL_ROWS),
    )
}
