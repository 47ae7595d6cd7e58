"""The visual hull of masks: it locates the object, checks cameras against masks, and is a baseline shape."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from datasets.mesh import Mesh, extract
from datasets.scene import Truth, see
from datasets.shot import Shot, mask_iou
from renderers.field import Kind
from renderers.fields.analytic import Shape

MIN_VIEW_FRACTION = 0.5  # a point of the hull must lie in this fraction of the images; objects may leave some of them
MIN_MASK_VALUE = 0.01  # a point with a smaller value in one mask is outside of the hull
POINTS_PER_BATCH = 65_536
FIT_SAMPLES_PER_AXIS = 64


@torch.no_grad()
def carve(shots: Sequence[Shot], points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """A level set of the visual hull: negative at points inside of all masks whose photographs show them.

    A value is 1/2 minus the smallest mask value, from 0 to 1, interpolated between pixels. It is 1/2 for a point in
    less than `MIN_VIEW_FRACTION` of the photographs.
    """
    flat = points.reshape(-1, 3)
    values = torch.cat([_carve(shots, batch) for batch in flat.split(POINTS_PER_BATCH)]) if len(flat) else flat[:, 0]
    return values.view(points.shape[:-1])


def _carve(shots: Sequence[Shot], points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    smallest, views = torch.ones_like(points[:, 0]), torch.zeros_like(points[:, 0])
    remaining = torch.arange(len(points), device=points.device)  # points inside of all masks so far
    for shot in shots:
        pixels, depth = shot.camera.project(points[remaining])
        size = points.new_tensor([shot.camera.width, shot.camera.height])
        inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= size).all(-1)
        grid = (2 * pixels / size - 1)[None, :, None]
        mask = shot.mask.to(points.dtype)[None, None]
        mask_values = torch.nn.functional.grid_sample(mask, grid, padding_mode="border", align_corners=False).flatten()
        smallest[remaining] = torch.where(inside, torch.minimum(smallest[remaining], mask_values), smallest[remaining])
        views[remaining] += inside
        remaining = remaining[smallest[remaining] > MIN_MASK_VALUE]
    return torch.where((views >= MIN_VIEW_FRACTION * len(shots)) | (smallest <= MIN_MASK_VALUE), 0.5 - smallest, 0.5)


def hull_mesh(shots: Sequence[Shot], samples: int) -> Mesh | None:
    """The hull in the cube [-1, 1]^3, `samples` per axis, closed where it leaves the cube; None if it is empty."""
    inner_limit = 1 - 1 / (samples - 1)  # excludes only the outermost samples

    def hull(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        return torch.where(points.abs().amax(-1) < inner_limit, carve(shots, points), 0.5)

    return extract(Shape(hull, Kind.LEVEL, None), grid=samples, reach=1.0)


@dataclass(frozen=True)
class MaskFit:
    """How well cameras and masks fit.

    Args:
        silhouettes: of the visual hull, in each photograph; with correct cameras they cover nearly all of the mask.
        overlaps: intersection over union of each silhouette with its mask.
        shown: the fraction of the hull's vertices that each photograph shows.
    """

    silhouettes: tuple[Bool[np.ndarray, "_ _"], ...]
    overlaps: tuple[float, ...]
    shown: tuple[float, ...]


def measure_mask_fit(shots: Sequence[Shot]) -> MaskFit:
    """Measures how well photographs and masks fit, by their visual hull in the unit sphere."""
    hull, masks = hull_mesh(shots, FIT_SAMPLES_PER_AXIS), [np.asarray(shot.mask) for shot in shots]
    if hull is None:
        return MaskFit(tuple(map(np.zeros_like, masks)), (0.0,) * len(shots), (0.0,) * len(shots))
    truth, points = Truth(hull, closed=False), torch.from_numpy(hull.vertices).float()
    silhouettes = tuple(see(truth, shot.camera).mask.numpy() for shot in shots)
    shown = tuple(float(shot.camera.shows(points).float().mean()) for shot in shots)
    return MaskFit(silhouettes, tuple(map(mask_iou, silhouettes, masks)), shown)
