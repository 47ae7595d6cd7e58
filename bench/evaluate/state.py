"""A field at one moment of a run: its mesh and its views. Never computed within a timed phase."""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh, extract
from datasets.scene import Truth, View, see
from renderers.camera import Camera, Rays
from renderers.field import Field, values_and_gradients
from renderers.fields.analytic import Shape, sphere

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
