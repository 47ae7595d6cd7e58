"""COLMAP's sparse reconstructions."""

from collections.abc import Sequence
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from datasets.captures.frames import Frame, Layout, motion
from datasets.captures.lenses import colmap_lens
from datasets.captures.pairing import images_in, located, masks_of, without
from datasets.extras import install_command
from renderers.checks import BadInput

IMAGES = ("images", "images_2", "images_4", "images_8", "input", "image", ".")
MOST = 0.9  # of the points lie in the sphere: others may be far away


def colmap(folder: Path, files: Sequence[Path], masked: bool, images: str | None = None) -> Layout:
    """The model with the most images, read by pycolmap; its points lie about the object, or about all that is seen.

    Args:
        files: the images.bin or images.txt of the models: several where COLMAP could not join all images.
        masked: whether masks are looked for.
        images: the folder of images; None for the usual ones.
    """
    places = [*dict.fromkeys(file.parent for file in files)]
    try:
        import pycolmap
    except ImportError as error:
        raise BadInput(f"{places[0]} is read by pycolmap: {install_command('colmap')}") from error
    models = {place: pycolmap.Reconstruction(str(place)) for place in places}
    place = max(places, key=lambda one: len(models[one].images))  # of equal ones the first
    cameras = _cameras(models[place], place)
    bases = [folder / images] if images is not None else [folder / name for name in IMAGES]
    if images is not None and not bases[0].is_dir():
        raise BadInput(f"dataset.images={images} is no folder: give that of COLMAP's images, from {folder} or /")
    tried = [(base, *located([*cameras], base)) for base in bases if base.is_dir()]
    base, found, how = max(tried, key=lambda one: len(one[1]))
    short = {name: Path(relpath(file, base)).as_posix() for name, file in sorted(found.items())}
    there = {short[name]: file for name, file in found.items()}
    masks, paired = masks_of(folder, there if masked else {})
    frames = [
        Frame(found[name], *cameras[name][:2], masks.get(path), *cameras[name][2:]) for name, path in short.items()
    ]
    counts = {one: f"{one.relative_to(folder)} with {len(model.images)}" for one, model in models.items()}
    others = [told for one, told in counts.items() if one != place]
    notes = [f"{counts[place]} images is taken, not {', '.join(others)}"] if others else []
    notes += [*how, *paired, *without("image", [name for name in cameras if name not in found])]
    if base != folder:
        notes += without("camera", [name for name in images_in(base, deep=True) if name not in there])
    points, around = np.array([point.xyz for point in models[place].points3D.values()]), None
    if len(points):
        centre = np.median(points, axis=0)
        around = centre, float(np.quantile(np.linalg.norm(points - centre, axis=1), MOST))
    return Layout("COLMAP", tuple(frames), None, tuple(notes), around, missing=next(iter(cameras), ""))


def _cameras(model: Any, place: Path) -> dict[str, tuple[Any, ...]]:
    """Intrinsics, world_to_camera, size and lens of each image, by its name."""
    names, found = _written_names(place), {}
    for seen in (one for one in model.images.values() if one.has_pose):
        camera = model.cameras[seen.camera_id]
        lens = colmap_lens(camera.model.name, list(camera.params), str(place))
        name = names.get(seen.image_id, seen.name)
        rigid = seen.cam_from_world()
        if not np.any(rigid.rotation.quat):
            raise BadInput(f"{place}: the quaternion of {name} is 0 0 0 0, and no rotation: export it again")
        moved = motion(Rotation.from_quat(rigid.rotation.quat).as_matrix(), rigid.translation)
        found[name] = camera.calibration_matrix(), moved, (camera.height, camera.width), lens
    return {name: found[name] for name in sorted(found)}


def _written_names(place: Path) -> dict[int, str]:
    """The names in images.txt by number: pycolmap ends them at the first space."""
    file, names = place / "images.txt", {}
    if (place / "images.bin").is_file() or not file.is_file():
        return names
    lines = iter(file.read_text().splitlines())
    for line in lines:
        if line.strip() and not line.startswith("#"):
            number, *rest = line.split(maxsplit=9)
            names[int(number)] = rest[-1].strip()
            points = next(lines, "").split()  # x, y and number of each
            if len(points) % 3 or (points and not points[-1].lstrip("-").isdecimal()):
                raise BadInput(
                    f"{file}: after {rest[-1]} there must be a line of its points, or a blank one: add these"
                )
    return names
