"""Extracts a mesh from a field by marching cubes."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import binary_dilation
from skimage.measure import block_reduce, marching_cubes

from datasets.mesh import Mesh
from renderers.field import Field, Kind

BLOCK = 4  # side of the blocks, in samples, that are skipped where the surface is far
MARGIN = 2.0  # a field may exceed the distance by this factor before a part of its surface can be skipped
CHUNK = 65536  # points per evaluation


@torch.no_grad()
def extract(field: Field, *, grid: int, reach: float, device: torch.device | str = "cpu") -> Mesh | None:
    """The zero set by marching cubes, wound outward; None where the samples have one sign.

    A distance or a bound is evaluated only near its surface, see `_near_values`; a level set everywhere.

    Args:
        field: what to sample.
        grid: samples per axis.
        reach: half the side of the sampled cube about the origin. A surface that leaves it is left open.
        device: where the field's tensors are.
    """

    def evaluate(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        places = torch.from_numpy(points.astype(np.float32)).to(device)
        return torch.cat([field(chunk).float().cpu() for chunk in places.split(CHUNK)]).numpy()

    axis = torch.linspace(-reach, reach, grid).numpy()
    if field.kind is Kind.LEVEL or grid < 2 * BLOCK:
        values = evaluate(_places(np.arange(grid**3), axis)).reshape(grid, grid, grid)
    else:
        values = _near_values(evaluate, axis)
    if not (values.min() < 0 < values.max()):
        return None
    spacing = 2 * reach / (grid - 1)
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(spacing,) * 3, gradient_direction="descent")
    return Mesh(vertices - reach, faces)


def _near_values(
    evaluate: Callable[[np.ndarray], np.ndarray], axis: Float[np.ndarray, " grid"]
) -> Float[np.ndarray, "grid grid grid"]:
    """Values that are right near the surface and have the right sign elsewhere.

    A block is not sampled if its middle is farther from the surface than its corners are from its middle; it takes the
    value of its middle. Where signs then differ across the side of a block, that block is sampled as well.
    """
    grid, spacing = len(axis), axis[1] - axis[0]
    block_of = np.arange(grid) // BLOCK
    middles = np.array([axis[block_of == block].mean() for block in range(block_of[-1] + 1)], dtype=np.float32)
    coarse = evaluate(_places(np.arange(len(middles) ** 3), middles)).reshape((len(middles),) * 3)
    near = ~(np.abs(coarse) > MARGIN * np.sqrt(3) * (BLOCK + 1) / 2 * spacing)  # NaN counts as near
    values = coarse[np.ix_(block_of, block_of, block_of)]
    known = np.zeros(near.shape, dtype=bool)
    while (near & ~known).any():
        wanted = (near & ~known)[np.ix_(block_of, block_of, block_of)]
        values[wanted] = evaluate(_places(np.flatnonzero(wanted), axis))
        known |= near
        inside = values < 0
        near |= block_reduce(binary_dilation(inside) & binary_dilation(~inside), BLOCK, np.any)
    return values


def _places(flat: Int[np.ndarray, " n"], axis: Float[np.ndarray, " grid"]) -> Float[np.ndarray, "n 3"]:
    """The points of a cube's samples, given by their flat indices."""
    return np.stack([axis[i] for i in np.unravel_index(flat, (len(axis),) * 3)], axis=-1)
