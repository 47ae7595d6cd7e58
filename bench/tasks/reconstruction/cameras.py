"""Wrong cameras of photographs, and cameras that are learnt with the shape."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bench.tasks.pose import pose_error
from bench.tasks.reconstruction.pixels import Pixels
from datasets.files.captures.exports import write_transforms
from datasets.files.captures.sphere import in_world
from datasets.shot import Shot
from renderers.camera import Camera, Rays, rigid

GIVEN, REFINE = "given", "refine"
CHOICES = (GIVEN, REFINE)
MOTION_PER_PARAMETER = 0.1  # scene units and radians: cameras move slower than the field at the same learning rate
DEFINITIONS = {
    "camera_error_deg": "mean angle of the rotation between a photograph's camera and the true one, in degrees, over "
    "the input photographs but the first, whose camera is fixed",
    "camera_error": "mean distance of the object's origin in the coordinates of the two cameras, in scene units",
}


def disturbed(shots: Sequence[Shot], degrees: float, seed: int) -> tuple[Shot, ...]:
    """The photographs with wrong cameras: each but the first is turned about a random axis through the origin."""
    axes = torch.randn(len(shots), 3, generator=torch.Generator().manual_seed(seed))
    turns = radians(degrees) * torch.nn.functional.normalize(axes, dim=-1)
    twists = torch.cat([torch.zeros_like(turns), turns], dim=-1)
    wrong = [
        replace(shot, camera=shot.camera.with_object_moved(twist)) for shot, twist in zip(shots, twists, strict=True)
    ]
    return (shots[0], *wrong[1:])


@dataclass
class CameraMotions:
    """Six numbers for each photograph but the first: a rigid motion of the object that its camera sees.

    Args:
        shots: the input photographs, with the cameras from which the optimisation starts.
        true: the cameras that errors are measured against; None measures none.
        learnt: whether the motions are optimised; else they stay 0.
    """

    shots: Sequence[Shot]
    true: Sequence[Camera] | None
    learnt: bool
    device: torch.device

    def __post_init__(self) -> None:
        self.numbers = torch.zeros(len(self.shots) - 1, 6, device=self.device, requires_grad=self.learnt)

    @property
    def twists(self) -> Float[Tensor, "photographs 6"]:
        """The motions, see `renderers.camera.rigid`; 0 for the first photograph."""
        return MOTION_PER_PARAMETER * torch.nn.functional.pad(self.numbers, (0, 0, 1, 0))

    @property
    def cameras(self) -> list[Camera]:
        """The current cameras, on the CPU."""
        twists = self.twists.detach().cpu()
        return [shot.camera.with_object_moved(twist) for shot, twist in zip(self.shots, twists, strict=True)]

    def apply(self, pixels: Pixels) -> Pixels:
        """The pixels with the rays of the moved cameras; gradients flow to the numbers."""
        return replace(pixels, rays=moved(pixels.rays, self.twists, pixels.photograph)) if self.learnt else pixels

    def save(self, path: Path, to_world: Float[np.ndarray, "4 4"] | None) -> None:
        """Writes the current cameras as NeRF's JSON, in the photographs' world or, for a rendered scene, in its own."""
        world = np.linalg.inv(np.eye(4) if to_world is None else to_world)
        shots = [replace(shot, camera=camera) for shot, camera in zip(self.shots, self.cameras, strict=True)]
        write_transforms([in_world(shot, world) for shot in shots], path)

    def errors(self) -> dict[str, float]:
        """The errors of the cameras; empty without true ones."""
        if self.true is None:
            return {}
        errors = [pose_error(*pair) for pair in zip(self.cameras, self.true, strict=True)][1:]
        return dict(zip(DEFINITIONS, torch.tensor(errors).mean(0).tolist(), strict=True))


def moved(rays: Rays, twists: Float[Tensor, "photographs 6"], photograph: Int[Tensor, " n"]) -> Rays:
    """Rays [n, ...] after each camera saw the object moved by its twist, see `Camera.with_object_moved`."""
    photograph = photograph.view(-1, *[1] * (len(rays.shape) - 1)).expand(rays.shape)
    back = torch.linalg.inv(rigid(twists))[photograph]
    turn = back[..., :3, :3]
    origins = (turn @ rays.origins[..., None])[..., 0] + back[..., :3, 3]
    return Rays(origins, torch.nn.functional.normalize((turn @ rays.directions[..., None])[..., 0], dim=-1))
