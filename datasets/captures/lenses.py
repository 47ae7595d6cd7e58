"""Lenses: how the models of OpenCV, COLMAP and NeRF's files bend rays, and which of them are understood."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from renderers.checks import BadInput

RADIAL, TANGENTIAL = ("k1", "k2", "k3", "k4", "k5", "k6"), ("p1", "p2")
BROWN = ("k1", "k2", "p1", "p2")
NERFSTUDIO = ("k1", "k2", "k3", "k4", "p1", "p2")  # the order of its distortion_params
PLAIN = {  # COLMAP's models, and the numbers behind focal lengths and principal point
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": BROWN,
    "FULL_OPENCV": (*BROWN, "k3", "k4", "k5", "k6"),
}
FISHEYE = {
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
UNDERSTOOD = ", ".join([*PLAIN, *FISHEYE])
READ = {*RADIAL, *TANGENTIAL, "camera_model", "is_fisheye", "distortion_params"}  # keys of transforms.json
PINHOLE = {"", "NONE", "PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE"}


@dataclass(frozen=True)
class Lens:
    """How a lens bends the rays of a pinhole camera.

    Args:
        fisheye: whether `radial` is OpenCV's equidistant fisheye; else it is its rational model (Brown's, where k4 to
            k6 are 0).
        radial: k1 and further ones, up to k6; of a fisheye up to k4.
        tangential: p1, p2.
    """

    fisheye: bool = False
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def numbers(self) -> tuple[float, ...]:
        """All of them."""
        return (*self.radial, *self.tangential)

    @property
    def bends(self) -> bool:
        """Whether it differs from a pinhole camera."""
        return self.fisheye or any(self.numbers)

    def bend(
        self, x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"]
    ) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        """Where a ray through (x, y, 1) meets the plane at depth 1 after the lens."""
        square = x**2 + y**2
        if self.fisheye:
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            bent = angle * _polynomial(self.radial, angle**2)
            factor = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 0)
            return x * factor, y * factor
        factor = _polynomial(self.radial[:3], square) / _polynomial(self.radial[3:], square)
        p1, p2 = self.tangential
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * factor + p1 * (square + 2 * y**2) + 2 * p2 * x * y,
        )

    def undistorted(
        self, image: Float[np.ndarray, "height width channels"], intrinsics: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "height width channels"]:
        """The image that a pinhole camera of these intrinsics takes."""
        rows, columns = np.meshgrid(np.arange(image.shape[0]) + 0.5, np.arange(image.shape[1]) + 0.5, indexing="ij")
        y = (rows - intrinsics[1, 2]) / intrinsics[1, 1]
        x = (columns - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
        bent_x, bent_y = self.bend(x, y)
        across = bent_x * intrinsics[0, 0] + bent_y * intrinsics[0, 1] + intrinsics[0, 2]
        sources = np.stack([bent_y * intrinsics[1, 1] + intrinsics[1, 2] - 0.5, across - 0.5])
        channels = [map_coordinates(image[..., i], sources, order=1, mode="nearest") for i in range(image.shape[2])]
        return np.stack(channels, axis=-1)


def _polynomial(numbers: tuple[float, ...], square: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """1 + k1 s + k2 s^2 + ..."""
    return np.polynomial.polynomial.polyval(square, (1.0, *numbers))


def colmap_lens(model: str, numbers: list[float], where: str) -> Lens:
    """The lens of a COLMAP camera.

    Args:
        numbers: all of the camera, focal lengths and principal point first.

    Raises:
        BadInput: for models that are not understood.
    """
    names = (PLAIN | FISHEYE).get(model)
    if names is None:
        raise BadInput(
            f"{where} has cameras of the model {model}, which is not understood ({UNDERSTOOD} are): use colmap "
            "image_undistorter first"
        )
    return _lens(dict(zip(names, numbers[len(numbers) - len(names) :], strict=True)), fisheye=model in FISHEYE)


def nerf_lens(known: dict[str, Any], where: str) -> Lens:
    """The lens of a frame of transforms.json.

    Raises:
        BadInput: for models that are not understood, by name.
    """
    model = str(known.get("camera_model") or "").upper()
    if model not in {*PLAIN, *FISHEYE, *PINHOLE}:
        raise BadInput(
            f"{where}: camera_model {model} is not understood ({UNDERSTOOD} are): undistort the images, export again"
        )
    fisheye = model in FISHEYE or bool(known.get("is_fisheye"))
    if fisheye and model in {*PLAIN, "PERSPECTIVE"}:
        raise BadInput(f"{where}: is_fisheye does not fit camera_model {model}: leave one of them out")
    listed = known.get("distortion_params") or ()
    if len(listed) not in (0, len(NERFSTUDIO)) and not (fisheye and len(listed) == 4):
        raise BadInput(
            f"{where}: distortion_params must be {', '.join(NERFSTUDIO)}, or k1 to k4 of a fisheye, not "
            f"{len(listed)} numbers: give them by name"
        )
    named = {name: float(known.get(name) or 0.0) for name in (*RADIAL, *TANGENTIAL)}
    stated = {name: float(value) for name, value in zip(NERFSTUDIO, listed, strict=False)}
    if any(named.values()) and any(named[name] != value for name, value in stated.items()):
        raise BadInput(f"{where}: distortion_params and the numbers by name differ: leave one of them out")
    bent = named | stated
    if fisheye and any(bent[name] for name in ("k5", "k6", "p1", "p2")):
        raise BadInput(f"{where}: a fisheye has k1 to k4, and this one k5, k6, p1 or p2 too: export it again")
    if not fisheye and bent["k4"] and model != "FULL_OPENCV" and not {"k5", "k6"} & set(known):
        raise BadInput(
            f"{where}: k4 means one thing in a fisheye, another in OpenCV's rational model: set is_fisheye to true, or "
            "camera_model to FULL_OPENCV"
        )
    return _lens(bent, fisheye=fisheye)


def unread_note(keys: Sequence[str], file: Path) -> tuple[str, ...]:
    """A note on keys of a file of cameras that are not read; they may be of a lens."""
    remedy = "if they describe a lens, undistort the images, and export again"
    return (f"{file.name} has keys that are not read, {', '.join(keys)}: {remedy}",) if keys else ()


def _lens(bent: Mapping[str, float], *, fisheye: bool) -> Lens:
    radial = tuple(bent.get(name, 0.0) for name in RADIAL[: 4 if fisheye else 6])
    return Lens(fisheye, radial, (bent.get("p1", 0.0), bent.get("p2", 0.0)))
