"""Views for pictures: hits of a mesh, moved to the surface of the field that it was extracted from."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.state import State
from datasets.scene import View
from renderers.camera import Camera, Rays
from renderers.field import Field, values_and_gradients

MIN_COSINE = 0.05  # between a ray and the normal: hits at a smaller one stay on the mesh


def refined_view(state: State, camera: Camera) -> View:
    """The view for pictures: hits of the mesh, moved to the field's surface by a Newton step, with its normals."""
    view = state.view_from(camera)
    rays = view.camera.rays()[view.mask].to(state.inputs.device)
    distance = view.camera.distance(view.depth)
    on_mesh = distance[view.mask].to(rays.origins)
    on_surface, gradients = newton_step(state.clipped_field, rays, on_mesh, state.spacing)
    distance[view.mask], normals = on_surface.cpu(), torch.zeros_like(view.normals)
    normals[view.mask] = torch.nn.functional.normalize(gradients, dim=-1).cpu()
    return replace(view, depth=view.camera.depth(distance), normals=normals)


def newton_step(
    field: Field, rays: Rays, distance: Float[Tensor, " n"], longest: float
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Moves hits along their rays to the field's surface. Returns the new distances, and gradients at the old ones.

    Args:
        longest: maximum step, in scene units. Grazing hits, and hits with a non-finite value, are not moved.
    """
    values, gradients = values_and_gradients(field, rays.at(distance))
    slopes = (gradients * rays.directions).sum(-1)
    steep = slopes < -MIN_COSINE * gradients.norm(dim=-1)
    steps = (-values / torch.where(steep, slopes, -1.0)).nan_to_num(0.0).clamp(-longest, longest)
    return distance + torch.where(steep, steps, 0.0), gradients.nan_to_num(0.0)
