"""Cameras as matrices in one `.npz` file: IDR and NeuS, and DVR."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datasets.files.captures.frames import Format, Frame, Layout, decompose, homogeneous_matrix, require_key
from datasets.files.captures.image import image_size
from datasets.files.captures.lenses import unread_keys_note
from datasets.files.captures.pairing import find_masks, first_images, pair_by_name, pair_by_order
from renderers.checks import BadInput

Matrices = dict[str, Float[np.ndarray, "4 4"]]
SIMILARITY_TOLERANCE = 1e-4  # largest relative difference of scale_mat from a similarity, and between cameras
DVR_CUBE_RADIUS = 0.75**0.5  # the cube reaches from -1/2 to 1/2


def read_layout(folder: Path, files: Sequence[Path], masked: bool) -> Layout:
    """IDR and NeuS: projections world_mat_i of image i in string order, and scale_mat_i from the unit sphere.

    DVR: camera_mat_i onto an image from -1 to 1, world_mat_i, scale_mat_i from a cube of side 1; and depths.
    """
    file = files[0]
    with np.load(file) as stored:
        arrays = {key: stored[key] for key in stored}
    unread = [key for key in arrays if not re.fullmatch(r"(world|scale|camera)_mat(_inv)?_\d+", key)]
    keys = [key for key in arrays if re.fullmatch(r"(world|scale|camera)_mat_\d+", key)]
    cameras = {key: homogeneous_matrix(np.asarray(arrays[key], dtype=np.float64), f"{file}, {key}") for key in keys}
    count = sum(key.startswith("world_mat_") for key in cameras)
    if count == 0:
        raise BadInput(f"{file} has no world_mat_0: export it again, with world_mat_0, world_mat_1 and so on")
    for i in range(count):
        require_key(cameras, f"world_mat_{i}", str(file))
    images = first_images(folder, "image", "images")
    names, order_notes = pair_by_order(images, count, file.name)
    scale, notes = _scale(cameras, count, str(file))
    masks, mask_notes = find_masks(folder, images if masked else {}, sorted_too=True)
    is_dvr = _is_dvr(cameras)
    files_of_depths = {path.name: path for path in sorted(folder.glob("depth/*.exr")) if not path.name.startswith(".")}
    pairs = pair_by_name(images, files_of_depths) if is_dvr else {}
    depths = {name: files_of_depths[depth] for name, depth in pairs.items()}

    def frame(i: int, name: str) -> Frame:
        world = cameras[f"world_mat_{i}"]
        if not is_dvr:
            return Frame(images[name], *decompose((world @ scale)[:3]), masks.get(name))
        projection = require_key(cameras, f"camera_mat_{i}", str(file)) @ world @ scale
        return _dvr_frame(projection, images[name], masks.get(name), depths.get(name))

    frames = tuple(frame(i, name) for i, name in enumerate(names))
    sphere = (np.zeros(3), DVR_CUBE_RADIUS if is_dvr else 1.0) if any("scale_mat_" in key for key in cameras) else None
    notes = (*unread_keys_note(unread, file), *notes, *order_notes, *mask_notes)
    return Layout("DVR" if is_dvr else "IDR/NeuS", frames, sphere, notes, world=scale, example_image="image/*")


def _is_dvr(cameras: Matrices) -> bool:
    """Whether only camera_mat_i has the intrinsics: NeuS's scripts write them into world_mat_i, too."""
    if not {"camera_mat_0", "world_mat_0"} <= set(cameras):
        return False
    lengths = np.linalg.norm(cameras["world_mat_0"][:3, :3], axis=1)
    return bool(lengths.max() <= 1.01 * lengths.min())


def _dvr_frame(projection: Float[np.ndarray, "4 4"], image: Path, mask: Path | None, depth: Path | None) -> Frame:
    """The frame of a projection onto an image whose first and last pixels have their centres at -1 and 1."""
    half = (np.array(image_size(image)) - 1) / 2
    pixels = np.array([[half[0], 0, half[0], 0], [0, half[1], half[1], 0], [0, 0, 1.0, 0]])
    intrinsics, world_to_camera = decompose(pixels @ projection)
    unit = 1 / float(projection[2, :3] @ world_to_camera[2, :3])  # a depth is the third number of a projected point
    return Frame(image, intrinsics, world_to_camera, mask, depth=None if depth is None else (depth, unit))


def _scale(cameras: Matrices, count: int, file: str) -> tuple[Float[np.ndarray, "4 4"], tuple[str, ...]]:
    """The scale_mat that all cameras share, or the identity without any; and a note if some cameras have none.

    Raises:
        BadInput: it is no similarity, or cameras have different ones.
    """
    with_scale = [i for i in range(count) if f"scale_mat_{i}" in cameras]
    if not with_scale:
        return np.eye(4), ()
    name = f"scale_mat_{with_scale[0]}"
    scale, linear = cameras[name], cameras[name][:3, :3]
    squares = linear.T @ linear
    size = float(np.trace(squares)) / 3
    if not size > 0 or np.abs(squares / size - np.eye(3)).max() > SIMILARITY_TOLERANCE or np.linalg.det(linear) < 0:
        lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(linear, axis=0))
        raise BadInput(
            f"{file}: {name} must scale all axes alike, and turn and move them, but its columns have lengths "
            f"{lengths}: a sphere would not stay one; write one scale for all axes"
        )
    for i in with_scale:
        if np.abs(cameras[f"scale_mat_{i}"] - scale).max() > SIMILARITY_TOLERANCE * size**0.5:
            raise BadInput(f"{file}: scale_mat_{i} differs from {name}: the unit sphere must be the same")
    lacking = [f"{count - len(with_scale)} have none, such as camera {i}" for i in range(count) if i not in with_scale]
    return scale, tuple(f"{name} is that of all cameras: {text}" for text in lacking[:1])


FORMAT = Format(
    "IDR, NeuS or DVR",
    10,
    ("cameras_sphere.npz", "cameras.npz"),
    "cameras*.npz with image/ (IDR, NeuS, DVR)",
    read_layout,
)
