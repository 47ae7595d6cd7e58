"""A field at one moment of a run: its mesh and its views. Never computed within a timed phase."""

from dataclasses import dataclass
from functools import cached_property

import torch

from bench.setup.inputs import RunInputs
from datasets.mesh import Mesh, extract
from datasets.scene import Truth, View, see
from renderers.camera import Camera
from renderers.field import Field
from renderers.fields.analytic import Shape, sphere

REACH = 1.05  # scene units, half the side of the sampled cube: the unit sphere and a margin


@dataclass(frozen=True)
class State:
    """A field at one moment of a run; metrics, frames and pictures share its mesh, which is extracted once.

    Args:
        field: must not change later. Its evaluations are not counted.
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
        return None if self.mesh is None else Truth(self.mesh, closed=False)

    @property
    def spacing(self) -> float:
        """Scene units between two samples of the grid from which the mesh is extracted."""
        return 2 * REACH / (self.inputs.evaluation.grid - 1)

    def view_from(self, camera: Camera) -> View:
        """The mesh as a camera sees it, by exact first hits."""
        return empty_view(camera) if self.raycaster is None else see(self.raycaster, camera)


def empty_view(camera: Camera) -> View:
    """The view of a camera that sees no surface."""
    shape = camera.height, camera.width
    return View(camera, torch.zeros(shape), torch.zeros(*shape, 3), torch.zeros(shape, dtype=torch.bool))
