"""Image files: their size, their orientation (EXIF), and their pixels as 8 bits a channel."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from datasets.files.readers.text import wrong_kind_message
from renderers.checks import BadInput

READ_ERRORS = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)  # Pillow's
WHITE_LEVELS = (255, 1023, 4095, 16383, 65535)  # the largest numbers in 8, 10, 12, 14 and 16 bits
EXIF_UPRIGHT, EXIF_SWAPPED = 1, 5  # orientations without a turn, and from which on width and height are swapped


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """An image whose pixels are not yet read; raises BadInput if the image or its pixels cannot be read."""
    try:
        with Image.open(path) as image:
            yield image
    except READ_ERRORS as error:
        pointer = path.is_file() and wrong_kind_message(path)
        raise BadInput(
            f"{path} {pointer or f'cannot be read as an image ({error}): copy or export it again'}"
        ) from None


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as it is stored; raises BadInput if it cannot be read."""
    with open_image(path) as image:
        return image.size


def exif_orientation(image: Image.Image) -> int:
    """The orientation of an image by its EXIF tag, upright without one."""
    return image.getexif().get(ExifTags.Base.Orientation, EXIF_UPRIGHT)


def white_level(paths: Sequence[Path]) -> int | None:
    """The white of images with numbers of more than 8 bits, by their largest number; None for other images."""
    largest = -1.0
    for path in paths:
        with open_image(path) as image:
            if image.mode.startswith("I"):
                largest = max(largest, float(np.asarray(image).max()))
    return next((level for level in WHITE_LEVELS if 0 <= largest <= level), None)


def load_image(path: Path, *, upright: bool = False, white: int | None = None) -> Image.Image:
    """Reads an image with 8 bits a channel.

    Args:
        upright: applies its orientation tag.
        white: the number of white in an image of more bits; None: that of 8 or 16 bits.
    """
    with open_image(path) as stored:
        stored.load()
        image = ImageOps.exif_transpose(stored) if upright else stored.copy()
    if image.mode.startswith("I") or image.mode == "F":  # 16 bits a channel
        values = np.asarray(image, np.float64)
        largest = 65535 if values.max() > 255 else 1 if image.mode == "F" and values.max() <= 1 else 255
        image = Image.fromarray((values * (255 / (white or largest))).astype(np.uint8))
    return image


def has_alpha(image: Image.Image) -> bool:
    return "A" in image.getbands() or "transparency" in image.info
