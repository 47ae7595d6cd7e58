"""Textures of surfaces: solid noise, and photographs projected along the axes. RGB from 0 to 1."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

SKIMAGE_PHOTOGRAPHS = ("astronaut", "brick", "chelsea", "coffee", "grass", "gravel", "rocket")
ONE_COLOUR = ("painted", "plain")
TEXTURES = ("noise", "banded", *ONE_COLOUR, *SKIMAGE_PHOTOGRAPHS)
LATTICE_COLOURS = 64  # per axis; solid noise repeats after them
OCTAVES = 3  # each octave halves the cells and the weight
CONTRAST = 2.0  # spreads averages of random numbers, which lie near 0.5
SHARPNESS = 4.0  # exponent of the normal's components in the blend of the three projections
PLAIN_BRIGHTNESS = 0.75
PAINT_CHANNEL_RANGE = (0.3, 1.0)
BAND_COLOURS = 3


Texture = Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]
"""Maps points in scene units and unit normals to colours."""


def make_texture(name: str, size: float, seed: int) -> Texture:
    """A texture by name.

    Args:
        name: "noise"; "banded", horizontal bands of three random colours in turn; "plain", grey; "painted", one random
            colour; or a photograph, projected along x, y and z and blended by the normal.
        size: of the coarsest noise cells, a band's height, or a photograph's shorter side, in scene units.
        seed: of noise and paints.
    """
    if name == "noise":
        return lambda points, normals: _solid_noise(points, size, seed)
    if name == "plain":
        return lambda points, normals: np.full(points.shape, PLAIN_BRIGHTNESS)
    if name == "painted":
        paint = np.random.default_rng(seed).uniform(*PAINT_CHANNEL_RANGE, 3)
        return lambda points, normals: np.broadcast_to(paint, points.shape)
    if name == "banded":
        paints = np.random.default_rng(seed).uniform(*PAINT_CHANNEL_RANGE, (BAND_COLOURS, 3))
        return lambda points, normals: paints[np.floor(points[:, 1] / size).astype(np.int64) % BAND_COLOURS]
    return lambda points, normals: _triplanar(points, normals, photograph(name), size)


@lru_cache(maxsize=4)
def photograph(name: str) -> Float[np.ndarray, "h w 3"]:
    """A photograph that scikit-image ships."""
    from skimage import data, img_as_float

    image = img_as_float(getattr(data, name)())
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]


def _solid_noise(points: Float[np.ndarray, "n 3"], size: float, seed: int) -> Float[np.ndarray, "n 3"]:
    """Value noise: interpolated random colours of a lattice (after Perlin 1985)."""
    generator = np.random.default_rng(seed)
    total, weights = np.zeros((len(points), 3)), 0.0
    for octave in range(OCTAVES):
        lattice = generator.random((3, LATTICE_COLOURS, LATTICE_COLOURS, LATTICE_COLOURS))
        positions = (points * 2**octave / size).T
        colours = [map_coordinates(values, positions, order=1, mode="grid-wrap") for values in lattice]
        total += 0.5**octave * np.stack(colours, axis=1)
        weights += 0.5**octave
    return (0.5 + CONTRAST * (total / weights - 0.5)).clip(0, 1)


def _triplanar(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], image: Float[np.ndarray, "h w 3"], size: float
) -> Float[np.ndarray, "n 3"]:
    """The image projected along each axis, mirrored at its edges, weighted by the normal's components."""
    weights = np.abs(normals) ** SHARPNESS
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    pixels = min(image.shape[:2]) / size
    colours = np.zeros((len(points), 3))
    for axis, (across, up) in enumerate(((2, 1), (0, 2), (0, 1))):
        positions = np.stack([-points[:, up], points[:, across]]) * pixels
        channels = [map_coordinates(image[..., c], positions, order=1, mode="mirror") for c in range(3)]
        colours += weights[:, axis, None] * np.stack(channels, axis=1)
    return colours.clip(0, 1)
