"""What a result is worth: its mesh, its images, and its metrics against the truth. Off every clock."""

from dataclasses import dataclass

import torch

from bench.metrics import Surface, image_metrics, surface_metrics
from bench.stage import Stage
from datasets.extract import extract
from datasets.mesh import Mesh
from datasets.scene import View
from datasets.truth import sample_surface
from renderers.camera import Camera
from renderers.field import Field, autograd_normals
from renderers.fields.analytic import Shape, sphere

REACH = 1.05  # of the sampled cube: the unit sphere and a little more


@dataclass(frozen=True)
class Judgement:
    """The mesh of a field, None where it has no surface, and the metrics of the two."""

    mesh: Mesh | None
    metrics: dict[str, float]


def judge(field: Field, stage: Stage) -> Judgement:
    """Compares a field with a scene's truth: surface samples of both, and the images in the scene's view.

    A field means nothing outside the unit sphere, where no prior was trained: it is cut off there.
    """
    truth = stage.scene.view
    mesh, metrics = _compare(field, stage)
    seen = look(field, truth.camera, stage)
    metrics |= image_metrics(seen.depth.numpy(), seen.mask.numpy(), truth.depth.numpy(), truth.mask.numpy())
    return Judgement(mesh, metrics)


def glance(field: Field, stage: Stage) -> float:
    """The field's `chamfer_l2`, as `judge` has it, and nothing else: for looks on the way."""
    return _compare(field, stage)[1]["chamfer_l2"]


def _compare(field: Field, stage: Stage) -> tuple[Mesh | None, dict[str, float]]:
    inside = Shape(field, field.kind) & sphere(1.0)
    mesh = extract(inside, grid=stage.evaluation.grid, reach=REACH, device=stage.device)
    found = None if mesh is None else Surface(*sample_surface(mesh, stage.evaluation.points, stage.seed + 1))
    truth = true_surface(stage, stage.seed)
    return mesh, surface_metrics(found, truth, threshold=stage.evaluation.fscore_threshold)


def true_surface(stage: Stage, seed: int) -> Surface:
    """Samples of the truth, as many as metrics take."""
    return Surface(*sample_surface(stage.scene.mesh, stage.evaluation.points, seed))


def look(field: Field, camera: Camera, stage: Stage) -> View:
    """What a camera sees of a field through the run's renderer, as a View on the CPU."""
    with torch.no_grad():
        rendering = stage.renderer.render(field, camera.rays().to(stage.device))
    normals = torch.zeros_like(rendering.points)
    normals[rendering.hit] = autograd_normals(field, rendering.points[rendering.hit])
    depth = camera.depth(rendering.distance.cpu()) * rendering.hit.cpu()
    return View(camera, depth, normals.cpu(), rendering.hit.cpu())
