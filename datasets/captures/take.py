"""Reads a file's frame: its photograph, made smaller, without distortion."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageOps, UnidentifiedImageError
from scipy.ndimage import map_coordinates

from datasets.captures.formats import Frame
from datasets.shot import Shot
from renderers.camera import Camera
from renderers.checks import BadInput

BACKGROUND = 1.0  # behind an image with an alpha channel: white, as NeRF has it
LABELS = 32  # a mask whose largest value is below has labels, not grey values
SAME_SHAPE = 0.01  # most by which width over height of an image may differ from those of its camera, as a share


def take(frame: Frame, longest: int) -> Shot:
    """Reads a frame's photograph, with at most `longest` pixels along its longer side.

    Raises:
        BadInput: where a file cannot be read, or image, mask and camera have different shapes.
    """
    image = _opened(frame.image)
    height, width = frame.size or (image.height, image.width)
    if abs(image.width * height / (image.height * width) - 1) > SAME_SHAPE:
        raise BadInput(
            f"{frame.image} has {image.width} x {image.height} pixels, its camera {width} x {height}: crop neither, or "
            "write the camera for this image"
        )
    colours, opaque = _smaller(image, frame.mask, longest)
    size = colours.shape[1], colours.shape[0]
    scale = np.array([[size[0] / width], [size[1] / height], [1.0]])
    intrinsics = scale * frame.intrinsics
    if any(frame.distortion):
        colours = _undistorted(colours, intrinsics, frame.distortion)
        opaque = None if opaque is None else _undistorted(opaque, intrinsics, frame.distortion)
    matrices = (torch.from_numpy(matrix).float() for matrix in (intrinsics, frame.world_to_camera))
    try:
        camera = Camera(*matrices, size[1], size[0])
    except ValueError as error:
        raise BadInput(f"the camera of {frame.image}: {error}") from None
    mask = None if opaque is None else torch.from_numpy(opaque[..., 0] > 0.5)
    return Shot(frame.image.name, camera, torch.from_numpy(np.ascontiguousarray(colours)), mask)


def read_image(
    path: Path, mask: Path | None, longest: int
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """Colours and mask of an image, each from 0 to 1; the mask is a file's, or the image's alpha channel, or None.

    Args:
        longest: most pixels along the longer side.

    Raises:
        BadInput: where a file cannot be read, or image and mask have different sizes.
    """
    return _smaller(_opened(path), mask, longest)


def _smaller(
    image: Image.Image, mask: Path | None, longest: int
) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width 1"] | None]:
    """See `read_image`."""
    share = min(longest / max(image.width, image.height), 1.0)
    size = max(round(image.width * share), 1), max(round(image.height * share), 1)
    alpha = "A" in image.getbands() or "transparency" in image.info
    pixels = np.asarray(image.convert("RGBA" if alpha else "RGB").resize(size, Image.Resampling.BOX), np.float32) / 255
    colours, opaque = pixels[..., :3], pixels[..., 3:] if alpha and pixels[..., 3].min() < 1 else None
    if opaque is not None:
        colours = colours * opaque + BACKGROUND * (1 - opaque)
    return colours, opaque if mask is None else _mask(mask, (image.width, image.height), size)


def _opened(path: object) -> Image.Image:
    try:
        image = ImageOps.exif_transpose(Image.open(str(path)))
        image.load()
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise BadInput(f"{path} cannot be read as an image ({error}): copy or export it again") from None
    if image.mode.startswith("I") or image.mode == "F":  # 16 bits a channel
        values = np.asarray(image, np.float64)
        image = Image.fromarray((values * (255 / (65535 if values.max() > 255 else 255))).astype(np.uint8))
    return image


def _mask(path: Path, full: tuple[int, int], size: tuple[int, int]) -> Float[np.ndarray, "height width 1"]:
    """A file's mask, from 0 to 1, made smaller with its photograph, which has `full` pixels."""
    image = _opened(path)
    if (image.width, image.height) != full:
        raise BadInput(
            f"{path} has {image.width} x {image.height} pixels, its image {full[0]} x {full[1]}: a mask has the "
            "size of its image"
        )
    grey = image.getchannel("A") if image.mode in ("LA", "RGBA") and image.getextrema()[-1][0] < 255 else image
    values = np.asarray(grey.convert("L"))
    if 0 < values.max() < LABELS:  # labels, 0 the background
        values = (255 * (values > 0)).astype(np.uint8)
    return np.asarray(Image.fromarray(values).resize(size, Image.Resampling.BOX), np.float32)[..., None] / 255


def _undistorted(
    image: Float[np.ndarray, "height width channels"],
    intrinsics: Float[np.ndarray, "3 3"],
    distortion: tuple[float, ...],
) -> Float[np.ndarray, "height width channels"]:
    """The image that a pinhole camera of these intrinsics takes (Brown's model, as OpenCV writes it)."""
    k1, k2, p1, p2 = distortion
    focal, middle = intrinsics[[0, 1], [0, 1]], intrinsics[:2, 2]
    rows, columns = np.meshgrid(np.arange(image.shape[0]) + 0.5, np.arange(image.shape[1]) + 0.5, indexing="ij")
    x, y = (columns - middle[0]) / focal[0], (rows - middle[1]) / focal[1]
    square = x**2 + y**2
    radial = 1 + k1 * square + k2 * square**2
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2)
    bent_y = y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y
    places = np.stack([bent_y * focal[1] + middle[1] - 0.5, bent_x * focal[0] + middle[0] - 0.5])
    channels = [map_coordinates(image[..., i], places, order=1, mode="nearest") for i in range(image.shape[2])]
    return np.stack(channels, axis=-1)
