"""A field at one moment of a run: its mesh, what cameras see of it, and its colours. Never within a timed phase."""

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
from renderers.field import Field, autograd_gradients, values_and_gradients
from renderers.fields.analytic import Shape, sphere
from renderers.fields.coloured import Coloured

GREY = 0.5  # of a mesh without colours
CHUNK = 16_384  # points whose colours are asked for at once
REACH = 1.05  # half the side of the sampled cube: the unit sphere and a margin
LEAST_COSINE = 0.05  # between a ray and the surface: flatter hits stay on the mesh


@dataclass(frozen=True)
class State:
    """A field at one moment of a run; metrics, frames and pictures share its mesh, which is extracted once.

    Args:
        field: of the moment, which does not change later. Its evaluations are not counted.
        inputs: of the run.
    """

    field: Field
    inputs: RunInputs

    @property
    def inside(self) -> Shape:
        """The field cut off at the unit sphere, since no prior was trained outside it."""
        return Shape(self.field, self.field.kind) & sphere(1.0)

    @cached_property
    def mesh(self) -> Mesh | None:
        """The surface within the unit sphere; None where there is none."""
        return extract(self.inside, grid=self.inputs.evaluation.grid, reach=REACH, device=self.inputs.device)

    @cached_property
    def cast_on(self) -> Truth | None:
        """The mesh, for ray casting."""
        return None if self.mesh is None else Truth(self.mesh, closed=False)

    @property
    def spacing(self) -> float:
        """Scene units between two samples of the field that give the mesh."""
        return 2 * REACH / (self.inputs.evaluation.grid - 1)

    def seen(self, camera: Camera) -> View:
        """What a camera sees of the mesh, by exact first hits."""
        return unseen(camera) if self.cast_on is None else see(self.cast_on, camera)

    def pictured(self, camera: Camera) -> View:
        """What pictures show: the hits of the mesh, a Newton step nearer to the field's surface, with its normals."""
        view = self.seen(camera)
        rays = view.camera.rays()[view.mask].to(self.inputs.device)
        distance = view.camera.distance(view.depth)
        moved, gradients = newton_step(self.inside, rays, distance[view.mask].to(rays.origins), self.spacing)
        distance[view.mask], normals = moved.cpu(), torch.zeros_like(view.normals)
        normals[view.mask] = torch.nn.functional.normalize(gradients, dim=-1).cpu()
        return replace(view, depth=view.camera.depth(distance), normals=normals)

    def colours(self, view: View) -> Float[Tensor, "height width 3"] | None:
        """The colours of what a view shows; None of a field without colours."""
        return coloured_image(self.field, view, self.inputs.device) if isinstance(self.field, Coloured) else None


def newton_step(
    field: Field, rays: Rays, distance: Float[Tensor, " n"], longest: float
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Moves hits along their rays towards the field's surface; gives the new distances, and gradients at the old ones.

    Args:
        longest: most that a hit is moved, in scene units. One that grazes the surface, or has no number, is not moved.
    """
    values, gradients = values_and_gradients(field, rays.at(distance))
    slopes = (gradients * rays.directions).sum(-1)
    steep = slopes < -LEAST_COSINE * gradients.norm(dim=-1)
    steps = (-values / torch.where(steep, slopes, -1.0)).nan_to_num(0.0).clamp(-longest, longest)
    return distance + torch.where(steep, steps, 0.0), gradients.nan_to_num(0.0)


def unseen(camera: Camera) -> View:
    """The view of a camera that sees no surface."""
    shape = camera.height, camera.width
    return View(camera, torch.zeros(shape), torch.zeros(*shape, 3), torch.zeros(shape, dtype=torch.bool))


def coloured_image(field: Coloured, view: View, device: torch.device) -> Float[Tensor, "height width 3"]:
    """The field's colours where a view meets a surface; black elsewhere."""
    image = torch.zeros(*view.mask.shape, 3)
    rays = view.camera.rays()[view.mask]
    points = rays.at(view.camera.distance(view.depth)[view.mask])
    image[view.mask] = colours_at(field, points, rays.directions, device)
    return image


def painted(mesh: Mesh, truth: Truth, camera: Camera) -> Float[np.ndarray, "height width 3"]:
    """The colours of a mesh's vertices, interpolated over its faces; grey without colours, black outside of it."""
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
