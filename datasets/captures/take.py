"""Reads a file's frame: its photograph, made smaller, without distortion."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import ExifTags, Image, ImageOps
from scipy.ndimage import map_coordinates
from torch import Tensor

from datasets.captures.frames import Frame, opened
from datasets.captures.lenses import Lens
from datasets.extras import install
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

BACKGROUND = 1.0  # behind an image with an alpha channel: white, as NeRF has it
LABELS, HALF = 32, 127  # a mask whose largest value, or number of them, is small has labels; 0 is the background
COLOURED = 40  # of 255: channels of a mask that differ more are a colour, as colours that differ more are two
AT_BORDER = 0.1  # share of the border from which on a coloured mask has a black background, whatever touches the rest
UPRIGHT, SIDEWAYS = 1, 5  # orientations of EXIF: the one that turns nothing; the first that swaps width and height


def take(frame: Frame, longest: int) -> Shot:
    """Reads a frame's photograph, with at most `longest` pixels along its longer side, and a camera in float64.

    Raises:
        BadInput: where a file cannot be read, or image, mask and camera have different shapes.
    """
    turned = bool(_turns(frame))
    image = _opened(frame.image, upright=turned)
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
    depth = None if frame.depth is None else _depths(*frame.depth, size)
    if frame.lens.bends:
        colours = _undistorted(colours, intrinsics, frame.lens)
        opaque = None if opaque is None else _undistorted(opaque, intrinsics, frame.lens)
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
        (width, height), tag = image.size, _tag(image)
    if tag == UPRIGHT:
        return None
    turned = (height, width) if tag >= SIDEWAYS else (width, height)
    return frame.size is not None and not _alike((width, height), frame.size) and _alike(turned, frame.size)


def _alike(size: tuple[int, int], wanted: tuple[int, int]) -> bool:
    """Whether width and height have the shape of height and width, but for what rounding to pixels changes."""
    shape = wanted[1] / wanted[0]
    return abs(size[0] - size[1] * shape) <= 1 + shape


def _tag(image: Image.Image) -> int:
    """Its orientation, as EXIF has it."""
    return image.getexif().get(ExifTags.Base.Orientation, UPRIGHT)


def read_image(
    path: Path, mask: Path | None, longest: int
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """Colours and mask of an image, each from 0 to 1; the mask is a file's, or the image's alpha channel, or None.

    Args:
        longest: most pixels along the longer side.

    Raises:
        BadInput: where a file cannot be read, or image and mask have different sizes.
    """
    return _smaller(_opened(path, upright=True), mask, longest, upright=True)


def _smaller(
    image: Image.Image, mask: Path | None, longest: int, *, upright: bool
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """See `read_image`; whether the mask is turned by its tag, as the image was."""
    share = min(longest / max(image.width, image.height), 1.0)
    size = max(round(image.width * share), 1), max(round(image.height * share), 1)
    alpha = "A" in image.getbands() or "transparency" in image.info
    pixels = np.asarray(image.convert("RGBA" if alpha else "RGB").resize(size, Image.Resampling.BOX), np.float32) / 255
    colours, opaque = pixels[..., :3], pixels[..., 3:] if alpha and pixels[..., 3].min() < 1 else None
    if opaque is not None:
        colours = colours * opaque + BACKGROUND * (1 - opaque)
    if mask is None:
        return colours, opaque
    shape = _opened(mask, upright=upright)
    if shape.size != image.size:
        tag = "" if upright or _tag(image) == UPRIGHT else "; the image's tag of orientation (EXIF) is not applied"
        raise BadInput(
            f"{mask} has {shape.width} x {shape.height} pixels, its image {image.width} x {image.height}: a mask has "
            f"the size of its image{tag}"
        )
    return colours, np.asarray(_foreground(shape).resize(size, Image.Resampling.BOX), np.float32)[..., None] / 255


def _opened(path: Path, *, upright: bool = False) -> Image.Image:
    """An image with 8 bits a channel; whether its tag of orientation is applied."""
    with opened(path) as stored:
        stored.load()
        image = ImageOps.exif_transpose(stored) if upright else stored.copy()
    if image.mode.startswith("I") or image.mode == "F":  # 16 bits a channel
        values = np.asarray(image, np.float64)
        most = 65535 if values.max() > 255 else 1 if image.mode == "F" and values.max() <= 1 else 255
        image = Image.fromarray((values * (255 / most)).astype(np.uint8))
    return image


def _foreground(image: Image.Image) -> Image.Image:
    """The object in a mask, white: by an alpha that varies, grey values, labels, or colours unlike the border's."""
    if "A" in image.getbands() or "transparency" in image.info:
        alpha = image.convert("RGBA").getchannel("A")
        least, most = alpha.getextrema()
        if least < most:
            return alpha
    colours = np.asarray(image.convert("RGB")).astype(np.int16)
    if (np.ptp(colours, axis=-1) > COLOURED).any():
        return Image.fromarray((255 * _unlike_border(colours)).astype(np.uint8))
    values = np.asarray(image.convert("L"))
    if 0 < values.max() <= HALF and (values.max() < LABELS or len(np.unique(values)) < LABELS):
        values = (255 * (values > 0)).astype(np.uint8)
    elif LABELS <= values.min() < values.max():  # a grey background
        values = ((values - values.min()) * (255 / (values.max() - values.min()))).astype(np.uint8)
    return Image.fromarray(values)


def _unlike_border(colours: Int[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """The pixels of other colours than the background: black where the border has it, else the border's commonest."""
    border = np.concatenate([colours[0], colours[-1], colours[:, 0], colours[:, -1]])
    values, counts = np.unique(border, axis=0, return_counts=True)
    dark = (border.max(axis=-1) <= COLOURED).mean() > AT_BORDER
    background = np.zeros(3) if dark else values[counts.argmax()]
    return np.abs(colours - background).max(axis=-1) > COLOURED


def opened_mask(path: Path) -> Bool[np.ndarray, "height width"]:
    """The object's pixels in an image that shows it white; raises BadInput where it cannot be read."""
    return np.asarray(_foreground(_opened(path))) > HALF


def _depths(path: Path, unit: float, size: tuple[int, int]) -> Float[Tensor, "height width"]:
    """Camera z of the nearest pixel of a file of depths, 0 where it is not known; raises as `stored_depths` does."""
    depths = stored_depths(path, "remove the folder of depths")
    known = np.isfinite(depths) & (depths > 0)
    image = Image.fromarray(np.where(known, depths * unit, 0).astype(np.float32))
    return torch.from_numpy(np.array(image.resize(size, Image.Resampling.NEAREST)))


def stored_depths(path: Path, otherwise: str) -> Float[np.ndarray, "height width"]:
    """The first channel of a file of depths, such as an EXR, as OpenCV reads it.

    Args:
        otherwise: what else can be done where it cannot be read.

    Raises:
        BadInput: where OpenCV is not installed, or the file cannot be read.
    """
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # OpenCV reads it with the first file
    try:
        import cv2
    except ImportError as error:
        raise BadInput(f"{path} is read by OpenCV: {install('stereo')}, or {otherwise}") from error
    try:
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        stored = None
    if stored is None:
        raise BadInput(f"{path} cannot be read as depths: copy it again, or {otherwise}")
    return stored.reshape(*stored.shape[:2], -1)[..., 0].astype(np.float64)


def _undistorted(
    image: Float[np.ndarray, "height width channels"], intrinsics: Float[np.ndarray, "3 3"], lens: Lens
) -> Float[np.ndarray, "height width channels"]:
    """The image that a pinhole camera of these intrinsics takes."""
    rows, columns = np.meshgrid(np.arange(image.shape[0]) + 0.5, np.arange(image.shape[1]) + 0.5, indexing="ij")
    y = (rows - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (columns - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    bent_x, bent_y = lens.bend(x, y)
    across = bent_x * intrinsics[0, 0] + bent_y * intrinsics[0, 1] + intrinsics[0, 2]
    places = np.stack([bent_y * intrinsics[1, 1] + intrinsics[1, 2] - 0.5, across - 0.5])
    channels = [map_coordinates(image[..., i], places, order=1, mode="nearest") for i in range(image.shape[2])]
    return np.stack(channels, axis=-1)
