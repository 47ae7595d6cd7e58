"""Image files: their size, their orientation (EXIF), and their pixels, whichever their bits."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from datasets.readers.text import mistaken
from renderers.checks import BadInput

UNREADABLE = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)  # what Pillow says of a broken image
UPRIGHT, SIDEWAYS = 1, 5  # orientations of EXIF: the one that turns nothing; the first that swaps width and height


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """An image whose pixels are not yet read; raises BadInput where it, or what is asked of it, cannot be read."""
    try:
        with Image.open(path) as image:
            yield image
    except UNREADABLE as error:
        pointer = path.is_file() and mistaken(path)
        raise BadInput(
            f"{path} {pointer or f'cannot be read as an image ({error}): copy or export it again'}"
        ) from None


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as it is stored; raises BadInput where it cannot be read."""
    with opened(path) as image:
        return image.size


def orientation(image: Image.Image) -> int:
    """How an image is turned, as EXIF has it."""
    return image.getexif().get(ExifTags.Base.Orientation, UPRIGHT)


def loaded(path: Path, *, upright: bool = False) -> Image.Image:
    """An image with 8 bits a channel; whether its tag of orientation is applied."""
    with opened(path) as stored:
        stored.load()
        image = ImageOps.exif_transpose(stored) if upright else stored.copy()
    if image.mode.startswith("I") or image.mode == "F":  # 16 bits a channel
        values = np.asarray(image, np.float64)
        most = 65535 if values.max() > 255 else 1 if image.mode == "F" and values.max() <= 1 else 255
        image = Image.fromarray((values * (255 / most)).astype(np.uint8))
    return image


def has_alpha(image: Image.Image) -> bool:
    """Whether an image says how opaque its pixels are."""
    return "A" in image.getbands() or "transparency" in image.info
