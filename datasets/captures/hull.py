"""The visual hull of masks: where the object is, whether cameras and masks fit, and a first shape (a baseline)."""

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

SEEN = 0.5  # share of the photographs that a point of the hull must lie in, since objects may leave some of them
FAR = 0.01  # of a mask: what is that far outside of one is outside of the hull, whatever the others show
CHUNK = 65_536  # points projected at once
SAMPLES = 64  # per axis, of the hull that is compared with masks


@torch.no_grad()
def carve(shots: Sequence[Shot], points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """How far points are outside of the visual hull: negative inside of all masks that they are seen against.

    A value is 1/2 less the least mask, from 0 to 1, that is interpolated between pixels; 1/2 for a point that lies in
    less than `SEEN` of the photographs.
    """
    flat = points.reshape(-1, 3)
    values = torch.cat([_carved(shots, some) for some in flat.split(CHUNK)]) if len(flat) else flat[:, 0]
    return values.view(points.shape[:-1])


def _carved(shots: Sequence[Shot], points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    least, seen = torch.ones_like(points[:, 0]), torch.zeros_like(points[:, 0])
    left = torch.arange(len(points), device=points.device)  # not yet far outside of a mask
    for shot in shots:
        assert shot.mask is not None
        pixels, depth = shot.camera.project(points[left])
        size = points.new_tensor([shot.camera.width, shot.camera.height])
        inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= size).all(-1)
        places = (2 * pixels / size - 1)[None, :, None]
        mask = shot.mask.to(points.dtype)[None, None]
        found = torch.nn.functional.grid_sample(mask, places, padding_mode="border", align_corners=False).flatten()
        least[left] = torch.where(inside, torch.minimum(least[left], found), least[left])
        seen[left] += inside
        left = left[least[left] > FAR]
    return torch.where((seen >= SEEN * len(shots)) | (least <= FAR), 0.5 - least, 0.5)


def hull_mesh(shots: Sequence[Shot], samples: int) -> Mesh | None:
    """The hull in the cube [-1, 1]^3, `samples` per axis, closed where it leaves the cube; None where it is empty."""
    within = 1 - 1 / (samples - 1)  # all samples but the outermost

    def hull(points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        return torch.where(points.abs().amax(-1) < within, carve(shots, points), 0.5)

    return extract(Shape(hull, Kind.LEVEL, None), grid=samples, reach=1.0)


@dataclass(frozen=True)
class Fit:
    """How well cameras and masks fit.

    Args:
        silhouettes: of the visual hull, in each photograph: where cameras are right, they cover nearly all of the mask.
        overlaps: their intersection over union with the masks.
        shown: the share of the hull's vertices that each photograph shows.
    """

    silhouettes: tuple[Bool[np.ndarray, "_ _"], ...]
    overlaps: tuple[float, ...]
    shown: tuple[float, ...]


def fit_of(shots: Sequence[Shot]) -> Fit:
    """How well photographs with masks fit, by their visual hull in the unit sphere."""
    hull, masks = hull_mesh(shots, SAMPLES), [np.asarray(shot.mask) for shot in shots]
    if hull is None:
        return Fit(tuple(map(np.zeros_like, masks)), (0.0,) * len(shots), (0.0,) * len(shots))
    truth, points = Truth(hull, closed=False), torch.from_numpy(hull.vertices).float()
    silhouettes = tuple(see(truth, shot.camera).mask.numpy() for shot in shots)
    shown = tuple(float(shot.camera.shows(points).float().mean()) for shot in shots)
    return Fit(silhouettes, tuple(map(mask_iou, silhouettes, masks)), shown)
