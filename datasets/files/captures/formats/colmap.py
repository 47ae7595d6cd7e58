"""COLMAP's sparse reconstructions."""

from collections.abc import Sequence
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from datasets.extras import install_command
from datasets.files.captures.frames import Format, Frame, Layout, rigid_matrix
from datasets.files.captures.lenses import colmap_lens
from datasets.files.captures.pairing import find_images, find_masks, images_in, unpaired_note
from renderers.checks import BadInput

IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8", "input", "image", ".")
SPHERE_POINTS_FRACTION = 0.9  # the other points may be far from the object


def read_layout(folder: Path, files: Sequence[Path], masked: bool, images: str | None = None) -> Layout:
    """The model with the most images, read by pycolmap; its points lie about the object or about the whole view.

    Args:
        files: the images.bin or images.txt of the models: several if COLMAP could not join all images.
        masked: whether masks are read.
        images: the folder of images; None: the first of `IMAGE_FOLDERS` with the most images.
    """
    folders = [*dict.fromkeys(file.parent for file in files)]
    try:
        import pycolmap
    except ImportError as error:
        raise BadInput(f"{folders[0]} is read by pycolmap: {install_command('colmap')}") from error
    models = {model_folder: pycolmap.Reconstruction(str(model_folder)) for model_folder in folders}
    model_folder = max(folders, key=lambda candidate: len(models[candidate].images))  # the first of equal ones
    cameras = _cameras(models[model_folder], model_folder)
    bases = [folder / images] if images is not None else [folder / name for name in IMAGE_FOLDERS]
    if images is not None and not bases[0].is_dir():
        raise BadInput(f"dataset.images={images} is no folder: give that of COLMAP's images, from {folder} or /")
    tried = [(base, *find_images([*cameras], base)) for base in bases if base.is_dir()]
    base, image_files, path_notes = max(tried, key=lambda attempt: len(attempt[1]))
    short_names = {name: Path(relpath(file, base)).as_posix() for name, file in sorted(image_files.items())}
    relative_files = {short_names[name]: file for name, file in image_files.items()}
    masks, mask_notes = find_masks(folder, relative_files if masked else {})
    frames = [
        Frame(image_files[name], *cameras[name][:2], masks.get(short), *cameras[name][2:])
        for name, short in short_names.items()
    ]
    counts = {key: f"{key.relative_to(folder)} with {len(model.images)}" for key, model in models.items()}
    others = [count for key, count in counts.items() if key != model_folder]
    notes = [f"{counts[model_folder]} images is taken, not {', '.join(others)}"] if others else []
    notes += [*path_notes, *mask_notes, *unpaired_note("image", [name for name in cameras if name not in image_files])]
    if base != folder:
        notes += unpaired_note("camera", [name for name in images_in(base, deep=True) if name not in relative_files])
    points, points_sphere = np.array([point.xyz for point in models[model_folder].points3D.values()]), None
    if len(points):
        centre = np.median(points, axis=0)
        points_sphere = centre, float(np.quantile(np.linalg.norm(points - centre, axis=1), SPHERE_POINTS_FRACTION))
    return Layout("COLMAP", tuple(frames), None, tuple(notes), points_sphere, example_image=next(iter(cameras), ""))


def _cameras(model: Any, folder: Path) -> dict[str, tuple[Any, ...]]:
    """Intrinsics, world_to_camera, size and lens of each image, by the image's name."""
    names, cameras = _names_in_text(folder), {}
    for image in (image for image in model.images.values() if image.has_pose):
        camera = model.cameras[image.camera_id]
        lens = colmap_lens(camera.model.name, list(camera.params), str(folder))
        name = names.get(image.image_id, image.name)
        rigid = image.cam_from_world()
        if not np.any(rigid.rotation.quat):
            raise BadInput(f"{folder}: the quaternion of {name} is 0 0 0 0, and no rotation: export it again")
        world_to_camera = rigid_matrix(Rotation.from_quat(rigid.rotation.quat).as_matrix(), rigid.translation)
        cameras[name] = camera.calibration_matrix(), world_to_camera, (camera.height, camera.width), lens
    return {name: cameras[name] for name in sorted(cameras)}


def _names_in_text(folder: Path) -> dict[int, str]:
    """The names of images by number, from images.txt, since pycolmap ends names at the first space."""
    file, names = folder / "images.txt", {}
    if (folder / "images.bin").is_file() or not file.is_file():
        return names
    lines = iter(file.read_text().splitlines())
    for line in lines:
        if line.strip() and not line.startswith("#"):
            number, *rest = line.split(maxsplit=9)
            names[int(number)] = rest[-1].strip()
            points = next(lines, "").split()  # x, y and number of each point
            if len(points) % 3 or (points and not points[-1].lstrip("-").isdecimal()):
                raise BadInput(
                    f"{file}: after {rest[-1]} there must be a line of its points, or a blank one: add these"
                )
    return names


ROOTS = ("sparse", "colmap/sparse", "distorted/sparse", ".")
FOLDERS = [f"{root}/{inner}" for root in ROOTS for inner in ("[0-9]*/", "")]
FORMAT = Format(
    "COLMAP",
    50,
    [f"{folder}images.[bt][ix][nt]" for folder in FOLDERS],
    "sparse/0 with images/ (COLMAP)",
    read_layout,
    takes_images=True,
)
