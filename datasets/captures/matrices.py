"""Cameras as matrices in one `.npz` file: IDR and NeuS, and DVR."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datasets.captures.frames import Frame, Layout, decomposed, need, whole
from datasets.captures.image import image_size
from datasets.captures.lenses import unread_note
from datasets.captures.pairing import by_name, by_order, first_images, masks_of
from renderers.checks import BadInput

Matrices = dict[str, Float[np.ndarray, "4 4"]]
SIMILAR = 1e-4  # most by which scale_mat may differ from a similarity, and from that of another camera, as a share
CUBE = 0.75**0.5  # radius of the sphere about DVR's cube from -1/2 to 1/2


def matrices(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """IDR and NeuS: projections world_mat_i, and scale_mat_i from the unit sphere; i counts the sorted names.

    DVR: camera_mat_i onto an image from -1 to 1, world_mat_i, scale_mat_i from a cube of side 1; and depths.
    """
    file = files[0]
    with np.load(file) as stored:
        every = {key: stored[key] for key in stored}
    unread = unread_note([key for key in every if not re.fullmatch(r"(world|scale|camera)_mat(_inv)?_\d+", key)], file)
    wanted = [key for key in every if re.fullmatch(r"(world|scale|camera)_mat_\d+", key)]
    known = {key: whole(np.asarray(every[key], dtype=np.float64), f"{file}, {key}") for key in wanted}
    count = sum(key.startswith("world_mat_") for key in known)
    if count == 0:
        raise BadInput(f"{file} has no world_mat_0: export it again, with world_mat_0, world_mat_1 and so on")
    for i in range(count):
        need(known, f"world_mat_{i}", str(file))
    images = first_images(folder, "image", "images")
    names, order = by_order(images, count, file.name)
    scale, notes = _scale(known, count, str(file))
    masks, how = masks_of(folder, images if masked else {}, sorted_too=True)
    apart = _is_dvr(known)
    depths = _depths(folder, images) if apart else {}

    def frame(i: int, name: str) -> Frame:
        world = known[f"world_mat_{i}"]
        if not apart:
            return Frame(images[name], *decomposed((world @ scale)[:3]), masks.get(name))
        seen = need(known, f"camera_mat_{i}", str(file)) @ world @ scale
        return _dvr_frame(seen, images[name], masks.get(name), depths.get(name))

    frames = tuple(frame(i, name) for i, name in enumerate(names))
    sphere = (np.zeros(3), CUBE if apart else 1.0) if any(key.startswith("scale_mat_") for key in known) else None
    name, notes = "DVR" if apart else "IDR/NeuS", (*unread, *notes, *order, *how)
    return Layout(name, frames, sphere, notes, world=scale, missing="image/*")


def _is_dvr(known: Matrices) -> bool:
    """Whether intrinsics stand apart, in camera_mat_i: NeuS's scripts write them beside a world_mat_i that has them."""
    if not {"camera_mat_0", "world_mat_0"} <= set(known):
        return False
    lengths = np.linalg.norm(known["world_mat_0"][:3, :3], axis=1)
    return bool(lengths.max() <= 1.01 * lengths.min())


def _depths(folder: Path, images: dict[str, Path]) -> dict[str, Path]:
    """The files of depths, by the names of their images."""
    stored = {one.name: one for one in sorted(folder.glob("depth/*.exr")) if not one.name.startswith(".")}
    return {name: stored[depth] for name, depth in by_name(images, stored).items()}


def _dvr_frame(seen: Float[np.ndarray, "4 4"], image: Path, mask: Path | None, depth: Path | None) -> Frame:
    """The frame of a projection onto an image whose first and last pixels have their centres at -1 and 1."""
    half = (np.array(image_size(image)) - 1) / 2
    pixels = np.array([[half[0], 0, half[0], 0], [0, half[1], half[1], 0], [0, 0, 1.0, 0]])
    intrinsics, motion = decomposed(pixels @ seen)
    unit = 1 / float(seen[2, :3] @ motion[2, :3])  # a depth is the third number of a projected point
    return Frame(image, intrinsics, motion, mask, depth=None if depth is None else (depth, unit))


def _scale(known: Matrices, count: int, file: str) -> tuple[Float[np.ndarray, "4 4"], tuple[str, ...]]:
    """The one scale_mat of all cameras, the identity where there is none; and a note where some have none.

    Raises:
        BadInput: where it is no similarity, or cameras have different ones.
    """
    there = [i for i in range(count) if f"scale_mat_{i}" in known]
    if not there:
        return np.eye(4), ()
    scale = known[f"scale_mat_{there[0]}"]
    squares = scale[:3, :3].T @ scale[:3, :3]
    size = float(np.trace(squares)) / 3
    if not size > 0 or np.abs(squares / size - np.eye(3)).max() > SIMILAR or np.linalg.det(scale[:3, :3]) < 0:
        lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(scale[:3, :3], axis=0))
        raise BadInput(
            f"{file}: scale_mat_{there[0]} must scale all axes alike, and turn and move them, but its columns have "
            f"lengths {lengths}: a sphere would not stay one; write one scale for all axes"
        )
    for i in there:
        if np.abs(known[f"scale_mat_{i}"] - scale).max() > SIMILAR * size**0.5:
            raise BadInput(f"{file}: scale_mat_{i} differs from scale_mat_{there[0]}: the unit sphere must be the same")
    lacking = [f"{count - len(there)} have none, such as camera {i}" for i in range(count) if i not in there]
    return scale, tuple(f"scale_mat_{there[0]} is that of all cameras: {told}" for told in lacking[:1])
