"""A field at one moment of a run: its mesh, its views and its colours. Never computed within a timed phase."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh, extract
from datasets.scene import Truth, View, see
from renderers.camera import Camera, Rays
from renderers.field import Coloured, Field, autograd_gradients, values_and_gradients
from renderers.fields.analytic import Shape, sphere

DEFAULT_VERTEX_COLOUR = 0.5
POINTS_PER_BATCH = 16_384
REACH = 1.05  # scene units, half the side of the sampled cube: the unit sphere and a margin
MIN_COSINE = 0.05  # between a ray and the normal: hits at a smaller one stay on the mesh


@dataclass(frozen=True)
class State:
    """A field at one moment of a run; metrics, frames and pictures share its mesh, which is extracted once.

    Args:
        field: must not change later. Its evaluations are not counted.
        inputs: of the run.
    """

    field: Field
    inputs: RunInputs

    @property
    def clipped_field(self) -> Shape:
        """The field's intersection with the unit sphere, since no prior was trained outside it."""
        return Shape(self.field, self.field.kind) & sphere(1.0)

    @cached_property
    def mesh(self) -> Mesh | None:
        """The surface within the unit sphere; None if there is no surface."""
        return extract(self.clipped_field, grid=self.inputs.evaluation.grid, reach=REACH, device=self.inputs.device)

    @cached_property
    def raycaster(self) -> Truth | None:
        """The mesh, for ray casting."""
        return None if self.mesh is None else Truth(self.mesh, closed=False)

    @property
    def spacing(self) -> float:
        """Scene units between two samples of the grid from which the mesh is extracted."""
        return 2 * REACH / (self.inputs.evaluation.grid - 1)

    def view_from(self, camera: Camera) -> View:
        """The mesh as a camera sees it, by exact first hits."""
        return empty_view(camera) if self.raycaster is None else see(self.raycaster, camera)

    def refined_view(self, camera: Camera) -> View:
        """The view for pictures: hits of the mesh, moved to the field's surface by a Newton step, with its normals."""
        view = self.view_from(camera)
        rays = view.camera.rays()[view.mask].to(self.inputs.device)
        distance = view.camera.distance(view.depth)
        on_mesh = distance[view.mask].to(rays.origins)
        on_surface, gradients = newton_step(self.clipped_field, rays, on_mesh, self.spacing)
        distance[view.mask], normals = on_surface.cpu(), torch.zeros_like(view.normals)
        normals[view.mask] = torch.nn.functional.normalize(gradients, dim=-1).cpu()
        return replace(view, depth=view.camera.depth(distance), normals=normals)

    def colours(self, view: View) -> Float[Tensor, "height width 3"] | None:
        """The colours of a view's pixels; None for a field without colours."""
        return coloured_image(self.field, view, self.inputs.device) if isinstance(self.field, Coloured) else None


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


def empty_view(camera: Camera) -> View:
    """The view of a camera that sees no surface."""
    shape = camera.height, camera.width
    return View(camera, torch.zeros(shape), torch.zeros(*shape, 3), torch.zeros(shape, dtype=torch.bool))


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
        gradients = autograd_gradients(field, chunk)
        inwards = -torch.nn.functional.normalize(gradients, dim=-1)
        view_directions = inwards if directions is None else directions[start : start + POINTS_PER_BATCH].to(device)
        with torch.no_grad():
            colours.append(field.colours(chunk, gradients, view_directions).cpu())
    return torch.cat(colours)
