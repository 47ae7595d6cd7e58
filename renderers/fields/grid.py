"""A field interpolated between samples on a grid: for any shape whose distances can be computed."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.field import Flops, Kind

FLOPS = Flops(value=40, gradient=60)  # eight products and sums, and their indices; an estimate


@dataclass(frozen=True)
class Grid:
    """Trilinear interpolation of signed distances in the cube from -reach to reach.

    Inside it is a distance, up to the square of the spacing where that is smooth and up to half of it at edges. Outside
    it is the hypotenuse of the value at the nearest point of the cube and the distance to that point: a bound, since
    the cube is convex and holds the shape.

    Args:
        values: [n, n, n] at evenly spaced points, in scene units; the indices are those of x, y and z.
        reach: half the cube's side, in scene units.
    """

    values: Float[Tensor, "n n n"]
    reach: float
    kind: Kind = Kind.DISTANCE
    lipschitz: float | None = None
    flops: Flops | None = FLOPS

    def __post_init__(self) -> None:
        if len(set(self.values.shape)) != 1 or self.values.dim() != 3 or self.values.shape[0] < 2:
            raise ValueError(f"values must have shape [n, n, n] with n of 2 or more, not {tuple(self.values.shape)}")
        if self.reach <= 0:
            raise ValueError(f"reach must be positive, not {self.reach}: 1.05 holds the unit sphere")

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        nearest = points.clamp(-self.reach, self.reach)
        count = self.values.shape[0]
        place = (nearest + self.reach) * ((count - 1) / (2 * self.reach))
        low = place.detach().floor().clamp(0, count - 2)
        x, y, z = (place - low).unbind(-1)
        column, row, layer = low.long().unbind(-1)
        corner = (column * count + row) * count + layer
        flat = self.values.reshape(-1)

        def along_z(first: Tensor) -> Tensor:
            below = flat[first]
            return below + z * (flat[first + 1] - below)

        def along_y(first: Tensor) -> Tensor:
            near = along_z(first)
            return near + y * (along_z(first + count) - near)

        near = along_y(corner)
        inside = near + x * (along_y(corner + count * count) - near)
        away = (points - nearest).square().sum(-1)
        outside = away > 0
        return torch.where(outside, torch.where(outside, inside.square() + away, 1.0).sqrt(), inside)
