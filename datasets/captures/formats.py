"""Which format of photographs with cameras a folder has, and what is said where it has none that can be used."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from zipfile import BadZipFile

from datasets.captures.colmap import colmap
from datasets.captures.frames import Layout
from datasets.captures.matrices import matrices
from datasets.captures.nerf import transforms
from datasets.captures.pairing import natural
from datasets.captures.rows import blended_mvs, choy, llff, middlebury
from datasets.readers.text import mistaken
from renderers.checks import BadInput

KNOWN = (
    "cameras*.npz with image/ (IDR, NeuS, DVR), transforms.json or transforms_train.json (NeRF, nerfstudio), "
    "*_par.txt (Middlebury), poses_bounds.npy with images/ (LLFF), sparse/0 with images/ (COLMAP), cams/*_cam.txt "
    "(BlendedMVS), rendering_metadata.txt (Choy)"
)

MODELS = ("sparse", "colmap/sparse", "distorted/sparse", ".")  # where COLMAP's are
FORMATS = {  # the readers, and the files of cameras that they take
    "IDR, NeuS or DVR": (matrices, ("cameras_sphere.npz", "cameras.npz")),
    "NeRF": (transforms, ("transforms.json", "transforms_train.json", "transform.json", "transform_train.json")),
    "Middlebury": (middlebury, ("*_par.txt",)),
    "LLFF": (llff, ("poses_bounds.npy",)),
    "COLMAP": (colmap, [f"{root}/{inner}images.[bt][ix][nt]" for root in MODELS for inner in ("[0-9]*/", "")]),
    "BlendedMVS": (blended_mvs, ("cams/*_cam.txt",)),
    "Choy": (choy, ("rendering_metadata.txt", "rendering/rendering_metadata.txt")),
}
FAULTS = (  # of a file of cameras that is broken
    *(OSError, ValueError, LookupError, TypeError, ArithmeticError, EOFError, MemoryError, BadZipFile, RuntimeError),
)


def find_layout(folder: Path, images: str | None = None, *, masks: bool = True) -> Layout:
    """The photographs of a folder, in the first known format that has cameras and images there.

    Args:
        images: where COLMAP's images are, in the folder or elsewhere; None for the usual places.
        masks: whether masks are looked for.

    Raises:
        BadInput: where it has none, where an image has no camera, or where a file cannot be read.
    """
    if not folder.is_dir():
        what = f"{folder} is a file" if folder.exists() else f"there is no folder {folder}"
        raise BadInput(f"{what}: name the folder that has the photographs and their cameras")
    there = {name: files for name, (_, patterns) in FORMATS.items() if (files := _files(folder, patterns))}
    if not there:
        inner = next((one for one in sorted(folder.glob("*/")) if any(one.glob("cameras*.npz"))), None)
        other = f"; name one of its folders, such as {inner}" if inner else ""
        raise BadInput(f"{folder} has no cameras that are known: {KNOWN}{other}")
    bare = list[Layout]()
    for name, files in there.items():
        more = {"images": images} if name == "COLMAP" else {}
        layout = _read(f"{name} cameras of {files[0]}", partial(FORMATS[name][0], folder, files, masks, **more), folder)
        if layout.frames:
            if images is not None and name != "COLMAP":
                raise BadInput(f"dataset.images={images} is for COLMAP, and {folder} has {layout.format}: leave it out")
            others = ", ".join(str(there[other][0].relative_to(folder)) for other in there if other != name)
            told = (f"other cameras in the folder are not used: {others}",) if others else ()
            return replace(layout, notes=(*layout.notes, *told))
        bare.append(layout)
    raise BadInput(_no_images(folder, bare))


def _files(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """The files of a folder by these patterns, in this order, number 10 after 9; none that is hidden."""
    found = [sorted(folder.glob(pattern), key=lambda file: natural(str(file))) for pattern in patterns]
    return [file for some in found for file in some if file.is_file() and not file.name.startswith(".")]


def _read(what: str, read: Callable[[], Layout], folder: Path) -> Layout:
    """What a format's reader finds; where a file of it is broken, an error that says of what cameras.

    Raises:
        BadInput: where something is missing, or cannot be read.
    """
    try:
        return read()
    except FAULTS as error:
        files = (file for file in sorted(folder.rglob("*")) if file.is_file())
        pointer = next((f"{file} {kind}" for file in files if "LFS" in (kind := mistaken(file))), None)
        if pointer is not None:
            raise BadInput(pointer) from None
        if isinstance(error, BadInput):
            raise
        why = " ".join(str(error).split())
        raise BadInput(f"the {what} cannot be read ({why}): export them again") from error


def _no_images(folder: Path, found: list[Layout]) -> str:
    """What is said of a folder whose cameras have no images."""
    names = ", ".join(layout.format for layout in found)
    missing = next((f", such as {layout.missing}" for layout in found if layout.missing), "")
    files = [file for file in folder.rglob("*") if file.is_file() and not file.name.startswith(".")]
    kinds = ", ".join(sorted({file.suffix for file in files if file.suffix}))
    return (
        f"{folder} has cameras ({names}) but none of their images{missing}; its files end with {kinds}: copy the "
        "images to where the cameras name them, as .png, .jpg, .tif, .webp or .bmp"
    )
