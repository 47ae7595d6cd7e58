"""Colours of fields and meshes: at points, at vertices and in images, and their error against a texture."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.evaluate import render_with_view
from bench.evaluate.state import State
from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh
from datasets.scene import Truth, View
from renderers.camera import Camera
from renderers.field import Coloured, Counts, gradients_at

DEFAULT_VERTEX_COLOUR = 0.5
POINTS_PER_BATCH = 16_384


def evaluate_colours(state: State) -> tuple[dict[str, float], Mesh | None]:
    """The metrics of `COLOUR_DEFINITIONS` of a field with colours, and its mesh with colours; see `evaluate`."""
    surface, texture, device = state.inputs.true_surface, state.inputs.scene.texture, state.inputs.device
    colours = colours_at(state.field, torch.from_numpy(surface.points).float(), None, device).numpy()
    error = float(np.abs(colours - texture(surface.points, surface.normals)).mean())
    mesh = state.mesh and replace(state.mesh, colours=vertex_colours(state.field, state.mesh, device))
    return {"colour_error": error}, mesh


def colours_in_view(state: State, view: View) -> Float[Tensor, "height width 3"] | None:
    """The colours of a view's pixels; None for a field without colours."""
    return coloured_image(state.field, view, state.inputs.device) if isinstance(state.field, Coloured) else None


def render_image(
    field: Coloured, camera: Camera, inputs: RunInputs, counts: Counts | None = None
) -> tuple[View, Float[Tensor, "height width 3"]]:
    """The hits as a View, and the colours of the surface or of the volume; see `render_with_view`."""
    rendering, view = render_with_view(field, camera, inputs, counts)
    volume = rendering.volume
    if volume is None:
        return view, coloured_image(field, view, inputs.device)
    rays = camera.rays().flat().to(inputs.device)
    ray = rays[volume.ray]
    colours = colours_at(field, ray.at(volume.distance), ray.directions, inputs.device).to(inputs.device)
    return view, volume.weighted_sum(colours, len(rays.origins)).view(*view.mask.shape, 3).cpu()


def coloured_image(field: Coloured, view: View, device: torch.device) -> Float[Tensor, "height width 3"]:
    """The field's colours at the hits of a view; black elsewhere."""
    image = torch.zeros(*view.mask.shape, 3)
    rays = view.camera.rays()[view.mask]
    points = rays.at(view.camera.distance(view.depth)[view.mask])
    image[view.mask] = colours_at(field, points, rays.directions, device)
    return image


def render_vertex_colours(mesh: Mesh, truth: Truth, camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """The vertex colours of a mesh, interpolated over its faces; grey if it has no colours, black outside of it."""
    colours = np.full_like(mesh.vertices, DEFAULT_VERTEX_COLOUR) if mesh.colours is None else mesh.colours
    rays = camera.rays()
    weights, corners = truth.corners(rays.flat().origins.double().numpy(), rays.flat().directions.double().numpy())
    return np.einsum("nk,nkd->nd", weights, colours[corners]).reshape(*rays.shape, 3).clip(0, 1)


def vertex_colours(field: Coloured, mesh: Mesh, device: torch.device) -> Float[np.ndarray, "v 3"]:
    """The colours of a mesh's vertices, each seen along its normal."""
    return colours_at(field, torch.from_numpy(mesh.vertices).float(), None, device).numpy()


def colours_at(
    field: Coloured, points: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"] | None, device: torch.device
) -> Float[Tensor, "n 3"]:
    """The colours of points of the surface, on the CPU; without directions each is seen along its normal."""
    colours = [points.new_zeros(0, 3)]
    for start in range(0, len(points), POINTS_PER_BATCH):
        chunk = points[start : start + POINTS_PER_BATCH].to(device)
        gradients = gradients_at(field, chunk, graph=False).detach()
        inwards = -torch.nn.functional.normalize(gradients, dim=-1)
        view_directions = inwards if directions is None else directions[start : start + POINTS_PER_BATCH].to(device)
        with torch.no_grad():
            colours.append(field.colours(chunk, gradients, view_directions).cpu())
    return torch.cat(colours)
