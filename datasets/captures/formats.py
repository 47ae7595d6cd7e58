"""Which format of photographs with cameras a folder has, and what is said where it has none that can be used."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from zipfile import BadZipFile

from datasets.captures.colmap import colmap
from datasets.captures.frames import Layout
from datasets.captures.matrices import dvr, idr
from datasets.captures.nerf import transforms
from datasets.captures.rows import blended_mvs, choy, llff, middlebury
from datasets.readers.text import mistaken
from renderers.checks import BadInput

KNOWN = (
    "cameras*.npz with image/ (IDR, NeuS, DVR), transforms.json or transforms_train.json (NeRF, nerfstudio), "
    "*_par.txt (Middlebury), poses_bounds.npy with images/ (LLFF), sparse/0 with images/ (COLMAP), cams/*_cam.txt "
    "(BlendedMVS), rendering_metadata.txt (Choy)"
)

FAULTS = (  # of a file of cameras that is broken
    *(OSError, ValueError, LookupError, TypeError, ArithmeticError, EOFError, MemoryError, BadZipFile, RuntimeError),
)


def find_layout(folder: Path, images: str | None = None, *, masks: bool = True) -> Layout:
    """The photographs of a folder, in the first known format that it has.

    Args:
        images: where COLMAP's images are, in the folder or elsewhere; None for the usual places.
        masks: whether masks are looked for.

    Raises:
        BadInput: where it has none, where an image has no camera, or where a file cannot be read.
    """
    if not folder.is_dir():
        what = f"{folder} is a file" if folder.exists() else f"there is no folder {folder}"
        raise BadInput(f"{what}: name the folder that has the photographs and their cameras")
    readers: dict[str, Callable[[Path, bool], Layout | None]] = {
        "DVR": dvr,
        "IDR/NeuS": idr,
        "NeRF": transforms,
        "Middlebury": middlebury,
        "LLFF": llff,
        "COLMAP": lambda folder, masks: colmap(folder, masks, images),
        "BlendedMVS": blended_mvs,
        "Choy": choy,
    }
    found, unread = list[Layout](), list[str]()
    for name, read in readers.items():
        try:
            layout = _read(name, partial(read, folder, masks), folder)
        except BadInput:
            if not any(one.frames for one in found):
                raise
            unread.append(name)  # beside cameras that are read
        else:
            found += [layout] if layout else []
    if not found:
        inner = next((one for one in sorted(folder.glob("*/")) if any(one.glob("cameras*.npz"))), None)
        other = f"; name one of its folders, such as {inner}" if inner else ""
        raise BadInput(f"{folder} has no cameras that are known: {KNOWN}{other}")
    usable = [layout for layout in found if layout.frames]
    if not usable:
        raise BadInput(_no_images(folder, found))
    if images is not None and usable[0].format != "COLMAP":
        raise BadInput(f"dataset.images={images} is for COLMAP, and {folder} has {usable[0].format}: leave it out")
    others = ", ".join([*(layout.format for layout in found if layout is not usable[0]), *unread])
    notes = (*usable[0].notes, f"other cameras in the folder are not used: {others}") if others else usable[0].notes
    return replace(usable[0], notes=notes)


def _read(name: str, read: Callable[[], Layout | None], folder: Path) -> Layout | None:
    """What a format's reader finds; where a file of it is broken, an error that names the format.

    Raises:
        BadInput: where something is missing, or cannot be read.
    """
    try:
        return read()
    except FAULTS as error:
        files = (file for file in sorted(folder.rglob("*")) if file.is_file())
        pointer = next((f"{file} {what}" for file in files if "LFS" in (what := mistaken(file))), None)
        if pointer is not None:
            raise BadInput(pointer) from None
        if isinstance(error, BadInput):
            raise
        what = " ".join(str(error).split())
        raise BadInput(f"the {name} cameras of {folder} cannot be read ({what}): export them again") from error


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
