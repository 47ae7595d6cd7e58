"""The visual hull of masks: where the object is, whether cameras and masks fit, and a first shape (a baseline)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from datasets.mesh import Mesh, extract
from datasets.scene import Truth, see
from datasets.shot import Shot
from renderers.checks import BadInput
from renderers.field import Kind
from renderers.fields.analytic import Shape

SEEN = 0.5  # share of the photographs that a point of the hull must lie in, since objects may leave some of them
FAR = 0.01  # of a mask: what is that far outside of one is outside of the hull, whatever the others show
CHUNK = 65_536  # points projected at once
SAMPLES = 48  # per axis, while the hull is looked for
ROUNDS = 4  # in which the part of the world that is sampled shrinks to the hull
FILLED = 0.9  # of the unit sphere's radius that the hull takes


@torch.no_grad()
def carve(shots: Sequence[Shot], points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """How far points are outside of the visual hull: negative inside of all masks that they are seen against.

    A value is 1/2 less the least mask, from 0 to 1, that is interpolated between pixels; 1/2 for a point that lies in
    less than `SEEN` of the photographs.

    Args:
        shots: with masks.
        points: in the world of the cameras.
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
        size = torch.tensor([shot.camera.width, shot.camera.height], device=points.device)
        inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels <= size).all(-1)
        places = (2 * pixels / size - 1)[None, :, None]
        mask = shot.mask.float()[None, None]
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


def hull_views(shots: Sequence[Shot], hull: Mesh | None) -> list[Bool[Tensor, "height width"]]:
    """The hull's silhouette in each photograph: where cameras are right, it covers nearly all of the mask."""
    if hull is None:
        return [torch.zeros(shot.camera.height, shot.camera.width, dtype=torch.bool) for shot in shots]
    truth = Truth(hull, closed=False)
    return [see(truth, shot.camera).mask for shot in shots]


@dataclass(frozen=True)
class Sphere:
    """A sphere about the object, in the file's world, and how it was found."""

    centre: Float[np.ndarray, "3"]
    radius: float
    found: str


def sphere_of(shots: Sequence[Shot]) -> Sphere:
    """A sphere about the object: about the visual hull of the masks or, without masks, about what all cameras look at.

    Raises:
        BadInput: where the hull is empty.
    """
    centre, half = _looked_at(shots)
    if any(shot.mask is None for shot in shots):
        return Sphere(centre, half, "about the point that the cameras look at, as far as most of them see")
    for _ in range(ROUNDS):
        axis = torch.linspace(-half, half, SAMPLES, dtype=torch.float64)
        points = torch.from_numpy(centre) + torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        inside = points[carve(shots, points.float()) < 0].numpy()
        if len(inside) == 0:
            raise BadInput(
                "the visual hull of the masks is empty: no point is inside of all masks, so that cameras do not fit "
                "the masks. Try flipped axes (stated ones, where they are flipped), check the order of the images and "
                "that masks are white on the object"
            )
        spacing = 2 * half / (SAMPLES - 1)
        low, high = inside.min(axis=0) - spacing, inside.max(axis=0) + spacing
        centre, half = (low + high) / 2, float((high - low).max()) / 2
    radius = float(np.linalg.norm(inside - centre, axis=1).max()) + spacing
    return Sphere(centre, radius / FILLED, "about the visual hull of the masks")


def _looked_at(shots: Sequence[Shot]) -> tuple[Float[np.ndarray, "3"], float]:
    """The point nearest to all optical axes, and half the width that the narrower side of most images shows there."""
    motions = [shot.camera.camera_to_world.double().numpy() for shot in shots]
    across = [np.eye(3) - np.outer(motion[:3, 2], motion[:3, 2]) for motion in motions]
    places = [motion[:3, 3] for motion in motions]
    pulled = np.sum([one @ place for one, place in zip(across, places, strict=True)], axis=0)
    centre = np.linalg.lstsq(np.sum(across, axis=0), pulled, rcond=None)[0]
    away = np.array([np.linalg.norm(place - centre) for place in places])
    cameras = [shot.camera for shot in shots]
    shown = np.array([min(one.width, one.height) / 2 / one.intrinsics[0, 0].item() for one in cameras])
    return centre, float(np.median(away * shown))
