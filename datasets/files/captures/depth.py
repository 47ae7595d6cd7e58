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


def load_depths(path: Path, unit: float, size: tuple[int, int]) -> Float[Tensor, "height width"]:
    """Camera z of a depth file, resized to width and height `size`, 0 if unknown; raises as `read_depth_file`."""
    depths = read_depth_file(path, "remove the folder of depths")
    measured = np.isfinite(depths) & (depths > 0)
    image = Image.fromarray(np.where(measured, depths * unit, 0).astype(np.float32))
    return torch.from_numpy(np.array(image.resize(size, Image.Resampling.NEAREST)))


def read_depth_file(path: Path, remedy: str) -> Float[np.ndarray, "height width"]:
    """The first channel of a depth file, such as an EXR, read by OpenCV; messages end with `remedy`.

    Raises:
        BadInput: OpenCV is not installed, or the file cannot be read.
    """
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # OpenCV reads this variable with the first file
    try:
        import cv2
    except ImportError as error:
        raise BadInput(f"{path} is read by OpenCV: {install_command('stereo')}, or {remedy}") from error
    try:
        channels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        channels = None
    if channels is None:
        raise BadInput(f"{path} cannot be read as depths: copy it again, or {remedy}")
    return channels.reshape(*channels.shape[:2], -1)[..., 0].astype(np.float64)
