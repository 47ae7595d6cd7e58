"""Textures of surfaces: solid noise, and photographs projected along the axes. RGB from 0 to 1."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

PHOTOGRAPHS = ("astronaut", "brick", "chelsea", "coffee", "grass", "gravel", "rocket")  # that scikit-image ships
ONE_COLOUR = ("painted", "plain")
TEXTURES = ("noise", "banded", *ONE_COLOUR, *PHOTOGRAPHS)
LATTICE = 64  # random colours per axis, after which solid noise repeats
OCTAVES = 3  # each halves the cells and the weight
CONTRAST = 2.0  # factor that spreads averages of random numbers, which lie near a half
SHARPNESS = 4.0  # power of the normal's components in the blend of the three projections
PLAIN = 0.75  # brightness of a surface without texture
PAINT = (0.3, 1.0)  # range of the channels of a paint
BANDS = 3  # paints of a banded surface


Texture = Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]
"""Points in scene units and unit normals to colours."""


def make_texture(name: str, size: float, seed: int) -> Texture:
    """A texture by name.

    Args:
        name: "noise"; "banded", horizontal bands of three random colours in turn; "plain", grey; "painted", one random
            colour; or a photograph, projected along x, y and z and blended by the normal.
        size: of noise's coarsest cells, a band's height, or a photograph's shorter side on the surface, in scene units.
        seed: of noise and paints.
    """
    if name == "noise":
        return lambda points, normals: _solid_noise(points, size, seed)
    if name == "plain":
        return lambda points, normals: np.full(points.shape, PLAIN)
    if name == "painted":
        paint = np.random.default_rng(seed).uniform(*PAINT, 3)
        return lambda points, normals: np.broadcast_to(paint, points.shape)
    if name == "banded":
        paints = np.random.default_rng(seed).uniform(*PAINT, (BANDS, 3))
        return lambda points, normals: paints[np.floor(points[:, 1] / size).astype(np.int64) % BANDS]
    return lambda points, normals: _triplanar(points, normals, photograph(name), size)


@lru_cache(maxsize=4)
def photograph(name: str) -> Float[np.ndarray, "h w 3"]:
    """A photograph that scikit-image ships."""
    from skimage import data, img_as_float

    image = img_as_float(getattr(data, name)())
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]


def _solid_noise(points: Float[np.ndarray, "n 3"], size: float, seed: int) -> Float[np.ndarray, "n 3"]:
    """Value noise: random colours on a lattice, blended between (after Perlin 1985)."""
    generator = np.random.default_rng(seed)
    total, weights = np.zeros((len(points), 3)), 0.0
    for octave in range(OCTAVES):
        lattice = generator.random((3, LATTICE, LATTICE, LATTICE))
        places = (points * 2**octave / size).T
        colours = [map_coordinates(values, places, order=1, mode="grid-wrap") for values in lattice]
        total += 0.5**octave * np.stack(colours, axis=1)
        weights += 0.5**octave
    return (0.5 + CONTRAST * (total / weights - 0.5)).clip(0, 1)


def _triplanar(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], image: Float[np.ndarray, "h w 3"], size: float
) -> Float[np.ndarray, "n 3"]:
    """The image along each axis, mirrored where it ends, with the weights of the normal's components."""
    weights = np.abs(normals) ** SHARPNESS
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    pixels = min(image.shape[:2]) / size
    colours = np.zeros((len(points), 3))
    for axis, (across, up) in enumerate(((2, 1), (0, 2), (0, 1))):
        places = np.stack([-points[:, up], points[:, across]]) * pixels
        seen = [map_coordinates(image[..., c], places, order=1, mode="mirror") for c in range(3)]
        colours += weights[:, axis, None] * np.stack(seen, axis=1)
    return colours.clip(0, 1)
