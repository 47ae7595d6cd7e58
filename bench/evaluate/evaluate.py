"""Compares a field with the truth: its mesh, its images, its metrics in scene units. Never within a timed phase.

The noise floor of a surface metric is the metric between two independent samples of the truth.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from bench.config import load
from bench.records.record import RunStatus
from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh, extract
from datasets.scene import Surface, Truth, View, sample_surface, see
from renderers.boundary import rendered
from renderers.camera import Camera
from renderers.field import Field, autograd_gradients, autograd_normals
from renderers.fields.analytic import Shape, sphere
from renderers.fields.coloured import Coloured
from renderers.rendering import Renderer, Rendering

OWN = "own_"  # prefix of the metrics of what the renderer under test sees
GREY = 0.5  # of a mesh without colours
CHUNK = 16_384  # points whose colours are asked for at once
REACH = 1.05  # half the side of the sampled cube: the unit sphere and a margin
OF_MESH = "By exact first hits of the mesh that evaluation.grid gives within the unit sphere, for every renderer."
IMAGE = {
    "depth_mae": "Mean absolute difference of camera-z depth over the pixels that are foreground in both the"
    " predicted and the true mask, in scene units; infinite if there is no such pixel.",
    "mask_iou": "Number of pixels that are foreground in both masks divided by the number that are foreground"
    " in at least one, from 0 to 1; two empty masks give 1.",
}
OWN_DEFINITIONS = {
    OWN + name: f"{text} Of the image that the renderer under test renders." for name, text in IMAGE.items()
}
DEFINITIONS: dict[str, str] = {
    "chamfer_l2": "Sum of the mean squared distance from each point sampled on the prediction to the nearest"
    " point sampled on the truth and the same from truth to prediction (DIST), in squared scene units.",
    "chamfer_l1": "Half the sum of the mean distance from each point sampled on the prediction to the nearest"
    " point sampled on the truth and the same from truth to prediction (DVR), in scene units.",
    "chamfer_gt_to_pred": "Mean squared distance from each point sampled on the truth to the nearest point"
    " sampled on the prediction, that direction only (DIST Table 3), in squared scene units.",
    "accuracy": "Mean distance from each point sampled on the prediction to the nearest point sampled on the"
    " truth, in scene units; lower is better.",
    "completeness": "Mean distance from each point sampled on the truth to the nearest point sampled on the"
    " prediction, in scene units; lower is better.",
    "fscore": "Harmonic mean of precision (share of points sampled on the prediction that lie closer than the"
    " threshold to a point sampled on the truth) and recall (the same from truth to prediction), from 0 to 1;"
    " the threshold, in scene units, stands in the run's config.",
    "normal_consistency": "Mean absolute cosine between the normal at each sampled point and the normal at"
    " the nearest point sampled on the other surface, averaged over both directions (Occupancy Networks),"
    " from 0 to 1.",
    **{name: f"{text} {OF_MESH}" for name, text in IMAGE.items()},
    **OWN_DEFINITIONS,
}

# The score of a run without a surface: the worst.
WORST_SURFACE = {
    "chamfer_l2": np.inf,
    "chamfer_l1": np.inf,
    "chamfer_gt_to_pred": np.inf,
    "accuracy": np.inf,
    "completeness": np.inf,
    "fscore": 0.0,
    "normal_consistency": 0.0,
}


def surface_metrics(predicted: Surface | None, truth: Surface, *, threshold: float) -> dict[str, float]:
    """The seven surface metrics of `DEFINITIONS`, unscaled.

    Args:
        predicted: None or empty means that there is no surface, which scores worst: infinite distances, zero
            `fscore` and `normal_consistency`. A zero normal is consistent with none.
        truth: must not be empty.
        threshold: of `fscore`, in scene units, positive.

    Raises:
        ValueError: if the truth is empty.
    """
    if len(truth.points) == 0:
        raise ValueError("truth must have points, found 0; sample the true surface before comparing with it.")
    if predicted is None or len(predicted.points) == 0:
        return dict(WORST_SURFACE)
    to_truth, cosine_to_truth = _nearest(predicted, truth)
    to_predicted, cosine_to_predicted = _nearest(truth, predicted)
    return {
        "chamfer_l2": float(np.mean(to_truth**2) + np.mean(to_predicted**2)),
        "chamfer_l1": float(np.mean(to_truth) + np.mean(to_predicted)) / 2,
        "chamfer_gt_to_pred": float(np.mean(to_predicted**2)),
        "accuracy": float(np.mean(to_truth)),
        "completeness": float(np.mean(to_predicted)),
        "fscore": _harmonic_mean(float(np.mean(to_truth < threshold)), float(np.mean(to_predicted < threshold))),
        "normal_consistency": float(np.mean(cosine_to_truth) + np.mean(cosine_to_predicted)) / 2,
    }


def image_metrics(
    predicted_depth: Float[np.ndarray, "h w"],
    predicted_mask: Bool[np.ndarray, "h w"],
    truth_depth: Float[np.ndarray, "h w"],
    truth_mask: Bool[np.ndarray, "h w"],
) -> dict[str, float]:
    """The metrics of `IMAGE`, unscaled.

    Depth is camera z and is read only where both masks are true. A predicted depth there that is not a number
    counts as infinitely wrong.
    """
    common = predicted_mask & truth_mask
    error = np.abs(predicted_depth[common].astype(np.float64) - truth_depth[common])
    error[np.isnan(error)] = np.inf
    return {
        "depth_mae": float(error.mean()) if common.any() else np.inf,
        "mask_iou": mask_iou(predicted_mask, truth_mask),
    }


def mask_iou(found: Bool[np.ndarray, "h w"], true: Bool[np.ndarray, "h w"]) -> float:
    """See `IMAGE`."""
    common, either = found & true, found | true
    return float(common.sum() / either.sum()) if either.any() else 1.0


@dataclass(frozen=True)
class Evaluation:
    """The comparison of a run's state with the truth.

    Args:
        metrics: by the names in the record's definitions.
        mesh: of the field; None where it has no surface, or none was extracted.
        failure: status and reason, where the state is not a valid result; else None.
        notes: for the user.
    """

    metrics: dict[str, Any]
    mesh: Mesh | None = None
    failure: tuple[RunStatus, str] | None = None
    notes: tuple[str, ...] = ()


def evaluate(field: Field, inputs: RunInputs) -> Evaluation:
    """Compares a field with a scene's truth: surface samples of both, and the images in the scene's view.

    Images are those of the extracted mesh, so that no renderer judges itself, and those of the run's renderer beside
    them. The field is cut off at the unit sphere, since no prior was trained outside it.
    """
    truth = inputs.scene.view
    mesh, metrics = _compare(field, inputs)
    seen = unseen(truth.camera) if mesh is None else see(Truth(mesh, closed=False), truth.camera)
    metrics |= view_metrics(seen, truth) | view_metrics(render_view(field, truth.camera, inputs), truth, OWN)
    failure = (RunStatus.EMPTY, "the field has no surface in the unit sphere") if mesh is None else None
    return Evaluation(metrics, mesh, failure)


def view_metrics(seen: View, true: View, prefix: str = "") -> dict[str, float]:
    """The image metrics of a view against the true one, with a prefix to their names."""
    found = image_metrics(seen.depth.numpy(), seen.mask.numpy(), true.depth.numpy(), true.mask.numpy())
    return {prefix + name: value for name, value in found.items()}


def unseen(camera: Camera) -> View:
    """The view of a camera that sees no surface."""
    shape = camera.height, camera.width
    return View(camera, torch.zeros(shape), torch.zeros(*shape, 3), torch.zeros(shape, dtype=torch.bool))


def chamfer_only(field: Field, inputs: RunInputs) -> dict[str, float]:
    """The field's `chamfer_l2` only, as in `evaluate`: for checkpoints."""
    return {"chamfer_l2": _compare(field, inputs)[1]["chamfer_l2"]}


def surface_of(field: Field, inputs: RunInputs) -> Mesh | None:
    """The field's surface, cut off at the unit sphere."""
    inside = Shape(field, field.kind) & sphere(1.0)
    return extract(inside, grid=inputs.evaluation.grid, reach=REACH, device=inputs.device)


def _compare(field: Field, inputs: RunInputs) -> tuple[Mesh | None, dict[str, float]]:
    mesh = surface_of(field, inputs)
    found = None if mesh is None else sample_surface(mesh, inputs.evaluation.points, inputs.seed + 1)
    truth = true_surface(inputs, inputs.seed)
    return mesh, surface_metrics(found, truth, threshold=inputs.evaluation.fscore_threshold)


def true_surface(inputs: RunInputs, seed: int) -> Surface:
    """Samples of the true surface, as many as metrics use."""
    return sample_surface(inputs.scene.mesh, inputs.evaluation.points, seed)


def render_view(field: Field, camera: Camera, inputs: RunInputs) -> View:
    """Renders a field with the run's renderer from a camera, as a View on the CPU."""
    return view_of(render(inputs.renderer, field, camera, inputs.device), field, camera)


def picture_view(field: Field, camera: Camera, inputs: RunInputs) -> View:
    """A field as pictures show it: by one fast renderer, whatever is under test, if the field is of its kind."""
    fast = _fast()
    renderer = fast if field.kind in fast.capabilities.needs else inputs.renderer
    return view_of(render(renderer, field, camera, inputs.device), field, camera)


@cache
def _fast() -> Renderer:
    return load("renderer", "newton", warm=False)


def render(renderer: Renderer, field: Field, camera: Camera, device: torch.device) -> Rendering:
    """A rendering of a field from a camera, without gradients."""
    with torch.no_grad():
        return rendered(renderer, field, camera.rays().to(device))


def view_of(rendering: Rendering, field: Field, camera: Camera) -> View:
    """The hits of a rendering as a View on the CPU."""
    normals = torch.zeros_like(rendering.points)
    normals[rendering.hit] = autograd_normals(field, rendering.points[rendering.hit])
    depth = camera.depth(rendering.distance.cpu()) * rendering.hit.cpu()
    return View(camera, depth, normals.cpu(), rendering.hit.cpu())


def coloured_image(field: Coloured, view: View, device: torch.device) -> Float[Tensor, "height width 3"]:
    """The field's colours where a view meets a surface; black elsewhere."""
    image = torch.zeros(*view.mask.shape, 3)
    rays = view.camera.rays()[view.mask]
    points = rays.at(view.camera.distance(view.depth)[view.mask])
    image[view.mask] = colours_at(field, points, rays.directions, device)
    return image


def render_image(field: Coloured, camera: Camera, inputs: RunInputs) -> tuple[View, Float[Tensor, "height width 3"]]:
    """What the run's renderer shows from a camera: its hits, and their colours or a volume's weighted sums."""
    rendering = render(inputs.renderer, field, camera, inputs.device)
    view = view_of(rendering, field, camera)
    volume = rendering.volume
    if volume is None:
        return view, coloured_image(field, view, inputs.device)
    rays = camera.rays().flat().to(inputs.device)
    some = rays[volume.ray]
    colours = colours_at(field, some.at(volume.distance), some.directions, inputs.device).to(inputs.device)
    return view, volume.summed(colours, len(rays.origins)).view(*view.mask.shape, 3).cpu()


def painted(mesh: Mesh, truth: Truth, camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """The colours of a mesh's vertices, interpolated over its faces; grey without colours, black outside of it.

    Args:
        mesh: with or without colours.
        truth: of the same mesh.
    """
    colours = np.full_like(mesh.vertices, GREY) if mesh.colours is None else mesh.colours
    rays = camera.rays()
    weights, corners = truth.corners(rays.flat().origins.double().numpy(), rays.flat().directions.double().numpy())
    return np.einsum("nk,nkd->nd", weights, colours[corners]).reshape(*rays.shape, 3).clip(0, 1)


def vertex_colours(field: Coloured, mesh: Mesh, device: torch.device) -> Float[np.ndarray, "v 3"]:
    """The colours of a mesh's vertices, each seen from straight above."""
    return colours_at(field, torch.from_numpy(mesh.vertices).float(), None, device).numpy()


def colours_at(
    field: Coloured, points: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"] | None, device: torch.device
) -> Float[Tensor, "n 3"]:
    """The colours of points of the surface, on the CPU; without directions each is seen from straight above."""
    found = [points.new_zeros(0, 3)]
    for start in range(0, len(points), CHUNK):
        some = points[start : start + CHUNK].to(device)
        slopes = autograd_gradients(field, some)
        above = -torch.nn.functional.normalize(slopes, dim=-1)
        towards = above if directions is None else directions[start : start + CHUNK].to(device)
        with torch.no_grad():
            found.append(field.colours(some, slopes, towards).cpu())
    return torch.cat(found)


def _nearest(source: Surface, target: Surface) -> tuple[Float[np.ndarray, " source"], Float[np.ndarray, " source"]]:
    """From each source point to the nearest target point: distance, and absolute cosine of the normals."""
    distance, index = cKDTree(target.points).query(source.points)
    return distance, np.abs((_unit(source.normals) * _unit(target.normals)[index]).sum(axis=1))


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The vectors at unit length in float64; zero stays zero."""
    vectors = vectors.astype(np.float64)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def _harmonic_mean(first: float, second: float) -> float:
    return 2 * first * second / (first + second) if first + second > 0 else 0.0
