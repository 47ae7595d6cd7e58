"""From a field to a mesh."""

import torch
from skimage.measure import marching_cubes

from datasets.mesh import Mesh
from renderers.field import Field


@torch.no_grad()
def extract(field: Field, *, grid: int, reach: float, device: torch.device | str = "cpu") -> Mesh | None:
    """The zero set by marching cubes, wound outward; None where the samples have one sign.

    Args:
        field: what to sample.
        grid: samples an axis.
        reach: half the side of the sampled cube about the origin. A surface that leaves it is left open.
        device: where the field's tensors are.
    """
    axis = torch.linspace(-reach, reach, grid, device=device)
    slabs = [field(torch.stack(torch.meshgrid(x[None], axis, axis, indexing="ij"), dim=-1)).cpu() for x in axis]
    values = torch.cat(slabs).float().numpy()
    if not (values.min() < 0 < values.max()):
        return None
    spacing = 2 * reach / (grid - 1)
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(spacing,) * 3, gradient_direction="descent")
    return Mesh(vertices - reach, faces)
