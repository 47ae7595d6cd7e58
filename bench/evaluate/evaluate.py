"""Compares a field with the truth: its mesh, its images, its metrics in scene units. Never within a timed phase.

The noise floor of a surface metric is the metric between two independent samples of the truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from bench.evaluate.state import State
from bench.records.record import RunStatus
from bench.setup.inputs import RunInputs
from bench.tables import extension
from datasets.mesh import Mesh
from datasets.scene import Surface, View, sample_surface
from datasets.shot import mask_iou
from renderers.boundary import render_checked
from renderers.camera import Camera
from renderers.field import Coloured, Counts, Field, Meter, autograd_normals
from renderers.rendering import Rendering

OWN_PREFIX = "own_"  # begins names of metrics of the image by the renderer under test
MIN_GAP_RATIO, MIN_GAP = 3.0, 0.02  # ratio, and difference in scene units, at which two depth errors give a note
MAX_SPACINGS_BEHIND = 2.0  # grid spacings: a hit farther behind a part of the mesh belongs to another part
FROM_MESH = "By exact first hits of the mesh that evaluation.grid gives within the unit sphere, for every renderer."
IMAGE_DEFINITIONS = {
    "depth_mae": "Mean absolute difference of camera-z depth over the pixels that are foreground in both the"
    " predicted and the true mask, in scene units; infinite if there is no such pixel.",
    "depth_bias": "Median difference of camera-z depth to the true one over the same pixels, in scene units: negative"
    " in front of the true surface; nan if there is no such pixel.",
    "mask_iou": "Number of pixels that are foreground in both masks divided by the number that are foreground"
    " in at least one, from 0 to 1; two empty masks give 1.",
}
RENDERER_DEFINITIONS = {
    OWN_PREFIX + k: f"{v} Of the image that the renderer under test renders." for k, v in IMAGE_DEFINITIONS.items()
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
    **{name: f"{text} {FROM_MESH}" for name, text in IMAGE_DEFINITIONS.items()},
    **RENDERER_DEFINITIONS,
}

PARTIAL_TRUTH_METRICS = ("completeness", "chamfer_gt_to_pred")  # valid if the truth shows only a part of the shape
COLOUR_DEFINITIONS = {
    "colour_error": "Mean absolute difference between the field's colours and the true ones, from 0 to 1, at points"
    " sampled on the whole true surface, seen or not.",
}
CHECKPOINT_METRICS = ("chamfer_l1", "chamfer_l2")

# The scores of a run without a surface.
WORST_SURFACE = dict.fromkeys(("chamfer_l2", "chamfer_l1", "chamfer_gt_to_pred", "accuracy", "completeness"), np.inf)
WORST_SURFACE |= {"fscore": 0.0, "normal_consistency": 0.0}


def surface_metrics(predicted: Surface | None, truth: Surface, *, threshold: float) -> dict[str, float]:
    """The seven surface metrics of `DEFINITIONS`, unscaled.

    Args:
        predicted: None or empty means no surface, with infinite distances and a `fscore` and `normal_consistency` of 0.
            A zero normal is consistent with no normal.
        truth: must not be empty.
        threshold: of `fscore`, in scene units, positive.
    """
    if len(truth.points) == 0:
        raise ValueError("truth must have points, found 0; sample the true surface before comparing with it.")
    if predicted is None or len(predicted.points) == 0:
        return dict(WORST_SURFACE)
    to_truth, cosine_to_truth = _nearest(predicted, truth)
    to_predicted, cosine_to_predicted = _nearest(truth, predicted)
    precision, recall = float(np.mean(to_truth < threshold)), float(np.mean(to_predicted < threshold))
    return {
        "chamfer_l2": float(np.mean(to_truth**2) + np.mean(to_predicted**2)),
        "chamfer_l1": float(np.mean(to_truth) + np.mean(to_predicted)) / 2,
        "chamfer_gt_to_pred": float(np.mean(to_predicted**2)),
        "accuracy": float(np.mean(to_truth)),
        "completeness": float(np.mean(to_predicted)),
        "fscore": 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0,
        "normal_consistency": float(np.mean(cosine_to_truth) + np.mean(cosine_to_predicted)) / 2,
    }


@dataclass(frozen=True)
class Evaluation:
    """The comparison of a run's state with the truth.

    Args:
        metrics: by the names in the record's definitions.
        mesh: of the field; None if it has no surface, or if no mesh was extracted.
        failure: status and reason, if the state is not a valid result; else None.
        notes: for the user.
        field: the evaluated field; None if the result has no field.
    """

    metrics: dict[str, Any]
    mesh: Mesh | None = None
    failure: tuple[RunStatus, str] | None = None
    notes: tuple[str, ...] = ()
    field: Field | None = None


def evaluate(state: State) -> Evaluation:
    """Compares a state with a scene's truth: surface samples of both, and the images in the scene's view.

    Images are rendered from the extracted mesh, so that no renderer evaluates itself, and also by the run's renderer.
    """
    truth = state.inputs.scene.view
    renderer_view = render_view(state.field, truth.camera, state.inputs)
    metrics = _surface_scores(state) | view_metrics(state.view_from(truth.camera), truth)
    metrics |= view_metrics(renderer_view, truth, OWN_PREFIX)
    failure = (RunStatus.EMPTY, "the field has no surface in the unit sphere") if state.mesh is None else None
    mesh = state.mesh
    if state.inputs.scene.texture is not None and isinstance(state.field, Coloured):
        colour_metrics, mesh = extension("evaluate_colours")(state)
        metrics |= colour_metrics
    return Evaluation(metrics, mesh, failure, missed_parts_note(state, [renderer_view]), state.field)


def missed_parts_note(state: State, renderer_views: Sequence[View]) -> tuple[str, ...]:
    """A note if the renderer under test misses connected parts of the mesh completely, else an empty tuple.

    A ray misses the first part of the mesh on its way if it ends without a hit, or far behind the part. The note counts
    parts that all rays miss. Such a part is, for example, a local dip of a distance field: marching steps over it.

    Args:
        renderer_views: by the renderer, from the cameras of the evaluation.
    """
    if state.mesh is None or state.raycaster is None:
        return ()
    parts = state.mesh.parts
    expected, missed = np.zeros((2, parts.max() + 1), dtype=np.int64)
    for view in renderer_views:
        rays = view.camera.rays().flat()
        hits = state.raycaster.cast(rays.origins.double().numpy(), rays.directions.double().numpy())
        distance = torch.where(view.mask, view.camera.distance(view.depth), torch.inf).flatten().numpy()
        overshoots = distance[hits.hit] > hits.distance[hits.hit] + MAX_SPACINGS_BEHIND * state.spacing
        index = parts[hits.face[hits.hit]]
        expected += np.bincount(index, minlength=len(expected))
        missed += np.bincount(index[overshoots], minlength=len(expected))
    lost = np.flatnonzero((expected > 0) & (missed == expected))
    if not len(lost):
        return ()
    sizes = [replace(state.mesh, faces=state.mesh.faces[parts == index]).diagonal for index in lost]
    what = f"{len(lost)} part{'s' * (len(lost) > 1)} of the mesh, at most {max(sizes):.2g} scene units across,"
    return (
        f"the renderer misses {what} which {expected[lost].sum()} of its rays should hit; the pictures show the mesh",
    )


def depth_gap_note(metrics: dict[str, Any]) -> tuple[str, ...]:
    """A note if the depth error of the renderer's image is `MIN_GAP_RATIO` times that of the field's mesh.

    A difference below `MIN_GAP` gives no note, as a single pixel at an outline may cause it.
    """
    error, own_error = metrics.get("depth_mae", np.inf), metrics.get(f"{OWN_PREFIX}depth_mae", 0.0)
    if not own_error >= max(MIN_GAP_RATIO * error, error + MIN_GAP) or np.isinf(error):
        return ()
    return (
        f"the depth error of the renderer's own image is {own_error:.3g}, and that of the mesh is {error:.3g} scene "
        "units. The renderer does not show the surface of the field; the contract test of CONTRIBUTING.md checks its "
        "hits",
    )


def view_metrics(view: View, true: View, prefix: str = "") -> dict[str, float]:
    """The metrics of `IMAGE_DEFINITIONS` of a view against the true one, with a prefix to their names.

    Depths are compared where both masks are true and the true depth is not 0, which means unknown. There, a depth of
    NaN counts as an infinite error, of an unknown sign.
    """
    depth, mask, true_mask = true.depth.numpy(), view.mask.numpy(), true.mask.numpy()
    common = mask & true_mask & (depth > 0)
    difference = view.depth.numpy()[common].astype(np.float64) - depth[common]
    error, any_common = np.where(np.isnan(difference), np.inf, np.abs(difference)), bool(common.any())
    metrics = {
        "depth_mae": float(error.mean()) if any_common else np.inf,
        "depth_bias": float(np.median(difference)) if any_common else np.nan,
        "mask_iou": mask_iou(mask, true_mask),
    }
    return {f"{prefix}{name}": value for name, value in metrics.items()}


def chamfer_only(state: State) -> dict[str, float]:
    """The state's Chamfer distances only, as in `evaluate`, for checkpoints; empty for a partial truth."""
    scores = _surface_scores(state)
    return {name: scores[name] for name in CHECKPOINT_METRICS if name in scores}


def _surface_scores(state: State) -> dict[str, float]:
    inputs, mesh = state.inputs, state.mesh
    predicted = None if mesh is None else sample_surface(mesh, inputs.evaluation.points, inputs.seed + 1)
    scores = surface_metrics(predicted, inputs.true_surface, threshold=inputs.evaluation.fscore_threshold)
    return {name: scores[name] for name in PARTIAL_TRUTH_METRICS} if inputs.scene.is_partial else scores


def render_view(field: Field, camera: Camera, inputs: RunInputs) -> View:
    """Renders a field with the run's renderer from a camera, as a View on the CPU."""
    return render_with_view(field, camera, inputs)[1]


def render_with_view(
    field: Field, camera: Camera, inputs: RunInputs, counts: Counts | None = None
) -> tuple[Rendering, View]:
    """The run's rendering of a field, without gradients, and its hits as a View on the CPU.

    The renderer's evaluations of the field are added to `counts`.
    """
    counted = field if counts is None else Meter(field, counts)
    with torch.no_grad():
        rendering = render_checked(inputs.renderer, counted, camera.rays().to(inputs.device))
    normals = torch.zeros_like(rendering.points)
    normals[rendering.hit] = autograd_normals(field, rendering.points[rendering.hit])
    depth = camera.depth(rendering.distance.cpu()) * rendering.hit.cpu()
    return rendering, View(camera, depth, normals.cpu(), rendering.hit.cpu())


def _nearest(source: Surface, target: Surface) -> tuple[Float[np.ndarray, " source"], Float[np.ndarray, " source"]]:
    """Per source point: distance to the nearest target point, and absolute cosine of the two normals."""
    distance, index = target.tree.query(source.points)
    return distance, np.abs((_unit(source.normals) * _unit(target.normals)[index]).sum(axis=1))


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """The vectors at unit length in float64; zero stays zero."""
    vectors = vectors.astype(np.float64)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
