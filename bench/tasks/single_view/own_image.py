"""A picture of the user, framed like the training images, and the view in which a shape matches it best."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.tasks.single_view.images import as_input
from datasets.files.captures.mask import is_inverted, white_border_fractions
from datasets.files.captures.take import read_image
from datasets.mesh import Mesh
from datasets.scene import Truth, see
from datasets.shot import mask_iou
from renderers.camera import Camera
from renderers.checks import BadInput

MAX_PICTURE_PIXELS = 1024  # longer side; larger pictures are reduced
MIN_OBJECT_PIXELS = 16  # longer side of the object


def read_picture(path: Path, mask: Path | None, pixels: int, filled: float) -> tuple[Float[Tensor, "4 _ _"], list[str]]:
    """A picture as encoder input, cut so that the object fills a fraction of it; and warnings about it.

    Args:
        mask: path of the mask; None for the picture's alpha channel.
        pixels: height and width of the result.
        filled: see `filled_fraction`.

    Raises:
        BadInput: a file cannot be read, the mask is missing, or it does not fit the picture or an object.
    """
    colours, opaque = read_image(path, mask, MAX_PICTURE_PIXELS)
    if opaque is None:
        raise BadInput(f"{path} has no mask: give task.mask_path=FILE, white on the object, or an alpha channel")
    inside = torch.from_numpy(opaque[..., 0] > 0.5)
    if bool(inside.all()):
        raise BadInput(f"the mask {mask or path} is white everywhere: make it black beside the object")
    if not bool(inside.any()) or _box(inside)[2] < MIN_OBJECT_PIXELS:
        size = f"{MIN_OBJECT_PIXELS} pixels"
        raise BadInput(f"the mask {mask or path} shows no object of {size}: make it white on the object")
    if is_inverted(inside.numpy()):
        raise BadInput(f"the mask {mask or path} is white along the border, as an inverted one: make the object white")
    cut_off = [name for name, fraction in white_border_fractions(inside.numpy()).items() if fraction > 0]
    notes = [f"the object touches the border ({', '.join(cut_off)}): the network knows whole ones"] if cut_off else []
    channels = torch.from_numpy(np.concatenate([colours, opaque], axis=-1)).permute(2, 0, 1)
    cut = _framed(channels, inside, pixels, filled)
    return as_input(cut[:3].permute(1, 2, 0), cut[3] > 0.5), notes


def filled_fraction(masks: Bool[Tensor, "images height width"]) -> float:
    """The longer side of an object's box as a fraction of the image's side, the median over images."""
    return float(np.median([_box(mask)[2] / len(mask) for mask in masks]))


def best_view(
    mesh: Mesh, cameras: Sequence[Camera], mask: Bool[Tensor, "pixels pixels"], filled: float
) -> tuple[Camera, float]:
    """The camera with the best overlap between a mesh's silhouette, framed like the mask, and a mask; and its IoU."""
    truth, overlaps = Truth(mesh, closed=False), []
    for camera in cameras:
        hits = see(truth, camera).mask
        framed = _framed(hits[None].float(), hits, len(mask), filled)[0] > 0.5 if bool(hits.any()) else ~mask
        overlaps.append(mask_iou(framed.numpy(), mask.numpy()))
    best = int(np.argmax(overlaps))
    return cameras[best], overlaps[best]


def _box(mask: Bool[Tensor, "height width"]) -> tuple[float, float, int]:
    """The centre, as row and column, and the longer side of a mask's bounding box."""
    rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
    (top, bottom), (left, right) = (map(int, (indices.min(), indices.max() + 1)) for indices in (rows, columns))
    return (top + bottom) / 2, (left + right) / 2, max(bottom - top, right - left)


def _framed(
    channels: Float[Tensor, "channels height width"], mask: Bool[Tensor, "height width"], pixels: int, filled: float
) -> Float[Tensor, "channels _ _"]:
    """The square in which a mask's box fills the fraction `filled`, resized to `pixels`; 0 beyond the image."""
    row, column, longer = _box(mask)
    side = max(round(longer / filled), 1)
    top, left = round(row + side / 2), round(column + side / 2)  # in the image with a margin of `side`
    padded = torch.nn.functional.pad(channels, (side,) * 4)
    window = padded[:, top : top + side, left : left + side]
    return torch.nn.functional.interpolate(window[None], size=(pixels, pixels), mode="area")[0]
