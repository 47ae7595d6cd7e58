"""Failures that users of volume renderers report: floaters, weight in front of the surface, bumps where unseen."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from bench.evaluate.evaluate import OWN_PREFIX
from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh
from datasets.scene import Surface, View
from renderers.boundary import render_checked
from renderers.field import Field

MAX_NEIGHBOUR_DISTANCE = 0.05  # scene units: normals of surface points up to this distance are compared
EARLY_WEIGHT_GAP = 0.05  # scene units: weight farther in front of the surface than this is early
MIN_RAY_WEIGHT = 1e-3  # a ray with a smaller sum of weights sees no surface
FLOATER_DISTANCE = 0.05  # scene units: a connected part without a vertex nearer to the true surface is a floater
FLOATERS = {
    "floaters": "Share of the mesh's area in connected parts of which no vertex lies within 0.05 scene units of the "
    "true surface, from 0 to 1. Infinite without a surface."
}
ROUGHNESS = {
    f"{name}_roughness": "Mean angle between the normals of two points sampled on the surface at most 0.05 scene units "
    f"apart, that {others} given photograph sees, less the same of the true surface, in degrees; normals count without "
    "their sign. Above 0 the surface is bumpier than the true one, below it is smoother."
    for name, others in (("seen", "some"), ("unseen", "no"))
}
WEIGHT = {
    OWN_PREFIX
    + "early_weight": "Share of the weight of a ray that lies more than 0.05 scene units in front of the first hit "
    "of the mesh, mean over the rays of held-out photographs that hit it and have weight; of renderers that sum along "
    "rays (NeuS, Sec. 3.1: an unbiased rendering has its greatest weight at the surface)."
}


def floater_scores(mesh: Mesh | None, truth: Surface) -> dict[str, float]:
    """The metric of `FLOATERS`, against points on the true surface."""
    if mesh is None:
        return dict.fromkeys(FLOATERS, np.inf)
    near = cKDTree(truth.points).query(mesh.vertices, distance_upper_bound=FLOATER_DISTANCE)[0] < np.inf
    is_attached = np.bincount(mesh.parts, weights=near[mesh.faces].any(axis=1)) > 0
    areas = np.bincount(mesh.parts, weights=np.linalg.norm(mesh.area_normals, axis=1))
    return dict.fromkeys(FLOATERS, float(areas[~is_attached].sum() / areas.sum()))


def roughness_scores(
    predicted: tuple[Surface, Bool[np.ndarray, " n"]] | None, truth: tuple[Surface, Bool[np.ndarray, " m"]]
) -> dict[str, float]:
    """The metrics of `ROUGHNESS`, from the points of both surfaces and the masks of seen points.

    They are infinite without a predicted surface, and if only the true surface has the region.
    """
    scores = {}
    for name, is_seen in zip(ROUGHNESS, (True, False), strict=True):
        true_roughness = roughness(truth[0].select(truth[1] == is_seen))
        rough = None if predicted is None else roughness(predicted[0].select(predicted[1] == is_seen))
        if rough is None:
            scores[name] = 0.0 if true_roughness is None and predicted is not None else np.inf
        else:
            scores[name] = rough - (true_roughness or 0.0)
    return scores


def roughness(surface: Surface) -> float | None:
    """The mean angle between the normals of neighbouring points, in degrees; None if no two points are neighbours."""
    if len(surface.points) < 2:
        return None
    first, second = cKDTree(surface.points).query_pairs(MAX_NEIGHBOUR_DISTANCE, output_type="ndarray").T
    if not len(first):
        return None
    normals = surface.normals / np.linalg.norm(surface.normals, axis=1, keepdims=True).clip(1e-12)
    cosine = np.abs((normals[first] * normals[second]).sum(axis=1)).clip(0, 1)
    return float(np.degrees(np.arccos(cosine)).mean())


@torch.no_grad()
def early_weight(field: Field, views: Sequence[View], inputs: RunInputs) -> dict[str, float]:
    """The metric of `WEIGHT`; empty if the renderer gives no volume, and if no ray hits.

    The views show the field's mesh, by exact first hits.
    """
    shares: list[Float[torch.Tensor, " rays"]] = []
    for view in views:
        if not bool(view.mask.any()):
            continue
        rays = view.camera.rays()[view.mask].to(inputs.device)
        surface = view.camera.distance(view.depth)[view.mask].to(inputs.device)
        volume = render_checked(inputs.renderer, field, rays).volume
        if volume is None:
            return {}
        early = (volume.distance < surface[volume.ray] - EARLY_WEIGHT_GAP).to(surface)
        summed = volume.weighted_sum(torch.stack([early, torch.ones_like(early)], dim=-1), len(surface))
        opaque = summed[:, 1] > MIN_RAY_WEIGHT
        shares.append((summed[opaque, 0] / summed[opaque, 1]).cpu())
    ray_shares = torch.cat(shares) if shares else torch.zeros(0)
    return {name: float(ray_shares.mean()) for name in WEIGHT} if len(ray_shares) else {}
