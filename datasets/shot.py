"""A photograph with its camera, rendered or real."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Camera


def mask_iou(predicted: Bool[np.ndarray, "h w"], true: Bool[np.ndarray, "h w"]) -> float:
    """Intersection over union of two masks; 1 if both are empty."""
    common, either = predicted & true, predicted | true
    return float(common.sum() / either.sum()) if either.any() else 1.0


@dataclass(frozen=True)
class Shot:
    """A photograph with its camera.

    Args:
        name: of its file, or its number.
        camera: its resolution is the photograph's.
        colours: RGB from 0 to 1.
        mask: true on the object; None if it is unknown.
        depth: camera z in scene units, 0 at pixels of unknown depth; None without any depth.
        normals: unit, in world coordinates, 0 at pixels of unknown normal; None without any normal.
        covered: the fraction of each pixel on the object; None if it is unknown.
    """

    name: str
    camera: Camera
    colours: Float[Tensor, "height width 3"]
    mask: Bool[Tensor, "height width"] | None
    depth: Float[Tensor, "height width"] | None = None
    normals: Float[Tensor, "height width 3"] | None = None
    covered: Float[Tensor, "height width"] | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        for name in ("colours", "mask", "depth", "normals", "covered"):
            image = getattr(self, name)
            if image is not None and tuple(image.shape[:2]) != size:
                raise ValueError(f"{name} must have the camera's size, {size}, not {tuple(image.shape[:2])}")
