"""Middlebury: one line per image in `*_par.txt`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from datasets.files.captures.frames import Format, Frame, Layout, rigid_matrix, shift_pixels
from datasets.files.captures.pairing import find_images, find_masks, images_in, unpaired_note
from renderers.checks import BadInput


def read_layout(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """One line per image: its name, K, R and t, row by row."""
    cameras = {}
    for line in filter(str.strip, files[0].read_text().splitlines()):
        if line.strip().isdecimal():  # the number of images
            continue
        name, *numbers = line.rsplit(maxsplit=21)
        if len(numbers) != 21:
            raise BadInput(f"{files[0]}: the line of {name} must have 21 numbers, not {len(numbers)}: copy it again")
        if name in cameras:
            raise BadInput(f"{files[0]} has {name} twice: name each image once")
        values = np.array(numbers, dtype=np.float64)
        cameras[name] = shift_pixels(values[:9].reshape(3, 3)), rigid_matrix(values[9:18].reshape(3, 3), values[18:])
    images, path_notes = find_images([*cameras], folder)
    files_by_name = {file.name: file for file in images.values()}
    if lacking := [name for name in images_in(folder) if name not in files_by_name]:
        raise BadInput(f"{folder / lacking[0]} has no camera: {files[0].name} has no line for it; remove the image")
    masks, mask_notes = find_masks(folder, files_by_name if masked else {})
    frames = tuple(Frame(file, *cameras[name], masks.get(file.name)) for name, file in images.items())
    notes = (*path_notes, *mask_notes, *unpaired_note("image", [name for name in cameras if name not in images]))
    return Layout("Middlebury", frames, None, notes, example_image=next(iter(cameras), ""))


FORMAT = Format("Middlebury", 30, ("*_par.txt",), "*_par.txt (Middlebury)", read_layout)
