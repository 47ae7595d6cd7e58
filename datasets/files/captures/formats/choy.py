"""Choy's renderings of ShapeNet: one line per image in `rendering_metadata.txt`."""

from collections.abc import Sequence
from math import cos, radians, sin
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datasets.files.captures.frames import OPENGL, Format, Frame, Layout, rigid_matrix
from datasets.files.captures.image import image_size
from datasets.files.captures.pairing import images_in, pair_by_order
from renderers.checks import BadInput

FOCAL_MILLIMETRES, SENSOR_MILLIMETRES, DISTANCE_UNIT = 35.0, 32.0, 1.75  # Choy's camera in Blender


def read_layout(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """One line per image: azimuth, elevation, roll, distance, field of view."""
    rows = np.loadtxt(files[0], ndmin=2)
    if rows.shape[1] < 4 or rows[:, 2].any():
        raise BadInput(f"{files[0]} must have azimuth, elevation, a roll of 0, and distance in each line")
    images = images_in(files[0].parent)

    def frame(i: int, name: str) -> Frame:
        width, height = image_size(images[name])
        focal = FOCAL_MILLIMETRES / SENSOR_MILLIMETRES * width
        intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        return Frame(images[name], intrinsics, _from_angles(rows[i, 0], rows[i, 1], rows[i, 3] * DISTANCE_UNIT), None)

    names, notes = pair_by_order(images, len(rows), files[0].name)
    return Layout("Choy", tuple(frame(i, name) for i, name in enumerate(names)), None, notes, example_image="*.png")


def _from_angles(azimuth: float, elevation: float, distance: float) -> Float[np.ndarray, "4 4"]:
    """world_to_camera of a camera that looks at the origin; z is up, angles are in degrees, azimuth from x to -y."""
    across, up = radians(-azimuth), radians(elevation)
    back = np.array([cos(up) * cos(across), cos(up) * sin(across), sin(up)])
    right = np.array([-sin(across), cos(across), 0.0])
    rotation = np.stack([right, np.cross(back, right), back])
    return OPENGL @ rigid_matrix(rotation, np.array([0, 0, -distance]))


FORMAT = Format(
    "Choy",
    70,
    ("rendering_metadata.txt", "rendering/rendering_metadata.txt"),
    "rendering_metadata.txt (Choy)",
    read_layout,
)
