"""Masks: the object's pixels in an image that shows it white, in colours or opaque."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int
from PIL import Image

from datasets.captures.image import has_alpha, loaded
from renderers.checks import BadInput

HALF = 127  # of 255: brighter pixels of a grey mask are the object
COLOURED = 40  # of 255: channels of a mask that differ more are a colour, as colours that differ more are two
AT_BORDER = 0.1  # share of the border from which on a coloured mask has a black background, whatever touches the rest


def foreground(image: Image.Image, path: Path) -> Image.Image:
    """The object in a mask, white: by an alpha that varies, grey values, or colours unlike the border's.

    Args:
        path: of the mask, for messages.

    Raises:
        BadInput: where no pixel is bright, as in a mask of labels.
    """
    if has_alpha(image):
        alpha = image.convert("RGBA").getchannel("A")
        least, most = alpha.getextrema()
        if least < most:
            return alpha
    colours = np.asarray(image.convert("RGB")).astype(np.int16)
    if (np.ptp(colours, axis=-1) > COLOURED).any():
        return Image.fromarray((255 * _unlike_border(colours)).astype(np.uint8))
    grey = image.convert("L")
    if 0 < (most := grey.getextrema()[1]) <= HALF:
        raise BadInput(f"the mask {path} has values up to {most}, as labels do: write 255 on the object, 0 elsewhere")
    return grey


def _unlike_border(colours: Int[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """The pixels of other colours than the background: black where the border has it, else the border's commonest."""
    border = np.concatenate([colours[0], colours[-1], colours[:, 0], colours[:, -1]])
    values, counts = np.unique(border, axis=0, return_counts=True)
    dark = (border.max(axis=-1) <= COLOURED).mean() > AT_BORDER
    background = np.zeros(3) if dark else values[counts.argmax()]
    return np.abs(colours - background).max(axis=-1) > COLOURED


def opened_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """The object's pixels in an image that shows it white; raises BadInput where it cannot be read."""
    return np.asarray(foreground(loaded(path), path)) > HALF
