"""Parts with a formula, and unions of them, by their numbers: each begins with its pose; sizes are logarithms."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import rigid
from renderers.field import Flops, Kind
from renderers.fields.analytic import Shape, sphere, superquadric
from renderers.fields.analytic import box as exact_box

EXPONENTS = (1.0, 20.0)  # of a superquadric: 1 is an octahedron, 20 nearly a box


@dataclass(frozen=True)
class Formula:
    """The values of a part or a union, from the name of its formula, one of `FORMULAS`, and its numbers."""

    name: str
    parameters: Tensor

    @cached_property
    def shape(self) -> Shape:
        """The formula at these numbers."""
        return FORMULAS[self.name](self.parameters)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.shape(points)


def formula(name: str, parameters: Tensor, flops: Flops) -> Shape:
    """The field of a formula, which keeps its name and its numbers."""
    found = Formula(name, parameters)
    return replace(found.shape, function=found, flops=flops)


def union(parameters: Float[Tensor, "parts 10"]) -> Shape:
    """A union of rounded boxes, computed as one batch: a loop over them takes as many times as long.

    Each has its pose, see `_placed`, the logarithms of its half sizes, and the logit of its edges' radius over the
    least of these; at 1 it is a capsule.
    """
    sizes = parameters[:, 6:9].exp()
    radii = torch.sigmoid(parameters[:, 9]) * sizes.amin(-1)
    turns = _turn(parameters)
    cores = exact_box(sizes - radii[:, None])

    def bound(points: Tensor) -> Tensor:
        local = torch.einsum("...pi,pij->...pj", points[..., None, :] - parameters[:, :3], turns)
        return (cores(local) - radii).amin(-1)

    return Shape(bound, Kind.DISTANCE if len(parameters) == 1 else Kind.BOUND)


def quadric(parameters: Float[Tensor, "11"]) -> Shape:
    """A superquadric: as an ellipsoid, then the logits of two exponents between `EXPONENTS`, on a logarithmic scale."""
    low, high = EXPONENTS
    powers = low * (high / low) ** torch.sigmoid(parameters[9:11])
    return _placed(superquadric(parameters[6:9].exp(), powers), parameters)


def _placed(shape: Shape, parameters: Float[Tensor, " n"]) -> Shape:
    """The shape turned by the rotation vector, parameters 3 to 5, and moved by the translation, the first three."""
    return shape.rotate(_turn(parameters)).translate(parameters[:3])


def _turn(parameters: Float[Tensor, "*parts n"]) -> Float[Tensor, "*parts 3 3"]:
    """Rotation matrices of the rotation vectors, parameters 3 to 5."""
    vector = parameters[..., 3:6]
    return rigid(torch.cat([torch.zeros_like(vector), vector], dim=-1))[..., :3, :3]


FORMULAS: dict[str, Callable[[Tensor], Shape]] = {  # all but a sphere begin with pose, and logarithms of half sizes
    "sphere": lambda p: sphere(p[3].exp(), p[:3]),  # centre, logarithm of the radius
    "ellipsoid": lambda p: _placed(sphere(1.0).stretch(p[6:9].exp()), p),
    "box": lambda p: _placed(exact_box(p[6:9].exp()), p),
    "rounded_box": lambda p: union(p[None]),
    "superquadric": quadric,
    "union": union,
}
