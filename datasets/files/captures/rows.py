"""Cameras as rows of numbers, one row per image: Middlebury, LLFF, BlendedMVS, and Choy's renderings of ShapeNet."""

from collections.abc import Sequence
from math import cos, radians, sin
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datasets.files.captures.frames import OPENGL, Frame, Layout, homogeneous_matrix, rigid_matrix, shift_pixels
from datasets.files.captures.image import image_size
from datasets.files.captures.pairing import (
    find_images,
    find_masks,
    first_images,
    images_in,
    pair_by_name,
    pair_by_order,
    unpaired_note,
)
from renderers.checks import BadInput


def read_middlebury(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """Middlebury: one line per image: its name, K, R and t, row by row."""
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


def read_llff(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """LLFF: one row per image, in string order: camera_to_world (axes down, right, back), size, focal, depth range."""
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


def read_blended_mvs(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """BlendedMVS and MVSNet: one file per image: world_to_camera, K, and the depth range."""
    cameras = {file.name[: -len("_cam.txt")]: file for file in files}
    images = first_images(folder, "blended_images", "images")
    images = {name: file for name, file in images.items() if not file.stem.endswith("_masked")}
    pairs = pair_by_name(cameras, images)
    if lacking := [name for name in images if name not in pairs.values()]:
        raise BadInput(f"{images[lacking[0]]} has no camera: there is no cams/{Path(lacking[0]).stem}_cam.txt")
    masks, mask_notes = find_masks(folder, images if masked else {})
    frames = [_mvs_frame(cameras[name], images[image], masks.get(image)) for name, image in pairs.items()]
    notes = (*mask_notes, *unpaired_note("image", [name for name in cameras if name not in pairs]))
    return Layout("BlendedMVS", tuple(frames), None, notes, example_image=next(iter(cameras), ""))


def _mvs_frame(file: Path, image: Path, mask: Path | None) -> Frame:
    words = file.read_text().split()
    if len(words) < 29 or words[0] != "extrinsic" or words[17] != "intrinsic":
        raise BadInput(f"{file} must have `extrinsic`, 16 numbers, `intrinsic`, 9 numbers and depths: copy it again")
    extrinsics, intrinsics = (np.array(numbers, dtype=np.float64) for numbers in (words[1:17], words[18:27]))
    world_to_camera = homogeneous_matrix(extrinsics.reshape(4, 4), f"{file}, extrinsic")
    near, step, *rest = map(float, words[27:])
    far = rest[1] if len(rest) > 1 else near + step * (rest[0] if rest else 192)
    return Frame(image, intrinsics.reshape(3, 3), world_to_camera, mask, depth_range=(near, far))


FOCAL_MILLIMETRES, SENSOR_MILLIMETRES, DISTANCE_UNIT = 35.0, 32.0, 1.75  # Choy's camera in Blender


def read_choy(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """Choy's renderings: one line per image: azimuth, elevation, roll, distance, field of view."""
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
