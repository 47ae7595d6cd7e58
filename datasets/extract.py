"""Extracts a mesh from a field by marching cubes."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import binary_dilation
from skimage.measure import block_reduce, marching_cubes

from datasets.mesh import Mesh
from renderers.field import Field, Kind

BLOCKS = (4, 2)  # sides of the blocks, in samples, that are not divided further where the surface is far
MARGIN = 2.0  # a field may exceed the distance by this factor before a part of its surface can be skipped
STEEPER = 1.2  # the same, times its steepest slope between the middles of blocks, where that is more
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
    if field.kind is Kind.LEVEL or grid < 2 * BLOCKS[0]:
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

    A block is not divided if its middle is farther from the surface than its corners are from its middle; it takes the
    value of its middle. Where signs then differ across the side of a block, that block is sampled as well.
    """
    spacing, parent, margin = axis[1] - axis[0], len(axis), MARGIN
    values, near = np.zeros((1, 1, 1), dtype=np.float32), np.ones((1, 1, 1), dtype=bool)
    for side in (*BLOCKS, 1):
        middles = np.array([axis[start : start + side].mean() for start in range(0, len(axis), side)], dtype=axis.dtype)
        parent_of = np.ix_(*(np.arange(len(middles)) * side // parent,) * 3)
        values, known = values[parent_of], near
        values[near[parent_of]] = evaluate(_places(np.flatnonzero(near[parent_of]), middles))
        if side == BLOCKS[0]:
            steps = [np.nan_to_num(np.abs(np.diff(values, axis=i)), posinf=0.0).max() for i in range(3)]
            steepest = max(steps) / (side * spacing)
            margin = max(MARGIN, STEEPER * steepest)
        far = np.abs(values) > margin * np.sqrt(3) * (side + 1) / 2 * spacing  # NaN is not
        near, parent = near[parent_of] & ~far, side
    while (found := block_reduce(_beside_another_sign(values), BLOCKS[-1], np.any) & ~known).any():
        wanted = found[parent_of]
        values[wanted] = evaluate(_places(np.flatnonzero(wanted), axis))
        known |= found
    return values


def _beside_another_sign(values: Float[np.ndarray, "grid grid grid"]) -> Bool[np.ndarray, "grid grid grid"]:
    """The samples that have a neighbour along an axis on the other side of the surface."""
    inside = values < 0
    return binary_dilation(inside) & binary_dilation(~inside)


def _places(flat: Int[np.ndarray, " n"], axis: Float[np.ndarray, " grid"]) -> Float[np.ndarray, "n 3"]:
    """The points of a cube's samples, given by their flat indices."""
    return np.stack([axis[i] for i in np.unravel_index(flat, (len(axis),) * 3)], axis=-1)
