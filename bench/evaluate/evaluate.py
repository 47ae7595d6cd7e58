"""Compares a field with the truth: its mesh, its images, its metrics. Never within a timed phase."""

from dataclasses import dataclass
from typing import Any

import torch

from bench.evaluate.metrics import Surface, image_metrics, surface_metrics
from bench.records.record import RunStatus
from bench.setup.inputs import RunInputs
from datasets.extract import extract
from datasets.mesh import Mesh
from datasets.scene import View
from datasets.truth import sample_surface
from renderers.boundary import rendered
from renderers.camera import Camera
from renderers.field import Field, autograd_normals
from renderers.fields.analytic import Shape, sphere

REACH = 1.05  # half the side of the sampled cube: the unit sphere and a margin


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

    The field is cut off at the unit sphere, since no prior was trained outside it.
    """
    truth = inputs.scene.view
    mesh, metrics = _compare(field, inputs)
    seen = render_view(field, truth.camera, inputs)
    metrics |= image_metrics(seen.depth.numpy(), seen.mask.numpy(), truth.depth.numpy(), truth.mask.numpy())
    failure = (RunStatus.EMPTY, "the field has no surface in the unit sphere") if mesh is None else None
    return Evaluation(metrics, mesh, failure)


def chamfer_only(field: Field, inputs: RunInputs) -> dict[str, float]:
    """The field's `chamfer_l2` only, as in `evaluate`: for checkpoints."""
    return {"chamfer_l2": _compare(field, inputs)[1]["chamfer_l2"]}


def _compare(field: Field, inputs: RunInputs) -> tuple[Mesh | None, dict[str, float]]:
    inside = Shape(field, field.kind) & sphere(1.0)
    mesh = extract(inside, grid=inputs.evaluation.grid, reach=REACH, device=inputs.device)
    found = None if mesh is None else Surface(*sample_surface(mesh, inputs.evaluation.points, inputs.seed + 1))
    truth = true_surface(inputs, inputs.seed)
    return mesh, surface_metrics(found, truth, threshold=inputs.evaluation.fscore_threshold)


def true_surface(inputs: RunInputs, seed: int) -> Surface:
    """Samples of the true surface, as many as metrics use."""
    return Surface(*sample_surface(inputs.scene.mesh, inputs.evaluation.points, seed))


def render_view(field: Field, camera: Camera, inputs: RunInputs) -> View:
    """Renders a field with the run's renderer from a camera, as a View on the CPU."""
    with torch.no_grad():
        rendering = rendered(inputs.renderer, field, camera.rays().to(inputs.device))
    normals = torch.zeros_like(rendering.points)
    normals[rendering.hit] = autograd_normals(field, rendering.points[rendering.hit])
    depth = camera.depth(rendering.distance.cpu()) * rendering.hit.cpu()
    return View(camera, depth, normals.cpu(), rendering.hit.cpu())
