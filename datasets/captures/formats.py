"""Cameras of photographs, in the formats in which people keep them.

Axes and pixels become those of `renderers.camera`: x right, y down, z forward, the first pixel's centre at (0.5, 0.5).
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import pi, tan
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float
from PIL import Image
from scipy.linalg import rq

from datasets.extras import install
from renderers.checks import BadInput

IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # axes x right, y up, z backward
HALF = 0.5  # pixels: where the first pixel's centre is at whole numbers, the principal point moves by this
KNOWN = (
    "cameras*.npz with image/ (IDR, NeuS), transforms.json or transforms_train.json (NeRF, nerfstudio), *_par.txt "
    "(Middlebury), poses_bounds.npy with images/ (LLFF), sparse/0 with images/ (COLMAP)"
)
BROWN = ("k1", "k2", "p1", "p2")
DISTORTIONS = {  # of COLMAP's camera models: which of these stand behind focal lengths and principal point
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": BROWN,
}


@dataclass(frozen=True)
class Frame:
    """The file of an image, and its camera.

    Args:
        image: the file.
        intrinsics: in pixels of an image of `size`.
        world_to_camera: rigid motion.
        mask: the file of its mask; None where there is none, or the image has an alpha channel.
        size: height and width for which the intrinsics hold; None for those of the file.
        distortion: k1, k2, p1, p2 of Brown's model, as OpenCV and COLMAP have them.
    """

    image: Path
    intrinsics: Float[np.ndarray, "3 3"]
    world_to_camera: Float[np.ndarray, "4 4"]
    mask: Path | None = None
    size: tuple[int, int] | None = None
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        numbers = np.concatenate([self.intrinsics.ravel(), self.world_to_camera.ravel(), self.distortion])
        if len(numbers) != 9 + 16 + 4 or not np.isfinite(numbers).all() or not (numbers[[0, 4]] > 0).all():
            raise BadInput(
                f"the camera of {self.image} must have finite numbers and positive focal lengths: export it again"
            )


@dataclass(frozen=True)
class Layout:
    """What lies in a folder of photographs.

    Args:
        format: its name.
        frames: the images that have a camera, by name.
        sphere: centre and radius of the sphere about the object, where the format states it.
        notes: what was left out.
    """

    format: str
    frames: tuple[Frame, ...]
    sphere: tuple[Float[np.ndarray, "3"], float] | None = None
    notes: tuple[str, ...] = ()


def find_layout(folder: Path) -> Layout:
    """The photographs of a folder, in the first known format that it has.

    Raises:
        BadInput: where it has none, where an image has no camera, or where a file cannot be read.
    """
    if not folder.is_dir():
        what = f"{folder} is a file" if folder.exists() else f"there is no folder {folder}"
        raise BadInput(f"{what}: name the folder that has the photographs and their cameras")
    found = [layout for read in (idr, transforms, middlebury, llff, colmap) if (layout := _read(read, folder))]
    if not found:
        raise BadInput(f"{folder} has no cameras that are known: {KNOWN}")
    usable = [layout for layout in found if layout.frames]
    if not usable:
        names = ", ".join(layout.format for layout in found)
        raise BadInput(f"{folder} has cameras ({names}) but none of their images: copy these too")
    others = ", ".join(layout.format for layout in found if layout is not usable[0])
    notes = (*usable[0].notes, f"other cameras in the folder are not used: {others}") if others else usable[0].notes
    return replace(usable[0], notes=notes)


def _read(read: Callable[[Path], Layout | None], folder: Path) -> Layout | None:
    """What a format's reader finds; where a file of it is broken, an error that names the format.

    Raises:
        BadInput: where something is missing, or cannot be read.
    """
    try:
        return read(folder)
    except BadInput:
        raise
    except (OSError, ValueError, LookupError, TypeError, ArithmeticError, EOFError, BadZipFile, RuntimeError) as error:
        what = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise BadInput(f"{read.__name__} cameras of {folder} cannot be read ({what}): export them again") from error


def idr(folder: Path) -> Layout | None:
    """IDR and NeuS: projections world_mat_i, and scale_mat_i from the unit sphere; i counts the images by name.

    Where there are fewer images than cameras, i is the number in an image's name.
    """
    files = [file for name in ("cameras_sphere.npz", "cameras.npz") if (file := folder / name).is_file()]
    if not files:
        return None
    with np.load(files[0]) as stored:
        count = sum(key.startswith("world_mat_") and not key.startswith("world_mat_inv") for key in stored)
        scaled = "scale_mat_0" in stored
        scales = [stored[f"scale_mat_{i}"] if scaled else np.eye(4) for i in range(count)]
        projections = [(stored[f"world_mat_{i}"] @ scales[i])[:3] for i in range(count)]
    images = _images(folder, "image", "images")
    place = dict(enumerate(images)) if len(images) >= count else _numbered(images)
    if lost := [image for i, image in place.items() if i >= count]:
        raise BadInput(
            f"{lost[0]} has no camera: {files[0].name} has {count} cameras, and there are {len(images)} images; "
            "remove those without a camera, or add its world_mat and scale_mat"
        )
    masks = _masks(folder, images)
    frames = [Frame(image, *decomposed(projections[i]), masks.get(image)) for i, image in place.items()]
    unused = [f"camera {i}" for i in range(count) if i not in place]
    return Layout("IDR/NeuS", tuple(frames), (np.zeros(3), 1.0) if scaled else None, _without_image(unused))


def transforms(folder: Path) -> Layout | None:
    """NeRF and nerfstudio: camera_to_world in OpenGL's axes; a field of view, or intrinsics and distortion."""
    files = [file for name in ("transforms.json", "transforms_train.json") if (file := folder / name).is_file()]
    if not files:
        return None
    stored = json.loads(files[0].read_text())
    found = [(stored | frame, _with_suffix(folder / frame["file_path"])) for frame in stored["frames"]]
    frames = [_nerf_frame(folder, frame, image) for frame, image in found if image is not None]
    missing = [str(frame["file_path"]) for frame, image in found if image is None]
    return Layout("NeRF", tuple(sorted(frames, key=lambda frame: _order(frame.image))), None, _without_image(missing))


def _nerf_frame(folder: Path, known: dict[str, Any], image: Path) -> Frame:
    """The frame of one image from what the file says of all and of it."""
    if "FISHEYE" in str(known.get("camera_model", "")).upper():
        raise BadInput(f"{folder} has fisheye cameras: undistort the images, and export them with pinhole cameras")
    width, height = (int(known["w"]), int(known["h"])) if "w" in known else Image.open(image).size
    if "fl_x" not in known and not 0 < float(known["camera_angle_x"]) < pi:
        raise BadInput(f"camera_angle_x must lie between 0 and pi, not {known['camera_angle_x']}: it is in radians")
    across = float(known["fl_x"]) if "fl_x" in known else width / 2 / tan(float(known["camera_angle_x"]) / 2)
    down = known.get("fl_y", across)
    middle = known.get("cx", width / 2), known.get("cy", height / 2)
    intrinsics = np.array([[across, 0, middle[0]], [0, down, middle[1]], [0, 0, 1.0]])
    motion = np.linalg.inv(np.asarray(known["transform_matrix"], dtype=np.float64) @ OPENGL)
    mask = folder / known["mask_path"] if known.get("mask_path") else None
    return Frame(image, intrinsics, motion, mask, (height, width), _distortion(known))


def middlebury(folder: Path) -> Layout | None:
    """Middlebury: a line for each image: its name, K, R and t, row by row."""
    files = sorted(folder.glob("*_par.txt"))
    if not files:
        return None
    frames, missing = [], []
    images = {image.name: image for image in _images(folder, ".")}
    masks = _masks(folder, list(images.values()))
    for line in files[0].read_text().splitlines()[1:]:
        name, *numbers = line.split()
        if len(numbers) != 21:
            raise BadInput(f"{files[0]}: the line of {name} must have 21 numbers, not {len(numbers)}: copy it again")
        values = np.array(numbers, dtype=np.float64)
        intrinsics, motion = values[:9].reshape(3, 3), _motion(values[9:18].reshape(3, 3), values[18:])
        if name in images:
            frames.append(Frame(images[name], _centred(intrinsics), motion, masks.get(images[name])))
        else:
            missing.append(name)
    if lost := sorted(set(images) - {frame.image.name for frame in frames}):
        raise BadInput(f"{folder / lost[0]} has no camera: {files[0].name} has no line for it; remove the image")
    return Layout("Middlebury", tuple(frames), None, _without_image(missing))


def llff(folder: Path) -> Layout | None:
    """LLFF: for each image, by name, camera_to_world with axes down, right, backward, then height, width and focal."""
    file = folder / "poses_bounds.npy"
    if not file.is_file():
        return None
    rows, images = np.load(file), _images(folder, "images", "images_2", "images_4", "images_8")
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) != len(images):
        raise BadInput(
            f"{file} must have a row of 17 numbers for each image, found shape {list(rows.shape)} and {len(images)} "
            "images: copy the images that were removed, or make it again"
        )
    masks, frames = _masks(folder, images), []
    for image, row in zip(images, rows, strict=True):
        pose = row[:15].reshape(3, 5)
        down, right, back, centre, (height, width, focal) = pose.T
        rotation = np.stack([right, down, -back])
        motion = _motion(rotation, -rotation @ centre)
        intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        frames.append(Frame(image, intrinsics, motion, masks.get(image), (int(height), int(width))))
    return Layout("LLFF", tuple(frames))


def colmap(folder: Path) -> Layout | None:
    """COLMAP's sparse reconstruction, read by pycolmap; its points lie about the object and give the sphere."""
    places = [place for name in ("sparse/0", "sparse", "colmap/sparse/0") if (place := folder / name).is_dir()]
    if not places:
        return None
    try:
        import pycolmap
    except ImportError as error:
        raise BadInput(f"{places[0]} is read by pycolmap: {install('colmap')}") from error
    stored = pycolmap.Reconstruction(str(places[0]))
    images = {image.name: image for image in _images(folder, "images", "images_2", "images_4", "images_8")}
    masks, frames, missing = _masks(folder, list(images.values())), [], []
    for seen in sorted(stored.images.values(), key=lambda one: one.name):
        camera, name = stored.cameras[seen.camera_id], Path(seen.name).name
        model = camera.model.name
        if model not in DISTORTIONS:
            raise BadInput(f"{places[0]} has cameras of the model {model}: use colmap image_undistorter first")
        if name not in images:
            missing.append(name)
            continue
        matrix, names = seen.cam_from_world().matrix(), DISTORTIONS[model]
        bent = dict(zip(names, camera.params[len(camera.params) - len(names) :], strict=True))
        image, size, motion = images[name], (camera.height, camera.width), _motion(matrix[:, :3], matrix[:, 3])
        frames.append(Frame(image, camera.calibration_matrix(), motion, masks.get(image), size, _distortion(bent)))
    points = np.array([point.xyz for point in stored.points3D.values()])
    sphere = _about(points) if len(points) else None
    return Layout("COLMAP", tuple(frames), sphere, _without_image(missing))


def decomposed(projection: Float[np.ndarray, "3 4"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "4 4"]]:
    """Intrinsics and world_to_camera of a projection whose first pixel's centre is at whole numbers."""
    if projection.shape != (3, 4) or not np.isfinite(projection).all():
        raise ValueError("a projection must have 3 x 4 finite numbers")
    projection = projection * np.sign(np.linalg.det(projection[:, :3]))
    upper, rotation = rq(projection[:, :3])
    signs = np.diag(np.sign(np.diag(upper)))
    upper, rotation = upper @ signs, signs @ rotation
    return _centred(upper / upper[2, 2]), _motion(rotation, np.linalg.solve(upper, projection[:, 3]))


def _motion(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """The rigid motion that turns first."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, translation
    return motion


def _distortion(known: Mapping[str, Any]) -> tuple[float, ...]:
    """Brown's numbers in their order, 0 where one is not given."""
    return tuple(float(known.get(name, 0.0)) for name in BROWN)


def _centred(intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Intrinsics with the first pixel's centre at (0.5, 0.5), from those with it at (0, 0)."""
    return intrinsics + np.array([[0, 0, HALF], [0, 0, HALF], [0, 0, 0]])


def _about(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """The sphere about most of the points: of others some are far away."""
    centre = np.median(points, axis=0)
    return centre, float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.9))


def _images(folder: Path, *names: str) -> list[Path]:
    """The images in the first of these folders that is there, by name."""
    for name in names:
        if (place := folder / name).is_dir():
            return sorted((file for file in place.iterdir() if file.suffix.lower() in IMAGES), key=_order)
    return []


def _order(path: Path) -> tuple[tuple[int, str], ...]:
    """A key by which image 10 comes after image 9."""
    parts = re.split(r"(\d+)", path.name)
    return tuple((int(part), "") if part.isdigit() else (-1, part) for part in parts)


def _numbered(images: list[Path]) -> dict[int, Path]:
    """Images by the last number in their names."""
    return {int(found[-1]): image for image in images if (found := re.findall(r"\d+", image.stem))}


def _masks(folder: Path, images: list[Path]) -> dict[Path, Path]:
    """The mask of each image in the folder of masks: of the same name, or else the same last number.

    Raises:
        BadInput: where there are masks, but an image has none.
    """
    masks = _images(folder, "mask", "masks")
    by_name, by_number = {mask.stem: mask for mask in masks}, _numbered(masks)
    found = {}
    for image in images if masks else []:
        mask = by_name.get(image.stem) or by_number.get(next(iter(_numbered([image])), -1))
        if mask is None:
            raise BadInput(f"{image} has no mask in {masks[0].parent}: add it, or remove the folder of masks")
        found[image] = mask
    return found


def _without_image(names: list[str]) -> tuple[str, ...]:
    """A note on cameras whose image is not there; none where all are."""
    return (f"no image for {len(names)} of the cameras, such as {names[0]}",) if names else ()


def _with_suffix(path: Path) -> Path | None:
    """The image of that name, whose suffix may be left out; None where there is none."""
    names = [path, *(path.with_name(path.name + suffix) for suffix in IMAGES)]
    return next((name for name in names if name.suffix.lower() in IMAGES and name.is_file()), None)
