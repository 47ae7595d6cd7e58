"""Reads the photograph of a frame, downscaled and without distortion."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from datasets.files.captures.depth import check_object_depths, load_depths, missing_note
from datasets.files.captures.frames import Frame
from datasets.files.captures.image import (
    EXIF_SWAPPED,
    EXIF_UPRIGHT,
    exif_orientation,
    has_alpha,
    load_image,
    open_image,
    white_level,
)
from datasets.files.captures.mask import foreground
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

ALPHA_BACKGROUND = 1.0  # white, as in NeRF
DARK_LEVEL = 0.1  # numbers of 12 bits reach 1/16 of white, if they are read as 16 bits


def read_shot(frame: Frame, longest: int) -> Shot:
    """The photograph of a frame; see `read_shots`."""
    return _read_shot(frame, longest)[0]


def read_shots(frames: Sequence[Frame], longest: int) -> tuple[list[Shot], tuple[str, ...]]:
    """Photographs with cameras in float64, at most `longest` pixels along the longer side, and notes.

    Notes are on depths that are none, on the bits of images that do not use all of 16, and on dark images.

    Raises: as `read_shot`.
    """
    white = white_level([frame.image for frame in frames])
    pairs = [_read_shot(frame, longest, white) for frame in frames]
    shots = [shot for shot, _ in pairs]
    notes = missing_note(sum((missing for _, missing in pairs), Counter()))
    if white not in (None, 255, 65535):
        notes += (f"no photograph has a number above {white}: they are read as of {white.bit_length()} bits, not 16",)
    colours = [shot.colours if shot.mask is None else shot.colours[shot.mask] for shot in shots]
    brightest = max(float(colour.max()) for colour in colours if colour.numel()) if any(map(len, colours)) else 1.0
    if 0 < brightest < DARK_LEVEL:
        notes += (
            f"the brightest colour of all photographs is {brightest:.2g} of white: scale numbers of 12 bits to 16",
        )
    return shots, notes


def _read_shot(frame: Frame, longest: int, white: int | None = None) -> tuple[Shot, Counter[str]]:
    """A frame's photograph, and the pixels of its depth file by the numbers that stand for no depth.

    Raises:
        BadInput: a file cannot be read, or image, mask and camera have different aspect ratios.
    """
    upright = bool(_applies_exif(frame))
    image = load_image(frame.image, upright=upright, white=white)
    height, width = frame.size or (image.height, image.width)
    if not _same_aspect(image.size, (height, width)):
        raise BadInput(
            f"{frame.image} has {image.width} x {image.height} pixels, its camera {width} x {height}: crop neither, or "
            "write the camera for this image"
        )
    colours, opacity = _downscale(image, frame.mask, longest, upright=upright)
    size = colours.shape[1], colours.shape[0]
    scale = np.array([[size[0] / width], [size[1] / height], [1.0]])
    intrinsics = scale * frame.intrinsics
    depth, missing = (None, Counter()) if frame.depth is None else load_depths(*frame.depth, size)
    if frame.lens.has_distortion:
        colours = frame.lens.undistort(colours, intrinsics)
        opacity = None if opacity is None else frame.lens.undistort(opacity, intrinsics)
    try:
        camera = Camera(torch.from_numpy(intrinsics), torch.from_numpy(frame.world_to_camera), size[1], size[0])
    except ValueError as error:
        raise BadInput(f"the camera of {frame.image}: {error}") from None
    mask = None if opacity is None else torch.from_numpy(opacity[..., 0] > 0.5)
    covered = None
    if opacity is not None:  # relative to its maximum, or to 0.5 if that is smaller: some masks have a darker white
        covered = torch.from_numpy(np.ascontiguousarray(opacity[..., 0] / max(float(opacity[..., 0].max()), 0.5)))
    if frame.depth is not None and depth is not None and mask is not None:
        check_object_depths(depth[mask & (depth > 0)].double().numpy(), frame.depth[0])
    stored = torch.from_numpy(np.ascontiguousarray(colours))
    return Shot(frame.image.name, camera, stored, mask, depth, covered=covered), missing


def exif_notes(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Notes on images with an orientation tag (EXIF), which is applied only if the camera has the turned size."""
    applied = [upright for frame in frames if (upright := _applies_exif(frame)) is not None]
    notes, ignored = [], applied.count(False)
    if ignored:
        notes.append(f"{ignored} photographs have a tag of orientation (EXIF), and are used as stored, as cameras are")
    if any(applied):
        notes.append(f"{sum(applied)} photographs are turned by their tag (EXIF), since their cameras have that size")
    return tuple(notes)


def _applies_exif(frame: Frame) -> bool | None:
    """Whether an image is turned by its tag, because its camera fits only the turned image; None without a tag."""
    with open_image(frame.image) as image:
        (width, height), tag, camera_size = image.size, exif_orientation(image), frame.size
    if tag == EXIF_UPRIGHT:
        return None
    upright = (height, width) if tag >= EXIF_SWAPPED else (width, height)
    if camera_size is None or _same_aspect((width, height), camera_size):
        return False
    return _same_aspect(upright, camera_size)


def _same_aspect(size: tuple[int, int], camera_size: tuple[int, int]) -> bool:
    """Whether (width, height) and (height, width) have the same aspect ratio, up to rounding to pixels."""
    aspect = camera_size[1] / camera_size[0]
    return abs(size[0] - size[1] * aspect) <= 1 + aspect


def read_image(
    path: Path, mask: Path | None, longest: int
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """Colours and mask of an image, from 0 to 1; the mask is from a file or the image's alpha channel, or None.

    Args:
        longest: maximum number of pixels along the longer side.

    Raises:
        BadInput: a file cannot be read, or image and mask have different sizes.
    """
    return _downscale(load_image(path, upright=True), mask, longest, upright=True)


def _downscale(
    image: Image.Image, mask: Path | None, longest: int, *, upright: bool
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """See `read_image`; `upright` applies the orientation tag of the mask, as it was applied to the image."""
    factor = min(longest / max(image.width, image.height), 1.0)
    size = max(round(image.width * factor), 1), max(round(image.height * factor), 1)
    alpha = has_alpha(image)
    pixels = np.asarray(image.convert("RGBA" if alpha else "RGB").resize(size, Image.Resampling.BOX), np.float32) / 255
    colours, opacity = pixels[..., :3], pixels[..., 3:] if alpha and pixels[..., 3].min() < 1 else None
    if opacity is not None:
        colours = colours * opacity + ALPHA_BACKGROUND * (1 - opacity)
    if mask is None:
        return colours, opacity
    stored = load_image(mask, upright=upright, white=white_level([mask]))
    if stored.size != image.size:
        tag_ignored = not upright and exif_orientation(image) != EXIF_UPRIGHT
        tag = "; the image's tag of orientation (EXIF) is not applied" if tag_ignored else ""
        raise BadInput(
            f"{mask} has {stored.width} x {stored.height} pixels, its image {image.width} x {image.height}: a "
            f"mask has the size of its image{tag}"
        )
    return colours, np.asarray(foreground(stored, mask).resize(size, Image.Resampling.BOX), np.float32)[..., None] / 255
