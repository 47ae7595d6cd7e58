"""A photograph with its camera, rendered or real."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from datasets.scene import Split
from renderers.camera import Camera


def mask_iou(found: Bool[np.ndarray, "h w"], true: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union of two masks; 1 where both are empty."""
    common, either = found & true, found | true
    return float(common.sum() / either.sum()) if either.any() else 1.0


@dataclass(frozen=True)
class Shot:
    """A photograph with its camera.

    Args:
        name: of its file, or its number.
        camera: its resolution is the photograph's.
        colours: RGB from 0 to 1.
        mask: true on the object; None where it is not known.
        depth: camera z in scene units, 0 where it is not known; None where it is known nowhere.
        normals: unit, in world coordinates, 0 where they are not known; None where they are known nowhere.
    """

    name: str
    camera: Camera
    colours: Float[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"] | None
    depth: Float[Tensor, "height width"] | None = None
    normals: Float[Tensor, "height width 3"] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for name in ("colours", "mask", "depth", "normals"):
            part = getattr(self, name)
            if part is not None and tuple(part.shape[:2]) != size:
                raise ValueError(f"{name} must have the camera's size, {size}, not {tuple(part.shape[:2])}")

    def allows(self, points: Float[Tensor, "n 3"], margin: float = 0.0) -> Bool[Tensor, " n"]:
        """Which points of the world its mask allows: those that are not shown, or at most `margin` pixels outside."""
        allowed = torch.ones(len(points), dtype=torch.bool)
        if self.mask is not None:
            points = points.to(self.camera.intrinsics.dtype)
            shown, (height, width) = self.camera.shows(points), self.mask.shape
            columns, rows = self.camera.project(points[shown])[0].long().unbind(-1)
            mask = distance_transform_edt(~self.mask.numpy()) <= margin if margin else self.mask.numpy()
            allowed[shown] = torch.from_numpy(mask)[rows.clamp(max=height - 1), columns.clamp(max=width - 1)]
        return allowed

    def within(self, to_world: Float[np.ndarray, "4 4"]) -> "Shot":
        """The same photograph, in single precision, in a world from which this similarity leads to its own."""
        depth = None if self.depth is None else self.depth / float(np.linalg.norm(to_world[:3, 0]))
        return replace(self, camera=camera_within(self.camera, to_world), depth=depth)


def camera_within(camera: Camera, to_world: Float[np.ndarray, "4 4"]) -> Camera:
    """A camera, in single precision, in a world from which a similarity leads to its own."""
    motion = camera.world_to_camera.double() @ torch.from_numpy(to_world)
    motion[:3] /= float(np.linalg.norm(to_world[:3, 0]))
    return replace(camera, intrinsics=camera.intrinsics.float(), world_to_camera=motion.float())


@runtime_checkable
class Pictured(Protocol):
    """A dataset with images of its shapes that others rendered."""

    def shots(self, split: Split, index: int, longest: int) -> tuple[Shot, ...] | None:
        """The images of a shape, with cameras in the world of its mesh and at most so many pixels; None without any."""
        ...
