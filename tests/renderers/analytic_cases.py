"""Rays with closed-form hits, normals and derivatives of the hit distance, in float64.

Each field is a distance that falls by 1 as its parameter grows by 1. Implicit differentiation then gives
    d distance / d parameter = -1 / cosine,    d distance / d origin = normal / cosine,
with the cosine of the angle between the ray and the inward normal.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from renderers.camera import Rays
from renderers.fields.analytic import Shape, box, plane, sphere, torus


@dataclass(frozen=True)
class Case:
    """One ray and one shape with one parameter. The hit lies in the unit sphere, and the ray begins outside it.

    Args:
        shape: gives the field for a value of the parameter.
        parameter: the value of the parameter.
        origin, direction: those of the ray; the direction is normalised.
        distance: the distance along the ray to the hit.
        normal: the outward unit normal at the hit.
        cosine: the cosine of the angle of incidence.
    """

    name: str
    shape: Callable[[float | Tensor], Shape]
    parameter: float
    origin: tuple[float, ...]
    direction: tuple[float, ...]
    distance: float
    normal: tuple[float, ...]
    cosine: float

    def field(self) -> Shape:
        """The field at the parameter."""
        return self.shape(self.parameter)

    def rays(self, dtype: torch.dtype = torch.float64) -> Rays:
        """The ray, with the leading shape [1]."""
        direction = normalize(vector(self.direction), dim=0)
        return Rays(vector(self.origin).to(dtype)[None], direction.to(dtype)[None])

    @property
    def parameter_rate(self) -> float:
        """The derivative of the distance with respect to the parameter."""
        return -1 / self.cosine

    @property
    def origin_rate(self) -> Tensor:
        """The derivative [3] of the distance with respect to the ray's origin."""
        return vector(self.normal) / self.cosine


def vector(numbers: tuple[float, ...]) -> Tensor:
    """A tensor of numbers in float64."""
    return torch.tensor(numbers, dtype=torch.float64)


def beam(*origins: tuple[float, float, float]) -> Rays:
    """Rays along z."""
    starts = vector(sum(origins, ())).view(-1, 3)
    return Rays(starts, vector((0, 0, 1)).expand_as(starts))


def aimed(seed: int, count: int = 12, *, spread: float = 0.1) -> Rays:
    """Rays from all directions, 2.2 away, to points at the distance `spread` from the origin."""
    generator = torch.Generator().manual_seed(seed)
    around, targets = (normalize(torch.randn(count, 3, dtype=torch.float64, generator=generator), dim=-1)
                       for _ in range(2))  # fmt: skip
    return Rays(2.2 * around, normalize(spread * targets - 2.2 * around, dim=-1))


def sheet(x: Tensor, y: Tensor, *batch: int) -> Rays:
    """An image of rays along z from z = -2, with columns at x and rows at y."""
    down, across = torch.meshgrid(y, x, indexing="ij")
    origins = torch.stack([across, down, torch.full_like(across, -2.0)], dim=-1).expand(*batch, len(y), len(x), 3)
    return Rays(origins, vector((0, 0, 1)).to(origins).expand_as(origins), image=True)


def along_z(*heights: float) -> Rays:
    """Rays along z in the plane x = 0."""
    return beam(*((0.0, height, -2.0) for height in heights))


def ground(offset: float | Tensor) -> Shape:
    """The half space below y = offset."""
    return plane((0.0, 1.0, 0.0), offset)


def brick(half: float | Tensor) -> Shape:
    """A box whose faces across z lie at -half and half."""
    half = torch.as_tensor(half, dtype=torch.float64)
    return box(torch.cat([vector((0.4, 0.3)), half[None]]))


def ring(minor: float | Tensor) -> Shape:
    """A torus about the y axis, with the major radius 0.5."""
    return torus(0.5, minor)


CASES = (
    Case("sphere-frontal", sphere, 0.5, (0, 0, -2), (0, 0, 1), 1.5, (0, 0, -1), 1),
    # 0.3 off the axis: half a chord is (0.25 - 0.09)^(1/2) = 0.4.
    Case("sphere-oblique", sphere, 0.5, (0.3, 0, -2), (0, 0, 1), 1.6, (0.6, 0, -0.8), 0.8),
    # 0.48 off the axis: half a chord is (0.25 - 0.2304)^(1/2) = 0.14.
    Case("sphere-grazing", sphere, 0.5, (0, 0.48, -2), (0, 0, 1), 1.86, (0, 0.96, -0.28), 0.28),
    Case("plane-frontal", ground, -0.1, (0.2, 2, 0), (0, -1, 0), 2.1, (0, 1, 0), 1),
    # 1.6 down, at 4/5 per unit of distance.
    Case("plane-oblique", ground, 0.2, (-1, 1.8, 0), (3, -4, 0), 2, (0, 1, 0), 0.8),
    # 0.56 down, at 7/25 per unit of distance.
    Case("plane-grazing", ground, 0.0, (-2, 0.56, 0), (24, -7, 0), 2, (0, 1, 0), 0.28),
    Case("box-frontal", brick, 0.35, (0.1, -0.2, -2), (0, 0, 1), 1.65, (0, 0, -1), 1),
    # From z = -1.55 to -0.35, at 4/5 per unit of distance; x goes from -0.8 to 0.1.
    Case("box-oblique", brick, 0.35, (-0.8, 0, -1.55), (3, 0, 4), 1.5, (0, 0, -1), 0.8),
    # From z = -0.77 to -0.35, at 7/25 per unit of distance; x goes from -1.4 to 0.04.
    Case("box-grazing", brick, 0.35, (-1.4, 0, -0.77), (24, 0, 7), 1.5, (0, 0, -1), 0.28),
    # The ray goes down to the top of the tube.
    Case("torus-frontal", ring, 0.2, (0.5, 2, 0), (0, -1, 0), 1.8, (0, 1, 0), 1),
    # A level ray at height 0.12: half a chord of the tube is (0.04 - 0.0144)^(1/2) = 0.16, and 2 - 0.5 - 0.16 = 1.34.
    Case("torus-oblique", ring, 0.2, (2, 0.12, 0), (-1, 0, 0), 1.34, (0.8, 0.6, 0), 0.8),
    # At height 0.192: half a chord is 0.056.
    Case("torus-grazing", ring, 0.2, (2, 0.192, 0), (-1, 0, 0), 1.444, (0.28, 0.96, 0), 0.28),
)


def sphere_hits(rays: Rays, radius: float) -> tuple[Tensor, Tensor]:
    """The distance to the sphere about the origin, and whether the ray, which begins outside, hits it."""
    middle = -(rays.origins * rays.directions).sum(-1)
    square = radius**2 - rays.origins.square().sum(-1) + middle**2
    return middle - square.clamp_min(0).sqrt(), (square > 0) & (middle > 0)


def box_hits(rays: Rays, half_sizes: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """The distance to the box about the origin, by its slabs, and whether the ray, which begins outside, hits it."""
    half = torch.tensor(half_sizes, dtype=rays.origins.dtype)
    ends = torch.stack([(-half - rays.origins) / rays.directions, (half - rays.origins) / rays.directions])
    entry, leave = ends.amin(0).amax(-1), ends.amax(0).amin(-1)
    return entry, (entry < leave) & (entry > 0)
