"""Reads a file's frame: its photograph, made smaller, without distortion."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from datasets.captures.depth import depths_at
from datasets.captures.frames import Frame
from datasets.captures.image import SIDEWAYS, UPRIGHT, has_alpha, loaded, opened, orientation
from datasets.captures.mask import foreground
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

BACKGROUND = 1.0  # behind an image with an alpha channel: white, as NeRF has it


def take(frame: Frame, longest: int) -> Shot:
    """Reads a frame's photograph, with at most `longest` pixels along its longer side, and a camera in float64.

    Raises:
        BadInput: where a file cannot be read, or image, mask and camera have different shapes.
    """
    turned = bool(_turns(frame))
    image = loaded(frame.image, upright=turned)
    height, width = frame.size or (image.height, image.width)
    if not _alike(image.size, (height, width)):
        raise BadInput(
            f"{frame.image} has {image.width} x {image.height} pixels, its camera {width} x {height}: crop neither, or "
            "write the camera for this image"
        )
    colours, opaque = _smaller(image, frame.mask, longest, upright=turned)
    size = colours.shape[1], colours.shape[0]
    scale = np.array([[size[0] / width], [size[1] / height], [1.0]])
    intrinsics = scale * frame.intrinsics
    depth = None if frame.depth is None else depths_at(*frame.depth, size)
    if frame.lens.bends:
        colours = frame.lens.undistorted(colours, intrinsics)
        opaque = None if opaque is None else frame.lens.undistorted(opaque, intrinsics)
    try:
        camera = Camera(torch.from_numpy(intrinsics), torch.from_numpy(frame.world_to_camera), size[1], size[0])
    except ValueError as error:
        raise BadInput(f"the camera of {frame.image}: {error}") from None
    mask = None if opaque is None else torch.from_numpy(opaque[..., 0] > 0.5)
    return Shot(frame.image.name, camera, torch.from_numpy(np.ascontiguousarray(colours)), mask, depth)


def turning_notes(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Notes on images with a tag of orientation (EXIF): cameras are of stored pixels, unless their sizes differ."""
    turned = [turns for frame in frames if (turns := _turns(frame)) is not None]
    notes, left = [], turned.count(False)
    if left:
        notes.append(f"{left} photographs have a tag of orientation (EXIF), and are used as stored, as cameras are")
    if any(turned):
        notes.append(f"{sum(turned)} photographs are turned by their tag (EXIF), since their cameras have that size")
    return tuple(notes)


def _turns(frame: Frame) -> bool | None:
    """Whether a frame's image is turned by its tag: where its camera has the size of the turned one alone.

    None where it has no such tag.
    """
    with opened(frame.image) as image:
        (width, height), tag = image.size, orientation(image)
    if tag == UPRIGHT:
        return None
    turned = (height, width) if tag >= SIDEWAYS else (width, height)
    return frame.size is not None and not _alike((width, height), frame.size) and _alike(turned, frame.size)


def _alike(size: tuple[int, int], wanted: tuple[int, int]) -> bool:
    """Whether width and height have the shape of height and width, but for what rounding to pixels changes."""
    shape = wanted[1] / wanted[0]
    return abs(size[0] - size[1] * shape) <= 1 + shape


def read_image(
    path: Path, mask: Path | None, longest: int
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """Colours and mask of an image, each from 0 to 1; the mask is a file's, or the image's alpha channel, or None.

    Args:
        longest: most pixels along the longer side.

    Raises:
        BadInput: where a file cannot be read, or image and mask have different sizes.
    """
    return _smaller(loaded(path, upright=True), mask, longest, upright=True)


def _smaller(
    image: Image.Image, mask: Path | None, longest: int, *, upright: bool
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """See `read_image`; whether the mask is turned by its tag, as the image was."""
    share = min(longest / max(image.width, image.height), 1.0)
    size = max(round(image.width * share), 1), max(round(image.height * share), 1)
    alpha = has_alpha(image)
    pixels = np.asarray(image.convert("RGBA" if alpha else "RGB").resize(size, Image.Resampling.BOX), np.float32) / 255
    colours, opaque = pixels[..., :3], pixels[..., 3:] if alpha and pixels[..., 3].min() < 1 else None
    if opaque is not None:
        colours = colours * opaque + BACKGROUND * (1 - opaque)
    if mask is None:
        return colours, opaque
    shape = loaded(mask, upright=upright)
    if shape.size != image.size:
        turned = not upright and orientation(image) != UPRIGHT
        tag = "; the image's tag of orientation (EXIF) is not applied" if turned else ""
        raise BadInput(
            f"{mask} has {shape.width} x {shape.height} pixels, its image {image.width} x {image.height}: a mask has "
            f"the size of its image{tag}"
        )
    return colours, np.asarray(foreground(shape, mask).resize(size, Image.Resampling.BOX), np.float32)[..., None] / 255
