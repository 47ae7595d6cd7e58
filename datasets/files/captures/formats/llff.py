"""LLFF: one row per image in `poses_bounds.npy`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datasets.files.captures.frames import Format, Frame, Layout, rigid_matrix
from datasets.files.captures.pairing import find_masks, first_images, pair_by_order
from renderers.checks import BadInput


def read_layout(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """One row per image, in string order: camera_to_world (axes down, right, back), size, focal, depth range."""
    file = files[0]
    rows, images = np.load(file), first_images(folder, "images", "images_2", "images_4", "images_8")
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise BadInput(f"{file} must have a row of 17 numbers for each image, found shape {list(rows.shape)}")
    names, notes = pair_by_order(images, len(rows), file.name)
    masks, mask_notes = find_masks(folder, images if masked else {})

    def frame(i: int, name: str) -> Frame:
        down, right, back, centre, (height, width, focal) = rows[i, :15].reshape(3, 5).T
        rotation = np.stack([right, down, -back])
        intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        world_to_camera = rigid_matrix(rotation, -rotation @ centre)
        near, far = map(float, rows[i, 15:])
        size = int(height), int(width)
        return Frame(images[name], intrinsics, world_to_camera, masks.get(name), size, depth_range=(near, far))

    frames = tuple(frame(i, name) for i, name in enumerate(names))
    return Layout("LLFF", frames, None, (*notes, *mask_notes), example_image="images/*")


FORMAT = Format("LLFF", 40, ("poses_bounds.npy",), "poses_bounds.npy with images/ (LLFF)", read_layout)
