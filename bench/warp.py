"""What one camera saw, as another sees it: projection, and bilinear sampling that never reads outside the image."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Camera


def project(
    camera: Camera, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Where a camera sees points of the world.

    Returns:
        pixels: column and row; the first pixel's centre is (0.5, 0.5). Without meaning behind the camera.
        depth: camera z, in scene units; 0 or less behind the camera.
    """
    motion = camera.world_to_camera
    seen = points @ motion[:3, :3].T + motion[:3, 3]
    depth = seen[..., 2]
    plane = seen / torch.where(depth > 0, depth, 1.0)[..., None]
    return (plane @ camera.intrinsics.T)[..., :2], depth


def sample(
    image: Float[Tensor, "height width channels"], pixels: Float[Tensor, "*batch 2"]
) -> tuple[Float[Tensor, "*batch channels"], Bool[Tensor, "*batch"]]:
    """An image between the centres of its pixels.

    Returns:
        colours: 0 where `pixels` lie beyond the outermost centres, so that nothing outside the image is made up.
        inside: false there.
    """
    height, width, _ = image.shape
    inside = (pixels >= 0.5).all(-1) & (pixels[..., 0] <= width - 0.5) & (pixels[..., 1] <= height - 0.5)
    place = torch.where(inside[..., None], pixels, 0.5) - 0.5
    last = torch.tensor([max(width - 2, 0), max(height - 2, 0)], dtype=place.dtype, device=place.device)
    low = torch.minimum(place.detach().floor(), last)
    across, down = (place - low)[..., :1], (place - low)[..., 1:]
    column, row = low.long().unbind(-1)
    right, below = (column + 1).clamp_max(width - 1), (row + 1).clamp_max(height - 1)
    upper = image[row, column] * (1 - across) + image[row, right] * across
    lower = image[below, column] * (1 - across) + image[below, right] * across
    return (upper * (1 - down) + lower * down) * inside[..., None], inside
