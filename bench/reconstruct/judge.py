"""Judges a shape with colours: by photographs that were held out, and by the true surface where there is one."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, log10, nan

import numpy as np
import torch
from jaxtyping import Bool, Float
from skimage.metrics import structural_similarity
from torch import Tensor

from bench.evaluate.evaluate import (
    DEFINITIONS,
    OWN_PREFIX,
    WORST_SURFACE,
    Evaluation,
    missed_parts_note,
    render_image,
    surface_metrics,
)
from bench.evaluate.state import State, coloured_image, empty_view, vertex_colours
from bench.reconstruct.subject import Subject
from bench.reconstruct.surfaces import painter, with_colours
from bench.reconstruct.symptoms import ROUGHNESS, WEIGHT, early_weight, roughness_scores
from bench.records.record import RunStatus
from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh
from datasets.scene import View, sample_surface
from datasets.shot import Shot, mask_iou
from renderers.camera import sphere_span
from renderers.field import Field

SEEN = "seen_"  # prefix of metrics over the parts of both surfaces that given photographs see
SURFACE = tuple(WORST_SURFACE)  # their names
IMAGES = {
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
OF_MESH = " The shape is seen by exact first hits of the mesh that evaluation.grid gives, for every renderer."
COLOURED_DEFINITIONS = {
    **{name: DEFINITIONS[name] for name in SURFACE},
    **{
        SEEN + name: f"{DEFINITIONS[name]} Over the points of both surfaces that a given photograph sees: within it,"
        " and not hidden by the surface itself."
        for name in SURFACE
    },
    **ROUGHNESS,
    **{name: text + OF_MESH for name, text in IMAGES.items()},
    **{OWN_PREFIX + k: f"{text} Of the image that the renderer under test renders." for k, text in IMAGES.items()},
    **WEIGHT,
}


def judge(state: State, subject: Subject) -> Evaluation:
    """Compares a state whose field has colours with held-out photographs and, where it is known, the true surface."""
    field, inputs, shots = state.field, state.inputs, subject.held_out
    metrics = surface_scores(state.mesh, subject, inputs) | field_scores(state, shots)
    metrics |= early_weight(field, [state.view_from(shot.camera) for shot in shots], inputs)
    own = [render_image(field, shot.camera, inputs) for shot in shots]
    views = [view for view, _ in own]
    scores = image_scores(views, [image for _, image in own], shots)
    metrics |= {OWN_PREFIX + name: value for name, value in scores.items()}
    if state.mesh is None:
        failure = RunStatus.EMPTY, "the field has no surface in the unit sphere"
        return Evaluation(metrics, None, failure, field=field)
    mesh = replace(state.mesh, colours=vertex_colours(field, state.mesh, inputs.device))
    return Evaluation(metrics, mesh, notes=missed_parts_note(state, views), field=field)


def judge_mesh(mesh: Mesh | None, subject: Subject, inputs: RunInputs) -> Evaluation:
    """Compares a mesh with coloured vertices in the same way; no renderer takes part."""
    metrics = surface_scores(mesh, subject, inputs)
    cameras = [shot.camera for shot in subject.held_out]
    blank = [(empty_view(camera), torch.zeros(camera.height, camera.width, 3)) for camera in cameras]
    seen = blank if mesh is None else [*map(painter(mesh), cameras)]
    metrics |= image_scores([view for view, _ in seen], [image for _, image in seen], subject.held_out)
    failure = (RunStatus.EMPTY, "no surface was found") if mesh is None else None
    return Evaluation(metrics, mesh, failure)


def coloured(field: Field, subject: Subject, inputs: RunInputs) -> Mesh | None:
    """The mesh of a field, with the colours of the given photographs."""
    mesh = State(field, inputs).mesh
    return mesh and with_colours(mesh, subject.given)


def surface_scores(mesh: Mesh | None, subject: Subject, inputs: RunInputs) -> dict[str, float]:
    """The surface metrics, on all of the surface and on its seen part; none where the truth is not known."""
    if subject.truth is None:
        return {}
    threshold, count = inputs.evaluation.fscore_threshold, inputs.evaluation.points
    true, visible = subject.true_surface(count, inputs.seed)
    found = None if mesh is None else sample_surface(mesh, count, inputs.seed + 1)
    whole = surface_metrics(found, true, threshold=threshold)
    part = judged = None
    if mesh is not None and found is not None:
        there = subject.seen(mesh, found)
        part, judged = found.some(there), (found, there)
    seen = surface_metrics(part, true.some(visible), threshold=threshold)
    rough = roughness_scores(judged, (true, visible))
    return whole | {SEEN + name: value for name, value in seen.items()} | rough


def field_scores(state: State, shots: Sequence[Shot]) -> dict[str, float]:
    """The metrics of `IMAGES` of a field's colours where views of its mesh meet a surface."""
    views = [state.view_from(shot.camera) for shot in shots]
    return image_scores(views, [coloured_image(state.field, view, state.inputs.device) for view in views], shots)


def image_scores(
    views: Sequence[View], images: Sequence[Float[Tensor, "_ _ 3"]], shots: Sequence[Shot]
) -> dict[str, float]:
    """The metrics of `IMAGES` of images, black outside of the shape; without masks none that need them."""
    pairs = [_against(view, image, shot) for view, image, shot in zip(views, images, shots, strict=True)]
    means = {
        name: float(np.mean([pair[name] for pair in pairs])) for name in ("psnr", "psnr_image", "ssim", "mask_iou")
    }
    if any(shot.mask is None for shot in shots):
        return {name: means[name] for name in ("psnr", "ssim")}
    return means | {"mask_iou_least": float(np.min([pair["mask_iou"] for pair in pairs]))}


def _against(view: View, image: Float[Tensor, "height width 3"], shot: Shot) -> dict[str, float]:
    judged, known = judged_pixels(shot)
    found, true = (image * judged[..., None]).numpy(), (shot.colours * known[..., None]).numpy()
    squares = (found - true) ** 2
    window = min(7, (min(true.shape[:2]) - 1) // 2 * 2 + 1)  # in tiny images an odd number below 7
    similar = structural_similarity(true, found, channel_axis=2, data_range=1.0, win_size=window)
    overlap = nan if shot.mask is None else mask_iou(view.mask.numpy(), shot.mask.numpy())
    return {
        "psnr": _decibels(squares[known.numpy()]),
        "psnr_image": _decibels(squares[judged.numpy()]),
        "ssim": float(similar),
        "mask_iou": overlap,
    }


def _decibels(squares: Float[np.ndarray, "n 3"]) -> float:
    """The peak signal-to-noise ratio of squared errors of colours from 0 to 1; +inf where there is no error."""
    error = float(squares.mean()) if len(squares) else 0.0
    return -10 * log10(error) if error else inf


def judged_pixels(shot: Shot) -> tuple[Bool[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """The pixels that are judged, and those of them whose colour is the photograph's; the others are to be black."""
    if shot.mask is not None:
        return torch.ones_like(shot.mask), shot.mask
    meets = sphere_span(shot.camera.rays())[2]
    return meets, meets
