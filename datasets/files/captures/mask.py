"""Masks: the object's pixels in an image that shows the object in white, in colours or opaque."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int
from PIL import Image

from datasets.files.captures.image import has_alpha, load_image
from renderers.checks import BadInput

MASK_THRESHOLD, COLOUR_DIFFERENCE = 127, 40  # out of 255; a pixel is coloured if its channels differ by more
MIN_BLACK_BORDER_FRACTION = 0.1  # the object or other colours may cover the rest of the border


def foreground(image: Image.Image, path: Path) -> Image.Image:
    """The object in a mask, in white: by a varying alpha channel, by grey values, or by colours unlike the border's.

    Raises:
        BadInput: no pixel is bright, as in a mask of labels; the message names `path`.
    """
    if has_alpha(image):
        alpha = image.convert("RGBA").getchannel("A")
        smallest, peak = alpha.getextrema()
        if smallest < peak:
            return alpha
    colours = np.asarray(image.convert("RGB")).astype(np.int16)
    if (np.ptp(colours, axis=-1) > COLOUR_DIFFERENCE).any():
        return Image.fromarray((255 * _unlike_border(colours)).astype(np.uint8))
    grey = image.convert("L")
    if 0 < (peak := grey.getextrema()[1]) <= MASK_THRESHOLD:
        raise BadInput(f"the mask {path} has values up to {peak}, as labels do: write 255 on the object, 0 elsewhere")
    return grey


def _unlike_border(colours: Int[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """The pixels unlike the background, which is black if the border is partly black, else its commonest colour."""
    border = np.concatenate([colours[0], colours[-1], colours[:, 0], colours[:, -1]])
    values, counts = np.unique(border, axis=0, return_counts=True)
    dark = (border.max(axis=-1) <= COLOUR_DIFFERENCE).mean() > MIN_BLACK_BORDER_FRACTION
    background = np.zeros(3) if dark else values[counts.argmax()]
    return np.abs(colours - background).max(axis=-1) > COLOUR_DIFFERENCE


def white_border_fractions(mask: Bool[np.ndarray, "height width"]) -> dict[str, float]:
    """The fraction of pixels on the object along each side of an image."""
    sides = {"top": mask[0], "bottom": mask[-1], "left": mask[:, 0], "right": mask[:, -1]}
    return {name: float(side.mean()) for name, side in sides.items()}


def is_inverted(mask: Bool[np.ndarray, "height width"]) -> bool:
    """Whether a mask is white along most of each side, as an inverted one."""
    return min(white_border_fractions(mask).values()) > 0.5


def load_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """Reads a mask, true on the object; raises BadInput if the file cannot be read."""
    return np.asarray(foreground(load_image(path), path)) > MASK_THRESHOLD
