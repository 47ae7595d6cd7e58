"""Lens distortion in the models of OpenCV, COLMAP and NeRF's files."""

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
NERFSTUDIO_ORDER = ("k1", "k2", "k3", "k4", "p1", "p2")  # distortion_params
PERSPECTIVE_MODELS = {  # COLMAP's models, and their parameters after focal lengths and principal point
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": BROWN,
    "FULL_OPENCV": (*BROWN, "k3", "k4", "k5", "k6"),
}
FISHEYE_MODELS = {
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
    "RADIAL_FISHEYE": ("k1", "k2"),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
SUPPORTED = ", ".join([*PERSPECTIVE_MODELS, *FISHEYE_MODELS])
LENS_KEYS = {*RADIAL, *TANGENTIAL, "camera_model", "is_fisheye", "distortion_params"}  # transforms.json
PINHOLE_MODELS = {"", "NONE", "PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE"}


@dataclass(frozen=True)
class Lens:
    """The distortion of a lens, in addition to a pinhole camera.

    Args:
        fisheye: whether `radial` is for OpenCV's equidistant fisheye model, or for its rational model, which is Brown's
            model if k4 to k6 are 0.
        radial: k1, k2 and so on, up to k6, or up to k4 for a fisheye.
        tangential: p1, p2.
    """

    fisheye: bool = False
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The radial and the tangential coefficients."""
        return (*self.radial, *self.tangential)

    @property
    def has_distortion(self) -> bool:
        """Whether it differs from a pinhole camera."""
        return self.fisheye or any(self.coefficients)

    def distort(
        self, x: Float[np.ndarray, "*n"], y: Float[np.ndarray, "*n"]
    ) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        """Maps the point (x, y, 1) of an undistorted ray to its distorted point in the plane at depth 1."""
        square = x**2 + y**2
        if self.fisheye:
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            bent_angle = angle * _polynomial(self.radial, angle**2)
            factor = np.divide(bent_angle, radius, out=np.ones_like(radius), where=radius > 0)
            return x * factor, y * factor
        factor = _polynomial(self.radial[:3], square) / _polynomial(self.radial[3:], square)
        p1, p2 = self.tangential
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * factor + p1 * (square + 2 * y**2) + 2 * p2 * x * y,
        )

    def undistort(
        self, image: Float[np.ndarray, "height width channels"], intrinsics: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "height width channels"]:
        """The image without distortion, as a pinhole camera with these intrinsics takes it."""
        rows, columns = np.meshgrid(np.arange(image.shape[0]) + 0.5, np.arange(image.shape[1]) + 0.5, indexing="ij")
        y = (rows - intrinsics[1, 2]) / intrinsics[1, 1]
        x = (columns - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
        bent_x, bent_y = self.distort(x, y)
        across = bent_x * intrinsics[0, 0] + bent_y * intrinsics[0, 1] + intrinsics[0, 2]
        sources = np.stack([bent_y * intrinsics[1, 1] + intrinsics[1, 2] - 0.5, across - 0.5])
        channels = [map_coordinates(image[..., i], sources, order=1, mode="nearest") for i in range(image.shape[2])]
        return np.stack(channels, axis=-1)


def _polynomial(coefficients: tuple[float, ...], square: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """1 + k1 s + k2 s^2 + ..."""
    return np.polynomial.polynomial.polyval(square, (1.0, *coefficients))


def colmap_lens(model: str, parameters: list[float], where: str) -> Lens:
    """The lens of a COLMAP camera, whose `parameters` begin with focal lengths and principal point.

    Raises:
        BadInput: the model is not supported.
    """
    names = (PERSPECTIVE_MODELS | FISHEYE_MODELS).get(model)
    if names is None:
        raise BadInput(
            f"{where} has cameras of the model {model}, which is not understood ({SUPPORTED} are): use colmap "
            "image_undistorter first"
        )
    distortion = parameters[len(parameters) - len(names) :]
    return _lens(dict(zip(names, distortion, strict=True)), fisheye=model in FISHEYE_MODELS)


def nerf_lens(settings: dict[str, Any], where: str) -> Lens:
    """The lens of a frame of transforms.json.

    Raises:
        BadInput: the model is not supported, or the settings contradict each other.
    """
    model = str(settings.get("camera_model") or "").upper()
    if model not in {*PERSPECTIVE_MODELS, *FISHEYE_MODELS, *PINHOLE_MODELS}:
        raise BadInput(
            f"{where}: camera_model {model} is not understood ({SUPPORTED} are): undistort the images, export again"
        )
    fisheye = model in FISHEYE_MODELS or bool(settings.get("is_fisheye"))
    if fisheye and model in {*PERSPECTIVE_MODELS, "PERSPECTIVE"}:
        raise BadInput(f"{where}: is_fisheye does not fit camera_model {model}: leave one of them out")
    listed = settings.get("distortion_params") or ()
    if len(listed) not in (0, len(NERFSTUDIO_ORDER)) and not (fisheye and len(listed) == 4):
        raise BadInput(
            f"{where}: distortion_params must be {', '.join(NERFSTUDIO_ORDER)}, or k1 to k4 of a fisheye, not "
            f"{len(listed)} numbers: give them by name"
        )
    by_name = {name: float(settings.get(name) or 0.0) for name in (*RADIAL, *TANGENTIAL)}
    by_list = {name: float(value) for name, value in zip(NERFSTUDIO_ORDER, listed, strict=False)}
    if any(by_name.values()) and any(by_name[name] != value for name, value in by_list.items()):
        raise BadInput(f"{where}: distortion_params and the numbers by name differ: leave one of them out")
    coefficients = by_name | by_list
    if fisheye and any(coefficients[name] for name in ("k5", "k6", "p1", "p2")):
        raise BadInput(f"{where}: a fisheye has k1 to k4, and this one k5, k6, p1 or p2 too: export it again")
    if not fisheye and coefficients["k4"] and model != "FULL_OPENCV" and not {"k5", "k6"} & set(settings):
        raise BadInput(
            f"{where}: k4 means one thing in a fisheye, another in OpenCV's rational model: set is_fisheye to true, or "
            "camera_model to FULL_OPENCV"
        )
    return _lens(coefficients, fisheye=fisheye)


def unread_keys_note(keys: Sequence[str], file: Path) -> tuple[str, ...]:
    """A note on keys of a file of cameras that are not read, since they may describe a lens."""
    remedy = "if they describe a lens, undistort the images, and export again"
    return (f"{file.name} has keys that are not read, {', '.join(keys)}: {remedy}",) if keys else ()


def _lens(coefficients: Mapping[str, float], *, fisheye: bool) -> Lens:
    radial = tuple(coefficients.get(name, 0.0) for name in RADIAL[: 4 if fisheye else 6])
    return Lens(fisheye, radial, (coefficients.get("p1", 0.0), coefficients.get("p2", 0.0)))
