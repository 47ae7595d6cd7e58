"""The images of a run as arrays, for the report to draw: what was found, and what is true."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from datasets.scene import View


def save_images(folder: Path, found: View, true: View, **more: np.ndarray) -> None:
    """Writes `folder/images.npz`: normals of both [h, w, 3], hits of both and the depth error [h, w], and `more`."""
    arrays = {
        "normals": picture_normals(found).half(),
        "reference_normals": picture_normals(true).half(),
        "hit": found.mask,
        "reference_hit": true.mask,
        "depth_error": torch.where(found.mask & true.mask, (found.depth - true.depth).abs(), torch.nan),
    }
    plain = {name: array.numpy() for name, array in arrays.items()}
    np.savez_compressed(folder / "images.npz", **plain, **more)  # type: ignore[arg-type]


def picture_normals(view: View) -> Float[Tensor, "height width 3"]:
    """Normals with axes to the right, up and towards the camera, as pictures show them."""
    rotation = view.camera.world_to_camera[:3, :3].to(view.normals.dtype)
    return (view.normals @ rotation.T) * torch.tensor([1, -1, -1])
