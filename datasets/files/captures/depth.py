"""Files of depths: an `.npy`, an `.npz`, a PNG of 16 bits, or an EXR, a TIFF or another format that OpenCV reads."""

import os
import zlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from PIL import Image
from torch import Tensor

from datasets.extras import install_command
from datasets.files.captures.image import open_image
from datasets.files.readers.text import wrong_kind_message
from renderers.checks import BadInput

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".gif", ".webp")
RADIANCE_SUFFIX = ".hdr"
DEPTH_MODES = ("I;16", "I;16L", "I;16B", "I;16N", "I", "F")  # Pillow's, with one number of 16 bits or more per pixel
STRETCHED_BYTE_FACTORS = (256, 257)  # from 8 to 16 bits
MIN_STRETCHED_VALUES = 20  # fewer different values may have such a factor by chance
NO_DEPTH_VALUES = (65535.0, 65504.0)  # the largest numbers of 16 bits, of integers and of floats
MIN_NO_DEPTH_MAGNITUDE = 1e7  # Blender's background is 1e10, mixed with less along outlines; or the largest float
MAX_LISTED_VALUES = 3
EXR_MAGIC, EXR_CHANNELS = b"\x76\x2f\x31\x01", b"channels\0chlist\0"
EXR_BYTES_PER_CHANNEL = 16  # after its name
MAX_DEPTH_RATIO = 20.0  # from the object's nearest pixels, up to `NEAR_FRACTION`, to its farthest pixel
NEAR_FRACTION = 0.05
MAX_BACKGROUND_RATIO = 2.0  # between the largest depth, if many pixels share it, and the next one
MIN_SHARED_FRACTION, MIN_SHARED_PIXELS = 0.01, 10
FORMATS = "save camera z as an .npy, an .npz with one array or an array 'depth', an EXR, or a PNG of 16 bits"


@dataclass(frozen=True)
class Depths:
    """The numbers of a depth file.

    Args:
        values: 0 at pixels without depth.
        missing: how many pixels hold each other number that stands for no depth.
    """

    values: Float[np.ndarray, "height width"]
    missing: Counter[str]


def missing_note(missing: Counter[str]) -> tuple[str, ...]:
    """A note on numbers that stand for no depth, and their pixels; none without such pixels."""
    listed = ", ".join(f"{number} ({count})" for number, count in missing.most_common(MAX_LISTED_VALUES))
    return (f"numbers that stand for no depth, and their pixels: {listed}",) if missing else ()


def load_depths(path: Path, unit: float, size: tuple[int, int]) -> tuple[Float[Tensor, "height width"], Counter[str]]:
    """Camera z of a depth file, resized to width and height `size`, 0 if unknown, and `Depths.missing`.

    Raises as `read_depths`.
    """
    depths = read_depths(path, "remove the folder of depths")
    image = Image.fromarray((depths.values * unit).astype(np.float32))
    return torch.from_numpy(np.array(image.resize(size, Image.Resampling.NEAREST))), depths.missing


def read_depths(path: Path, remedy: str = FORMATS) -> Depths:
    """The depths of a file, which has one number per pixel; messages end with `remedy`.

    Raises:
        BadInput: the file cannot be read, is a picture, has several arrays or channels, or has negative depths.
    """
    if path.suffix.lower() in PICTURE_SUFFIXES:
        stored = _picture_numbers(path, remedy)
    else:
        stored = _array(path, remedy) if path.suffix.lower() in (".npy", ".npz") else _opencv_numbers(path, remedy)
    if path.suffix.lower() == RADIANCE_SUFFIX:
        raise BadInput(f"{path} has 8 bits per number, with a common exponent, which is too coarse: {remedy}")
    if stored.dtype.kind not in "uif" or stored.dtype.itemsize < 2:
        raise BadInput(f"{path} has numbers of type {stored.dtype}, as a picture or a mask, not depths: {remedy}")
    if stored.squeeze().ndim != 2:
        raise BadInput(f"{path} must hold one number for a pixel, not an array of shape {list(stored.shape)}: {remedy}")
    stored = stored.squeeze()
    different = np.unique(stored) if stored.dtype.kind != "f" else ()
    if len(different) >= MIN_STRETCHED_VALUES and int(np.gcd.reduce(different)) in STRETCHED_BYTE_FACTORS:
        raise BadInput(f"{path} has numbers of 8 bits, stretched to 16, as a picture of depth: {remedy}")
    missing = missing_numbers(stored)
    numbers = stored.astype(np.float64)
    negative = (numbers < 0) & ~missing
    if negative.any() and (numbers > 0).any() and np.ptp(numbers[negative]) == 0:  # a single number, such as -1
        missing |= negative
    elif negative.any():
        raise BadInput(
            f"{path} has negative depths, at {negative.sum()} pixels and down to {numbers[negative].min():.4g}: "
            "camera z is positive in front of the camera. If they are OpenGL's z, save minus these numbers"
        )
    values, counts = np.unique(numbers[missing & (numbers != 0)], return_counts=True)
    counted = Counter({f"{value:.6g}": int(count) for value, count in zip(values, counts, strict=True)})
    return Depths(np.where(missing, 0.0, numbers), counted)


def missing_numbers(stored: Shaped[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """The stored numbers that stand for no depth: 0, those that are not finite, and the largest of common types."""
    missing = ~np.isfinite(stored) | (stored == 0) | (np.abs(stored.astype(np.float64)) >= MIN_NO_DEPTH_MAGNITUDE)
    largest = () if stored.dtype.kind == "f" else (np.iinfo(stored.dtype).max,)
    return missing | np.isin(stored, (*NO_DEPTH_VALUES, *largest))


def check_object_depths(depths: Float[np.ndarray, " pixels"], path: Path) -> None:
    """Raises BadInput if some depths above 0 are those of a background, or far larger than the others."""
    nearer = depths[depths < depths.max(initial=0.0)]
    if not len(nearer):
        return
    largest, sharing = float(depths.max()), len(depths) - len(nearer)
    is_shared = sharing >= max(MIN_SHARED_FRACTION * len(depths), MIN_SHARED_PIXELS)
    remedy = "write 0 at pixels without depth, or give a mask that leaves them out"
    if is_shared and (largest == 1 or largest > MAX_BACKGROUND_RATIO * nearer.max()):
        buffer = "; convert numbers from 0 to 1, such as OpenGL's depth buffer, to camera z" if largest == 1 else ""
        raise BadInput(
            f"{path} has the depth {largest:.6g} at {sharing} of the object's {len(depths)} pixels, as a background, "
            f"and at most {nearer.max():.6g} at the others: {remedy}{buffer}"
        )
    near = float(np.quantile(depths, NEAR_FRACTION))
    if largest > MAX_DEPTH_RATIO * near:
        raise BadInput(
            f"{path} has depths up to {largest:.6g} on the object, {largest / near:.3g} times those of its nearest "
            f"pixels: {remedy}"
        )


def _picture_numbers(path: Path, remedy: str) -> Shaped[np.ndarray, "height width"]:
    with open_image(path) as image:
        mode, numbers = image.mode, np.asarray(image)
    if mode not in DEPTH_MODES:
        raise BadInput(f"{path} is a picture (mode {mode}), and has no depths of 16 bits: {remedy}")
    return numbers


def _array(path: Path, remedy: str) -> Shaped[np.ndarray, "..."]:
    """The array of a file of NumPy's."""
    try:
        with path.open("rb") as file:
            loaded = np.load(file)
            return loaded if isinstance(loaded, np.ndarray) else loaded[_array_name(path, loaded.files)]
    except BadInput:
        raise
    except (OSError, EOFError, TypeError, ValueError, IndexError, BadZipFile, zlib.error) as error:
        cause = f"cannot be read as depths ({error}): save one array [height, width], or {remedy}"
        raise BadInput(f"{path} {wrong_kind_message(path) or cause}") from None


def _array_name(path: Path, names: list[str]) -> str:
    """The name of the single array, or of the one called depth."""
    named_depth = [name for name in names if name.lower() == "depth"] if len(names) > 1 else names
    if len(named_depth) != 1:
        listed = ", ".join(names) or "none"
        raise BadInput(
            f"{path} must have one array or one called 'depth', and has {listed}: save the depths as 'depth'"
        )
    return named_depth[0]


def _opencv_numbers(path: Path, remedy: str) -> Shaped[np.ndarray, "height width"]:
    """The numbers of a file that OpenCV reads, with one channel or equal colour channels."""
    cv2 = _opencv(path, remedy)
    names, exr = ("blue", "green", "red"), b""
    with path.open("rb") as file:
        if file.read(len(EXR_MAGIC)) == EXR_MAGIC:
            names, exr = _exr_channels(path, EXR_MAGIC + file.read(), remedy)
    try:
        flags = cv2.IMREAD_UNCHANGED
        pixels = cv2.imdecode(np.frombuffer(exr, np.uint8), flags) if exr else cv2.imread(str(path), flags)
    except cv2.error:
        pixels = None
    if pixels is None:
        cause = f"cannot be read as depths: it is cut short or of another format; copy it again, or {remedy}"
        raise BadInput(f"{path} {wrong_kind_message(path) or cause}")
    if pixels.ndim == 2:
        return pixels
    first, *others = np.moveaxis(pixels[..., : len(names)], -1, 0)
    if any(not np.array_equal(first, other, equal_nan=True) for other in others):
        raise BadInput(f"{path} has channels that differ, {', '.join(names)}: save the depths alone, or {remedy}")
    return first


def _opencv(path: Path, remedy: str) -> ModuleType | Any:
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # OpenCV reads this variable with the first file
    try:
        import cv2
    except ImportError as error:
        raise BadInput(f"{path} is read by OpenCV: {install_command('stereo')}, or {remedy}") from error
    return cv2


def _exr_channels(path: Path, content: bytes, remedy: str) -> tuple[tuple[str, ...], bytes]:
    """The names of the channels that OpenCV will read of an EXR, and its content, with a single channel renamed to Y.

    OpenCV knows a single channel by the names Y and Z only. Blender calls it V, other programs R.
    """
    start = content.find(EXR_CHANNELS) + len(EXR_CHANNELS) + 4  # the size of the list has 4 bytes
    starts = {}
    while content[start : start + 1].strip(b"\0"):
        end = content.find(b"\0", start)
        starts[content[start:end].decode("latin-1")] = start
        start = end + 1 + EXR_BYTES_PER_CHANNEL
    names = [name for name in starts if name != "A"]
    if len(names) == 1 and len(names[0]) == 1:
        index = starts[names[0]]
        return ("Y",), content[:index] + b"Y" + content[index + 1 :]
    if sorted(names) == ["B", "G", "R"]:
        return ("B", "G", "R"), content
    raise BadInput(
        f"{path} has the channels {', '.join(starts)}; one alone (V, Z, Y, R) or equal R, G, B are depths: save the "
        f"depths alone, or {remedy}"
    )
