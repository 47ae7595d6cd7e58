"""Cameras in the JSON of NeRF, instant-ngp, nerfstudio and NeuS2."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from math import pi, radians, tan
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from datasets.files.captures.frames import OPENGL, Format, Frame, Layout, homogeneous_matrix, require_key
from datasets.files.captures.image import image_size
from datasets.files.captures.lenses import LENS_KEYS, nerf_lens, unread_keys_note
from datasets.files.captures.pairing import find_images, find_masks, natural_key, unpaired_note
from renderers.checks import BadInput

AXES_BY_FLAG = {"from_na": np.eye(4), "from_mitsuba": np.diag([-1.0, -1.0, 1.0, 1.0])}  # NeuS2's and instant-ngp's
READ_KEYS = {"frames", "file_path", "mask_path", "transform_matrix", "intrinsic_matrix", "w", "h", "cx", "cy"}
READ_KEYS |= {*AXES_BY_FLAG, *LENS_KEYS}
IGNORED_KEYS = {  # they do not change a camera
    *("rotation", "aabb_scale", "aabb", "scale", "offset", "sharpness", "applied_transform", "applied_scale"),
    *("ply_file_path", "depth_file_path", "colmap_im_id", "orientation_override", "auto_scale_poses_override"),
    *("train_filenames", "val_filenames", "test_filenames", "time"),
}
FOCAL_LENGTH_TOLERANCE = 0.02  # largest relative difference between two statements of a focal length


def read_layout(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """Reads camera_to_world, in OpenGL's axes or in the axes of a flag, focal lengths or fields of view, and lenses."""
    shared = json.loads(files[0].read_text(encoding="utf-8-sig"))
    entries = require_key(shared, "frames", str(files[0]))
    if not isinstance(entries, list) or not all(isinstance(frame, dict) for frame in entries):
        raise BadInput(f"{files[0]}: frames must be a list with a table for each image: export it again")
    entries = [{key: value for key, value in frame.items() if value is not None} for frame in entries]
    shared = {key: value for key, value in shared.items() if value is not None}
    where = f"{files[0]}: a frame"
    cameras = {str(require_key(entry, "file_path", where)): _merge_settings(shared, entry) for entry in entries}
    if len(cameras) < len(entries):
        paths = [str(frame["file_path"]) for frame in entries]
        repeated = next(path for path in paths if paths.count(path) > 1)
        raise BadInput(f"{files[0]} has {repeated} twice: name each image once")
    images, path_notes = find_images([*cameras], folder)
    masks, mask_notes = _masks(folder, cameras, images) if masked else ({}, ())
    frames = [_frame(cameras[path], image, masks.get(path), f"{files[0]}, {path}") for path, image in images.items()]
    expected = {*READ_KEYS, *IGNORED_KEYS, *_focal_keys("x"), *_focal_keys("y")}
    key_notes = unread_keys_note(sorted({key for frame in cameras.values() for key in frame} - expected), files[0])
    without_image = [path for path in cameras if path not in images]
    notes = (*key_notes, *path_notes, *mask_notes, *unpaired_note("image", without_image))
    size_keys = {"w", "h", *_focal_keys("x")[1:], *_focal_keys("y")[1:]}
    if any(not size_keys & {*cameras[path]} for path in images):
        notes += (f"{files[0].name} states no w and h: focal lengths are taken for the size of the images",)
    frames = sorted(frames, key=lambda frame: natural_key(frame.image.name))
    times = {str(cameras[path].get("time")) for path in images}
    doubt = f"{files[0].name} has {len(times)} values of time: if the object moves, keep the frames of one time"
    example = next(iter(cameras), "")
    return Layout("NeRF", tuple(frames), None, notes, example_image=example, doubt=doubt if len(times) > 1 else "")


def _masks(
    folder: Path, cameras: Mapping[str, Mapping[str, Any]], images: Mapping[str, Path]
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The masks that frames name, by their images' paths; without any, the masks of a folder `mask`, with a note."""
    named = {path: str(cameras[path]["mask_path"]) for path in images if cameras[path].get("mask_path")}
    if not named:
        files = {file.name: file for file in images.values()}
        by_name, notes = find_masks(folder, files) if len(files) == len(images) else ({}, ())
        note = "the folder of masks is used, though transforms.json does not name it"
        return {path: by_name[file.name] for path, file in images.items() if by_name}, (note, *notes) if by_name else ()
    if repeated := [mask for mask, times in Counter(named.values()).items() if times > 1]:
        raise BadInput(
            f"{repeated[0]} is the mask of several images in transforms.json: name the own mask of each, or none"
        )
    masks, _ = find_images(named.values(), folder)
    if missing := [mask for mask in named.values() if mask not in masks]:
        raise BadInput(f"the mask {missing[0]} that transforms.json names is not in {folder}: add it, or use no masks")
    return {path: masks[mask] for path, mask in named.items()}, ()


def _merge_settings(shared: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """The settings of a frame: its own, and shared ones except focal lengths that the frame states in another way."""
    stated_axes = {axis for axis in "xy" for key in _focal_keys(axis) if key in frame}
    overridden = {key for axis in ("xy" if "intrinsic_matrix" in frame else stated_axes) for key in _focal_keys(axis)}
    overridden |= {"intrinsic_matrix"} if stated_axes else set()
    return {key: value for key, value in shared.items() if key not in overridden} | frame


def _focal_keys(axis: str) -> tuple[str, str, str]:
    return f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"


def _frame(settings: dict[str, Any], image: Path, mask: Path | None, where: str) -> Frame:
    """The frame of one image from its merged settings."""
    lens = nerf_lens(settings, where)
    has_size = {"w", "h"} & set(settings)
    stated = (int(require_key(settings, "h", where)), int(require_key(settings, "w", where))) if has_size else None
    width, height = image_size(image) if stated is None else stated[::-1]
    matrix = np.asarray(require_key(settings, "transform_matrix", where), dtype=np.float64)
    axes = next((axes for flag, axes in AXES_BY_FLAG.items() if settings.get(flag)), OPENGL)
    world_to_camera = axes @ np.linalg.inv(homogeneous_matrix(matrix, f"{where}: transform_matrix"))
    return Frame(image, _intrinsics(settings, width, height, where), world_to_camera, mask, stated, lens)


def _intrinsics(settings: Mapping[str, Any], width: int, height: int, where: str) -> Float[np.ndarray, "3 3"]:
    """Intrinsics from a matrix, from focal lengths, or from fields of view."""
    matrix = np.asarray(settings["intrinsic_matrix"], dtype=np.float64) if "intrinsic_matrix" in settings else None
    if matrix is not None and matrix.shape not in ((3, 3), (3, 4), (4, 4)):
        raise BadInput(f"{where}: intrinsic_matrix must be 3 x 3, not of shape {list(matrix.shape)}")
    lengths = (None, None) if matrix is None else (matrix[0, 0], matrix[1, 1])
    across, down = _focal(settings, "x", width, lengths[0], where), _focal(settings, "y", height, lengths[1], where)
    if matrix is not None:
        return matrix[:3, :3]
    if across is None and down is None:
        raise BadInput(
            f"{where} has no focal length: give fl_x, or camera_angle_x in radians, or intrinsic_matrix in each frame"
        )
    across, down = across or down or 0.0, down or across or 0.0
    centre = float(settings.get("cx", width / 2)), float(settings.get("cy", height / 2))
    return np.array([[across, 0, centre[0]], [0, down, centre[1]], [0, 0, 1.0]])


def _focal(settings: Mapping[str, Any], axis: str, pixels: int, length: float | None, where: str) -> float | None:
    """The focal length along an axis, in pixels; `length` is from intrinsic_matrix. None if the file states none.

    Raises:
        BadInput: two stated focal lengths differ.
    """
    first, *angles = _focal_keys(axis)
    stated = {"intrinsic_matrix": length, first: settings.get(first)}
    lengths = {key: float(value) for key, value in stated.items() if value is not None}
    for key, angle, unit in zip(angles, (float, radians), ("radians", "degrees"), strict=True):
        if key in settings:
            value = angle(float(settings[key]))
            if not 0 < value < pi:
                raise BadInput(f"{where}: {key} must lie between 0 and pi, not {settings[key]}: it is in {unit}")
            lengths[key] = pixels / 2 / tan(value / 2)
    if lengths and max(lengths.values()) > (1 + FOCAL_LENGTH_TOLERANCE) * min(lengths.values()) > 0:
        listed = ", ".join(f"{value:.6g} pixels by {key}" for key, value in lengths.items())
        raise BadInput(f"{where}: focal lengths differ, {listed} of {pixels} pixels: leave the wrong one out")
    return next(iter(lengths.values()), None)


FORMAT = Format(
    "NeRF",
    20,
    ("transforms.json", "transforms_train.json", "transform.json", "transform_train.json"),
    "transforms.json or transforms_train.json (NeRF, nerfstudio)",
    read_layout,
)
