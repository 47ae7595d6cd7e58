"""Failures that users of volume renderers report: weight before the surface, and bumps where no photograph looks."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from bench.evaluate.evaluate import OWN_PREFIX
from bench.setup.inputs import RunInputs
from datasets.scene import Surface, View
from renderers.boundary import rendered
from renderers.field import Field

NEIGHBOURS = 0.05  # scene units: farthest apart that two points of the surface are compared
EARLY = 0.05  # scene units in front of the surface, where no weight should be
LEAST_WEIGHT = 1e-3  # of all samples of a ray; one with less sees no surface
ROUGHNESS = {
    f"{part}_roughness": "Mean angle between the normals of two points sampled on the surface at most 0.05 scene units "
    f"apart, that {others} given photograph sees, less the same of the true surface, in degrees; normals count without "
    "their sign. Above 0 the surface is bumpier than the true one, below it is smoother."
    for part, others in (("seen", "some"), ("unseen", "no"))
}
WEIGHT = {
    OWN_PREFIX
    + "early_weight": "Share of the weight of a ray that lies more than 0.05 scene units in front of the first hit "
    "of the mesh, mean over the rays of held-out photographs that hit it and have weight; of renderers that sum along "
    "rays (NeuS, Sec. 3.1: an unbiased rendering has its greatest weight at the surface)."
}


def roughness_scores(
    found: tuple[Surface, Bool[np.ndarray, " n"]] | None, true: tuple[Surface, Bool[np.ndarray, " m"]]
) -> dict[str, float]:
    """The metrics of `ROUGHNESS` of a surface with those of its points that are seen, against the true one.

    They are infinite without a surface, and without the part where the true one has it.
    """
    scores = {}
    for name, seen in zip(ROUGHNESS, (True, False), strict=True):
        here, there = (None if one is None else roughness(one[0].some(one[1] == seen)) for one in (found, true))
        if here is None:
            scores[name] = 0.0 if there is None and found is not None else np.inf
        else:
            scores[name] = here - (there or 0.0)
    return scores


def roughness(surface: Surface) -> float | None:
    """The mean angle between the normals of points that are neighbours, in degrees; None where there are none."""
    if len(surface.points) < 2:
        return None
    first, second = cKDTree(surface.points).query_pairs(NEIGHBOURS, output_type="ndarray").T
    if not len(first):
        return None
    normals = surface.normals / np.linalg.norm(surface.normals, axis=1, keepdims=True).clip(1e-12)
    cosine = np.abs((normals[first] * normals[second]).sum(axis=1)).clip(0, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


@torch.no_grad()
def early_weight(field: Field, views: Sequence[View], inputs: RunInputs) -> dict[str, float]:
    """The metric of `WEIGHT`; none of a renderer that sees hits alone, and none where no ray hits.

    The views are of the field's mesh, by exact first hits.
    """
    shares: list[Float[torch.Tensor, " rays"]] = []
    for view in views:
        if not bool(view.mask.any()):
            continue
        rays = view.camera.rays()[view.mask].to(inputs.device)
        surface = view.camera.distance(view.depth)[view.mask].to(inputs.device)
        volume = rendered(inputs.renderer, field, rays).volume
        if volume is None:
            return {}
        early = (volume.distance < surface[volume.ray] - EARLY).to(surface)
        both = volume.summed(torch.stack([early, torch.ones_like(early)], dim=-1), len(surface))
        opaque = both[:, 1] > LEAST_WEIGHT
        shares.append((both[opaque, 0] / both[opaque, 1]).cpu())
    known = torch.cat(shares) if shares else torch.zeros(0)
    return {name: float(known.mean()) for name in WEIGHT} if len(known) else {}
