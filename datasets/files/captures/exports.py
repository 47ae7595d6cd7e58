"""Photographs with cameras, written in layouts that codes of others read.

The world of the written cameras is that of the photographs, whose object lies in the unit sphere.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from datasets.files.captures.frames import OPENGL
from datasets.shot import Shot
from renderers.checks import BadInput

PIXEL_CENTRE = 0.5  # pixels: where cameras of this project have the centre of the first pixel
DVR_CUBE_SIDE = 2.0  # scene units: DVR's unit cube then contains the unit sphere
INTRINSICS_TOLERANCE = 1e-3  # pixels
SEQUENCE_NAME = "photographs"
UNREAD_POINTS = 20_000 * ("0 0 0".ljust(59) + "\n")  # true points, which DIST's code reads and uses in no loss
Matrix = Float[np.ndarray, "4 4"]


def write_idr(shots: Sequence[Shot], folder: Path, first_pixel: float) -> None:
    """IDR and NeuS: image/000000.png, mask/000.png; projections world_mat_i, and scale_mat_i, here the identity.

    Args:
        folder: is made.
        first_pixel: coordinate that the centre of the first pixel gets, in pixels.
    """
    _write_images(shots, folder)
    cameras = _cameras(shots, first_pixel)
    matrices = {f"world_mat_{i}": intrinsics @ motion for i, (intrinsics, motion) in enumerate(cameras)}
    matrices |= {f"scale_mat_{i}": np.eye(4) for i in range(len(shots))}
    np.savez(folder / "cameras_sphere.npz", **matrices)  # type: ignore[arg-type]


def write_dvr(shots: Sequence[Shot], folder: Path, first_pixel: float) -> None:
    """DVR: the images of `write_idr`; camera_mat_i, world_mat_i, and scale_mat_i from the unit cube.

    camera_mat_i projects onto an image whose first and last pixels have their centres at -1 and 1, so that
    `first_pixel` is not read.
    """
    _write_images(shots, folder)
    matrices = dict[str, Matrix]()
    for i, (shot, (intrinsics, motion)) in enumerate(zip(shots, _cameras(shots, 0.0), strict=True)):
        to_square = np.diag([2 / (shot.camera.width - 1), 2 / (shot.camera.height - 1), 1.0, 1.0])
        to_square[:2, 2] = -1.0
        scale = np.diag([DVR_CUBE_SIDE, DVR_CUBE_SIDE, DVR_CUBE_SIDE, 1.0])
        matrices |= {f"camera_mat_{i}": to_square @ intrinsics, f"world_mat_{i}": motion, f"scale_mat_{i}": scale}
    np.savez(folder / "cameras.npz", **matrices)  # type: ignore[arg-type]


def write_pmo(shots: Sequence[Shot], folder: Path, first_pixel: float) -> None:
    """PMO, which DIST's code reads: a sequence in the parent of `folder`, of the class that `folder` is named after.

    Raises:
        BadInput: photographs have no masks, or their sizes, focal lengths or principal points differ.
    """
    cameras, root = _cameras(shots, first_pixel), folder.parent
    differ = [np.abs(intrinsics - cameras[0][0]).max() > INTRINSICS_TOLERANCE for intrinsics, _ in cameras]
    if any(differ) or len({shot.colours.shape for shot in shots}) > 1:
        raise BadInput("the layout pmo has one size, focal length and principal point, and these photographs have more")
    images = [np.dstack([shot.colours.numpy(), _mask(shot)]) for shot in shots]
    for path in (root / "sequences" / folder.name, root / "lists", root / "customShapeNet" / folder.name / "ply"):
        path.mkdir(parents=True, exist_ok=True)
    np.save(root / "sequences" / folder.name / f"{SEQUENCE_NAME}.npy", _bytes(np.stack(images)))
    (root / "lists" / "all_test.list").write_text(f"{folder.name} {SEQUENCE_NAME}\n")
    (root / "customShapeNet" / folder.name / "ply" / f"{SEQUENCE_NAME}.points.ply").write_text(UNREAD_POINTS)
    extrinsics = np.stack([motion[:3] for _, motion in cameras])
    np.savez(root / "camera.npz", intr=cameras[0][0][:3, :3], extr=extrinsics)


def write_transforms(shots: Sequence[Shot], path: Path) -> None:
    """The cameras alone, as NeRF's JSON.

    Sizes are those that `longest` left, without a lens's distortion, as in the photographs of a run.
    """
    frames = []
    for shot, (intrinsics, motion) in zip(shots, _cameras(shots, PIXEL_CENTRE), strict=True):
        frame = {"file_path": shot.name, "w": shot.camera.width, "h": shot.camera.height}
        frame |= {"fl_x": intrinsics[0, 0], "fl_y": intrinsics[1, 1], "cx": intrinsics[0, 2], "cy": intrinsics[1, 2]}
        frames.append(frame | {"transform_matrix": (np.linalg.inv(motion) @ OPENGL).tolist()})
    path.write_text(json.dumps({"frames": frames}, indent=1))


LAYOUTS = {"idr": write_idr, "dvr": write_dvr, "pmo": write_pmo}


def _write_images(shots: Sequence[Shot], folder: Path) -> None:
    """Writes image/000000.png, ... and mask/000.png, ...; a photograph without a mask gets a white one."""
    for name in ("image", "mask"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for i, shot in enumerate(shots):
        Image.fromarray(_bytes(shot.colours.numpy())).save(folder / "image" / f"{i:06d}.png")
        Image.fromarray(_bytes(_mask(shot))).save(folder / "mask" / f"{i:03d}.png")


def _mask(shot: Shot) -> Float[np.ndarray, "height width"]:
    return np.ones(shot.colours.shape[:2]) if shot.mask is None else shot.mask.double().numpy()


def _bytes(values: Float[np.ndarray, "*shape"]) -> np.ndarray:
    return (255 * values).round().astype(np.uint8)


def _cameras(shots: Sequence[Shot], first_pixel: float) -> list[tuple[Matrix, Matrix]]:
    """The intrinsics in pixels and world_to_camera of each photograph."""
    cameras = []
    for shot in shots:
        intrinsics = np.eye(4)
        intrinsics[:3, :3] = shot.camera.intrinsics.double().numpy()
        intrinsics[:2, 2] += first_pixel - PIXEL_CENTRE
        cameras.append((intrinsics, shot.camera.world_to_camera.double().numpy()))
    return cameras
