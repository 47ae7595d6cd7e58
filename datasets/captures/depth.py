"""Files of depths, such as an EXR."""

import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from datasets.extras import install_command
from renderers.checks import BadInput


def depths_at(path: Path, unit: float, size: tuple[int, int]) -> Float[Tensor, "height width"]:
    """Camera z of the nearest pixel of a file of depths, 0 where it is not known; raises as `stored_depths` does."""
    depths = stored_depths(path, "remove the folder of depths")
    measured = np.isfinite(depths) & (depths > 0)
    image = Image.fromarray(np.where(measured, depths * unit, 0).astype(np.float32))
    return torch.from_numpy(np.array(image.resize(size, Image.Resampling.NEAREST)))


def stored_depths(path: Path, otherwise: str) -> Float[np.ndarray, "height width"]:
    """The first channel of a file of depths, such as an EXR, as OpenCV reads it.

    Args:
        otherwise: what else can be done where it cannot be read.

    Raises:
        BadInput: where OpenCV is not installed, or the file cannot be read.
    """
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # OpenCV reads it with the first file
    try:
        import cv2
    except ImportError as error:
        raise BadInput(f"{path} is read by OpenCV: {install_command('stereo')}, or {otherwise}") from error
    try:
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        stored = None
    if stored is None:
        raise BadInput(f"{path} cannot be read as depths: copy it again, or {otherwise}")
    return stored.reshape(*stored.shape[:2], -1)[..., 0].astype(np.float64)
