"""Cameras in the JSON of NeRF, instant-ngp, nerfstudio and NeuS2."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from math import pi, radians, tan
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from datasets.captures.frames import OPENGL, Frame, Layout, need, whole
from datasets.captures.image import image_size
from datasets.captures.lenses import READ, nerf_lens, unread_note
from datasets.captures.pairing import located, masks_of, natural, without
from renderers.checks import BadInput

AXES = {"from_na": np.eye(4), "from_mitsuba": np.diag([-1.0, -1.0, 1.0, 1.0])}  # flags of NeuS2 and instant-ngp
NAMED = {"frames", "file_path", "mask_path", "transform_matrix", "intrinsic_matrix", "w", "h", "cx", "cy", *AXES, *READ}
OTHER = {  # of training, poses and files, none of which changes a camera
    *("rotation", "aabb_scale", "aabb", "scale", "offset", "sharpness", "applied_transform", "applied_scale"),
    *("ply_file_path", "depth_file_path", "colmap_im_id", "orientation_override", "auto_scale_poses_override"),
    *("train_filenames", "val_filenames", "test_filenames", "time"),
}
SAME = 0.02  # most by which two of them may differ, as a share


def transforms(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """camera_to_world in OpenGL's axes, or as `AXES` has them; fields of view, or intrinsics; a lens."""
    stored = json.loads(files[0].read_text(encoding="utf-8-sig"))
    every = need(stored, "frames", str(files[0]))
    if not isinstance(every, list) or not all(isinstance(frame, dict) for frame in every):
        raise BadInput(f"{files[0]}: frames must be a list with a table for each image: export it again")
    every = [{key: value for key, value in frame.items() if value is not None} for frame in every]
    stored = {key: value for key, value in stored.items() if value is not None}
    known = {str(need(frame, "file_path", f"{files[0]}: a frame")): _merged(stored, frame) for frame in every}
    if len(known) < len(every):
        paths = [str(frame["file_path"]) for frame in every]
        twice = next(path for path in paths if paths.count(path) > 1)
        raise BadInput(f"{files[0]} has {twice} twice: name each image once")
    found, how = located([*known], folder)
    masks, told = _masks(folder, known, found) if masked else ({}, ())
    frames = [_frame(known[path], image, masks.get(path), f"{files[0]}, {path}") for path, image in found.items()]
    expected = {*NAMED, *OTHER, *_focal_keys("x"), *_focal_keys("y")}
    unread = unread_note(sorted({key for frame in known.values() for key in frame} - expected), files[0])
    notes = (*unread, *how, *told, *without("image", [path for path in known if path not in found]))
    of_size = {"w", "h", *_focal_keys("x")[1:], *_focal_keys("y")[1:]}
    if any(not of_size & {*known[path]} for path in found):
        notes += (f"{files[0].name} states no w and h: focal lengths are taken for the size of the images",)
    frames = sorted(frames, key=lambda frame: natural(frame.image.name))
    return Layout("NeRF", tuple(frames), None, notes, missing=next(iter(known), ""))


def _masks(
    folder: Path, known: Mapping[str, Mapping[str, Any]], found: Mapping[str, Path]
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """The masks that frames name, by their images' paths; where none does, those of a folder `mask`, with a note."""
    named = {path: str(frame["mask_path"]) for path, frame in known.items() if path in found and frame.get("mask_path")}
    if not named:
        files = {file.name: file for file in found.values()}
        own, notes = masks_of(folder, files) if len(files) == len(found) else ({}, ())
        told = "the folder of masks is used, though transforms.json does not name it"
        return {path: own[file.name] for path, file in found.items() if own}, (told, *notes) if own else ()
    if twice := [mask for mask, times in Counter(named.values()).items() if times > 1]:
        raise BadInput(
            f"{twice[0]} is the mask of several images in transforms.json: name the own mask of each, or none"
        )
    masks, _ = located(named.values(), folder)
    if lost := [mask for mask in named.values() if mask not in masks]:
        raise BadInput(f"the mask {lost[0]} that transforms.json names is not in {folder}: add it, or use no masks")
    return {path: masks[mask] for path, mask in named.items()}, ()


def _merged(stored: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """What the file says of a frame: what it says of all does not count where the frame says the same otherwise."""
    own = {axis for axis in "xy" for key in _focal_keys(axis) if key in frame}
    lost = {key for axis in ("xy" if "intrinsic_matrix" in frame else own) for key in _focal_keys(axis)}
    lost |= {"intrinsic_matrix"} if own else set()
    return {key: value for key, value in stored.items() if key not in lost} | frame


def _focal_keys(axis: str) -> tuple[str, str, str]:
    return f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"


def _frame(known: dict[str, Any], image: Path, mask: Path | None, where: str) -> Frame:
    """The frame of one image from what the file says of all and of it."""
    lens = nerf_lens(known, where)
    stated = (int(need(known, "h", where)), int(need(known, "w", where))) if {"w", "h"} & set(known) else None
    width, height = image_size(image) if stated is None else stated[::-1]
    matrix = np.asarray(need(known, "transform_matrix", where), dtype=np.float64)
    axes = next((axes for flag, axes in AXES.items() if known.get(flag)), OPENGL)
    motion = axes @ np.linalg.inv(whole(matrix, f"{where}: transform_matrix"))
    return Frame(image, _intrinsics(known, width, height, where), motion, mask, stated, lens)


def _intrinsics(known: Mapping[str, Any], width: int, height: int, where: str) -> Float[np.ndarray, "3 3"]:
    """Intrinsics from a matrix, from focal lengths, or from fields of view."""
    matrix = np.asarray(known["intrinsic_matrix"], dtype=np.float64) if "intrinsic_matrix" in known else None
    if matrix is not None and matrix.shape not in ((3, 3), (3, 4), (4, 4)):
        raise BadInput(f"{where}: intrinsic_matrix must be 3 x 3, not of shape {list(matrix.shape)}")
    lengths = (None, None) if matrix is None else (matrix[0, 0], matrix[1, 1])
    across, down = _focal(known, "x", width, lengths[0], where), _focal(known, "y", height, lengths[1], where)
    if matrix is not None:
        return matrix[:3, :3]
    if across is None and down is None:
        raise BadInput(
            f"{where} has no focal length: give fl_x, or camera_angle_x in radians, or intrinsic_matrix in each frame"
        )
    across, down = across or down or 0.0, down or across or 0.0
    middle = float(known.get("cx", width / 2)), float(known.get("cy", height / 2))
    return np.array([[across, 0, middle[0]], [0, down, middle[1]], [0, 0, 1.0]])


def _focal(known: Mapping[str, Any], axis: str, pixels: int, length: float | None, where: str) -> float | None:
    """The focal length along an axis, in pixels, `length` by intrinsic_matrix; None where the file does not say.

    Raises:
        BadInput: where it is given twice, and differs.
    """
    first, *angles = _focal_keys(axis)
    stated = {"intrinsic_matrix": length, first: known.get(first)}
    found = {key: float(value) for key, value in stated.items() if value is not None}
    for key, angle, unit in zip(angles, (float, radians), ("radians", "degrees"), strict=True):
        if key in known:
            value = angle(float(known[key]))
            if not 0 < value < pi:
                raise BadInput(f"{where}: {key} must lie between 0 and pi, not {known[key]}: it is in {unit}")
            found[key] = pixels / 2 / tan(value / 2)
    if found and max(found.values()) > (1 + SAME) * min(found.values()) > 0:
        told = ", ".join(f"{value:.6g} pixels by {key}" for key, value in found.items())
        raise BadInput(f"{where}: focal lengths differ, {told} of {pixels} pixels: leave the wrong one out")
    return next(iter(found.values()), None)
