"""Evaluates a shape with colours: on held-out photographs, and on the true surface if it is known."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, log10, nan

import numpy as np
import torch
from jaxtyping import Bool, Float
from skimage.metrics import structural_similarity
from torch import Tensor

from bench.evaluate.colours import coloured_image, render_image, vertex_colours
from bench.evaluate.evaluate import (
    DEFINITIONS,
    OWN_PREFIX,
    WORST_SURFACE,
    Evaluation,
    missed_parts_note,
    surface_metrics,
)
from bench.evaluate.state import State, empty_view
from bench.records.record import RunStatus
from bench.setup.inputs import RunInputs
from bench.tasks.reconstruction.subject import Subject
from bench.tasks.reconstruction.surfaces import painter, with_colours
from bench.tasks.reconstruction.symptoms import (
    FLOATERS,
    ROUGHNESS,
    WEIGHT,
    early_weight,
    floater_scores,
    roughness_scores,
)
from datasets.mesh import Mesh
from datasets.scene import View, sample_surface
from datasets.shot import Shot, mask_iou
from renderers.camera import sphere_span
from renderers.field import Counts, Field

SEEN_PREFIX = "seen_"  # marks metrics over the points of both surfaces that are visible in an input photograph
SURFACE_METRICS = tuple(WORST_SURFACE)
RENDERING_COST = OWN_PREFIX + "evaluations"
IMAGE_SCORES = {
    "psnr": "Peak signal-to-noise ratio over the pixels of a held-out photograph's mask, black where the shape is not"
    " seen, mean over photographs, in decibels, as IDR and NeuS define it. Without masks: over the pixels whose rays"
    " meet the unit sphere.",
    "psnr_image": "The same over all pixels, both black outside of the shape and the photograph outside of its mask: a"
    " smaller object has a higher one.",
    "ssim": "Structural similarity (scikit-image, in windows of 7 x 7 pixels) of the same images, mean, up to 1.",
    "mask_iou": "Number of pixels that are foreground in both masks divided by the number that are foreground in at"
    " least one, mean over held-out photographs, from 0 to 1.",
    "mask_iou_least": "The same, the least over held-out photographs.",
}
MESH_IMAGE_NOTE = " The shape is seen by exact first hits of the mesh that evaluation.grid gives, for every renderer."
COLOURED_DEFINITIONS = {
    **{name: DEFINITIONS[name] for name in SURFACE_METRICS},
    **{
        f"{SEEN_PREFIX}{name}": f"{DEFINITIONS[name]} Over the points of both surfaces that a given photograph sees:"
        " within it, and not hidden by the surface itself."
        for name in SURFACE_METRICS
    },
    **ROUGHNESS,
    **FLOATERS,
    **{name: text + MESH_IMAGE_NOTE for name, text in IMAGE_SCORES.items()},
    **{
        OWN_PREFIX + name: f"{text} Of the image that the renderer under test renders."
        for name, text in IMAGE_SCORES.items()
    },
    **WEIGHT,
    RENDERING_COST: "Field evaluations per ray of the renderer under test, over all pixels of the held-out photographs,"
    " without those of gradients and colours.",
}


def judge(state: State, subject: Subject) -> Evaluation:
    """Compares a state whose field has colours with held-out photographs and, if it is known, the true surface."""
    field, inputs, shots = state.field, state.inputs, subject.held_out
    metrics = surface_scores(state.mesh, subject, inputs) | field_scores(state, shots)
    metrics |= early_weight(field, [state.view_from(shot.camera) for shot in shots], inputs)
    counts, rays = Counts(), sum(shot.colours[..., 0].numel() for shot in shots)
    renderings = [render_image(field, shot.camera, inputs, counts) for shot in shots]
    metrics[RENDERING_COST] = counts.value / rays
    views = [view for view, _ in renderings]
    scores = image_scores(views, [image for _, image in renderings], shots)
    metrics |= {OWN_PREFIX + name: value for name, value in scores.items()}
    if state.mesh is None:
        failure = RunStatus.EMPTY, "the field has no surface in the unit sphere"
        return Evaluation(metrics, None, failure, field=field)
    mesh = replace(state.mesh, colours=vertex_colours(field, state.mesh, inputs.device))
    return Evaluation(metrics, mesh, notes=missed_parts_note(state, views), field=field)


def judge_mesh(mesh: Mesh | None, subject: Subject, inputs: RunInputs) -> Evaluation:
    """Compares a mesh with coloured vertices in the same way, without a renderer."""
    metrics = surface_scores(mesh, subject, inputs)
    cameras = [shot.camera for shot in subject.held_out]
    blank = [(empty_view(camera), torch.zeros(camera.height, camera.width, 3)) for camera in cameras]
    renderings = blank if mesh is None else [*map(painter(mesh), cameras)]
    metrics |= image_scores([view for view, _ in renderings], [image for _, image in renderings], subject.held_out)
    failure = (RunStatus.EMPTY, "no surface was found") if mesh is None else None
    return Evaluation(metrics, mesh, failure)


def coloured(field: Field, subject: Subject, inputs: RunInputs) -> Mesh | None:
    """The mesh of a field, with the colours of the input photographs."""
    mesh = State(field, inputs).mesh
    return mesh and with_colours(mesh, subject.input_shots)


def surface_scores(mesh: Mesh | None, subject: Subject, inputs: RunInputs) -> dict[str, float]:
    """The surface metrics, on the full surface and on its visible part; empty if the truth is not known."""
    if subject.truth is None:
        return {}
    threshold, count = inputs.evaluation.fscore_threshold, inputs.evaluation.points
    true, true_seen = subject.true_surface(count, inputs.seed)
    sampled = None if mesh is None else sample_surface(mesh, count, inputs.seed + 1)
    scores = surface_metrics(sampled, true, threshold=threshold)
    seen_sample = sampled_and_seen = None
    if mesh is not None and sampled is not None:
        sampled_seen = subject.visible_points(mesh, sampled)
        seen_sample, sampled_and_seen = sampled.select(sampled_seen), (sampled, sampled_seen)
    seen_scores = surface_metrics(seen_sample, true.select(true_seen), threshold=threshold)
    roughness = roughness_scores(sampled_and_seen, (true, true_seen))
    seen_names = {SEEN_PREFIX + name: value for name, value in seen_scores.items()}
    return scores | seen_names | roughness | floater_scores(mesh, true)


def field_scores(state: State, shots: Sequence[Shot]) -> dict[str, float]:
    """The metrics of `IMAGE_SCORES` of a field's colours on its mesh's visible surface."""
    views = [state.view_from(shot.camera) for shot in shots]
    return image_scores(views, [coloured_image(state.field, view, state.inputs.device) for view in views], shots)


def image_scores(
    views: Sequence[View], images: Sequence[Float[Tensor, "_ _ 3"]], shots: Sequence[Shot]
) -> dict[str, float]:
    """The metrics of `IMAGE_SCORES` of images, black outside of the shape; without masks, only PSNR and SSIM."""
    pairs = [_compare_image(view, image, shot) for view, image, shot in zip(views, images, shots, strict=True)]
    means = {
        name: float(np.mean([pair[name] for pair in pairs])) for name in ("psnr", "psnr_image", "ssim", "mask_iou")
    }
    if any(shot.mask is None for shot in shots):
        return {name: means[name] for name in ("psnr", "ssim")}
    return means | {"mask_iou_least": float(np.min([pair["mask_iou"] for pair in pairs]))}


def _compare_image(view: View, image: Float[Tensor, "height width 3"], shot: Shot) -> dict[str, float]:
    judged, photographed = judged_pixels(shot)
    rendered, true = (image * judged[..., None]).numpy(), (shot.colours * photographed[..., None]).numpy()
    squares = (rendered - true) ** 2
    window = min(7, (min(true.shape[:2]) - 1) // 2 * 2 + 1)  # in tiny images an odd number below 7
    similar = structural_similarity(true, rendered, channel_axis=2, data_range=1.0, win_size=window)
    overlap = nan if shot.mask is None else mask_iou(view.mask.numpy(), shot.mask.numpy())
    return {
        "psnr": _decibels(squares[photographed.numpy()]),
        "psnr_image": _decibels(squares[judged.numpy()]),
        "ssim": float(similar),
        "mask_iou": overlap,
    }


def _decibels(squares: Float[np.ndarray, "n 3"]) -> float:
    """The peak signal-to-noise ratio of squared errors of colours from 0 to 1; +inf if the error is 0."""
    error = float(squares.mean()) if len(squares) else 0.0
    return -10 * log10(error) if error else inf


def judged_pixels(shot: Shot) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Masks of the compared pixels, and of those with the photograph's colour; the others should be black."""
    if shot.mask is not None:
        return torch.ones_like(shot.mask), shot.mask
    in_sphere = sphere_span(shot.camera.rays())[2]
    return in_sphere, in_sphere
