"""Detects the format of a folder of photographs with cameras, and reads the folder."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from zipfile import BadZipFile

from datasets.files.captures import formats
from datasets.files.captures.frames import Format, Layout
from datasets.files.captures.pairing import natural_key
from datasets.files.readers.text import wrong_kind_message
from renderers.checks import BadInput

READ_ERRORS = (OSError, ValueError, LookupError, TypeError, ArithmeticError, EOFError, MemoryError, BadZipFile)
READ_ERRORS += (RuntimeError,)


@cache
def known_formats() -> list[Format]:
    """The formats of the files in `captures/formats`, in the order in which they are tried."""
    listed = []
    for module in iter_modules(formats.__path__):
        try:
            listed.append(import_module(f"{formats.__name__}.{module.name}").FORMAT)
        except (ImportError, AttributeError, SyntaxError) as error:
            raise BadInput(f"captures/formats/{module.name}.py cannot be used: {error}") from error
    return sorted(listed, key=lambda format: format.rank)


def find_layout(folder: Path, images: str | None = None, *, masks: bool = True) -> Layout:
    """Reads the photographs of a folder, in the first of `known_formats` with cameras and images in the folder.

    Args:
        images: the folder of COLMAP's images, in `folder` or elsewhere; None for the usual folders.
        masks: whether masks are read.

    Raises:
        BadInput: no format fits, an image has no camera, or a file cannot be read.
    """
    if not folder.is_dir():
        what = f"{folder} is a file" if folder.exists() else f"there is no folder {folder}"
        raise BadInput(f"{what}: name the folder that has the photographs and their cameras")
    candidates = [(format, files) for format in known_formats() if (files := _files(folder, format.camera_files))]
    if not candidates:
        subfolder = next((path for path in sorted(folder.glob("*/")) if any(path.glob("cameras*.npz"))), None)
        supported = ", ".join(format.description for format in known_formats())
        other = f"; name one of its folders, such as {subfolder}" if subfolder else ""
        raise BadInput(f"{folder} has no cameras that are known: {supported}{other}")
    layouts_without_images = list[Layout]()
    for format, files in candidates:
        extra = {"images": images} if format.takes_images else {}
        read = partial(format.read, folder, files, masks, **extra)
        layout = _read(f"{format.name} cameras of {files[0]}", read, folder)
        if layout.frames:
            if images is not None and not format.takes_images:
                raise BadInput(f"dataset.images={images} is for COLMAP, and {folder} has {layout.format}: leave it out")
            others = [str(paths[0].relative_to(folder)) for other, paths in candidates if other != format]
            notes = (f"other cameras in the folder are not used: {', '.join(others)}",) if others else ()
            return replace(layout, notes=(*layout.notes, *notes))
        layouts_without_images.append(layout)
    raise BadInput(_no_images_message(folder, layouts_without_images))


def _files(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """The files of a folder that match the patterns, in their order, number 10 after 9, without hidden files."""
    matches = [sorted(folder.glob(pattern), key=lambda file: natural_key(str(file))) for pattern in patterns]
    return [file for files in matches for file in files if file.is_file() and not file.name.startswith(".")]


def _read(what: str, read: Callable[[], Layout], folder: Path) -> Layout:
    """The layout from the reader of a format.

    Raises:
        BadInput: something is missing or cannot be read; the message names `what`, or a file with a Git LFS pointer.
    """
    try:
        return read()
    except READ_ERRORS as error:
        files = (file for file in sorted(folder.rglob("*")) if file.is_file())
        pointer = next((f"{file} {kind}" for file in files if "LFS" in (kind := wrong_kind_message(file))), None)
        if pointer is not None:
            raise BadInput(pointer) from None
        if isinstance(error, BadInput):
            raise
        why = " ".join(str(error).split())
        raise BadInput(f"the {what} cannot be read ({why}): export them again") from error


def _no_images_message(folder: Path, layouts: list[Layout]) -> str:
    """The message about a folder whose cameras have no images."""
    names = ", ".join(layout.format for layout in layouts)
    missing = next((f", such as {layout.example_image}" for layout in layouts if layout.example_image), "")
    files = [file for file in folder.rglob("*") if file.is_file() and not file.name.startswith(".")]
    kinds = ", ".join(sorted({file.suffix for file in files if file.suffix}))
    return (
        f"{folder} has cameras ({names}) but none of their images{missing}; its files end with {kinds}: copy the "
        "images to where the cameras name them, as .png, .jpg, .tif, .webp or .bmp"
    )
