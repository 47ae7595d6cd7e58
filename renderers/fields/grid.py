"""A field interpolated between distances sampled on a grid."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.field import Flops, Kind

FLOPS = Flops(value=40, gradient=60)  # eight products and sums, and their indices; an estimate


@dataclass(frozen=True)
class Grid:
    """Trilinear interpolation of signed distances in the cube from -reach to reach.

    Inside the cube it is a distance; its error is of the order of the squared spacing where the distance is smooth, and
    up to half the spacing at edges. Outside, the value is the hypotenuse of the value at the nearest point of the cube
    and the distance to that point. It is a bound, since the cube is convex and contains the shape.

    Args:
        values: [n, n, n] at evenly spaced points, in scene units; the axes are x, y and z.
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
        cell_coordinates = (nearest + self.reach) * ((count - 1) / (2 * self.reach))
        low = cell_coordinates.detach().floor().clamp(0, count - 2)
        x, y, z = (cell_coordinates - low).unbind(-1)
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
        squared_distance = (points - nearest).square().sum(-1)
        outside = squared_distance > 0
        return torch.where(outside, torch.where(outside, inside.square() + squared_distance, 1.0).sqrt(), inside)
