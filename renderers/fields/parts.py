"""Parametric parts, and unions of them. Parameters begin with the pose; sizes are given as logarithms."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.camera import rigid
from renderers.field import Flops, Kind
from renderers.fields.analytic import Numbers, Shape, like, sphere
from renderers.fields.analytic import box as exact_box

MIN_NORM_FRACTION = 1e-6  # parts of a norm below this fraction of the largest are raised to it: an error below 1e-6
EXPONENT_RANGE = (1.0, 20.0)  # from an octahedron to nearly a box


@dataclass(frozen=True)
class Formula:
    """The values of a part or a union: `FORMULAS[name]` at its parameters."""

    name: str
    parameters: Tensor

    @cached_property
    def shape(self) -> Shape:
        """The formula at these parameters."""
        return FORMULAS[self.name](self.parameters)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.shape(points)


def formula(name: str, parameters: Tensor, flops: Flops) -> Shape:
    """The field of a formula; its function keeps the name and the parameters."""
    values = Formula(name, parameters)
    return replace(values.shape, function=values, flops=flops)


def union(parameters: Float[Tensor, "parts 10"]) -> Shape:
    """A union of rounded boxes, computed as one batch, since a loop over n boxes takes n times as long.

    The parameters of a box are its pose (see `_apply_pose`), the logarithms of its half sizes, and a logit: that of
    the radius of its edges over the smallest half size. At a ratio of 1 the box is a capsule.
    """
    sizes = parameters[:, 6:9].exp()
    radii = torch.sigmoid(parameters[:, 9]) * sizes.amin(-1)
    rotations = _rotations(parameters)
    cores = exact_box(sizes - radii[:, None])

    def bound(points: Tensor) -> Tensor:
        local = torch.einsum("...pi,pij->...pj", points[..., None, :] - parameters[:, :3], rotations)
        return (cores(local) - radii).amin(-1)

    return Shape(bound, Kind.DISTANCE if len(parameters) == 1 else Kind.BOUND)


def quadric(parameters: Float[Tensor, "11"]) -> Shape:
    """A superquadric: pose, half sizes, and logits of two exponents in `EXPONENT_RANGE`, on a logarithmic scale."""
    low, high = EXPONENT_RANGE
    powers = low * (high / low) ** torch.sigmoid(parameters[9:11])
    return _apply_pose(superquadric(parameters[6:9].exp(), powers), parameters)


def superquadric(half_sizes: Numbers, exponents: Numbers) -> Shape:
    """A superquadric (Barr 1981) of half sizes `half_sizes` [3] about the origin; a bound.

    On its surface the norm ((|x|^p + |y|^p)^(q/p) + |z|^q)^(1/q) of the coordinates over the half sizes is 1. The
    Lipschitz constant of this norm, by which values are divided, has a factor 2^(1/p - 1/2) per exponent p below 2.

    Args:
        half_sizes: along x, y and z, in scene units, positive.
        exponents: p across x and y, q towards z, at least 1: 1 gives an octahedron, 2 an ellipsoid, 20 nearly a box.
    """

    def bound(points: Tensor) -> Tensor:
        sizes = like(half_sizes, points)
        p, q = like(exponents, points).unbind()
        x, y, z = (points / sizes).abs().unbind(-1)
        slope = 2 ** ((1 / p - 0.5).clamp_min(0) + (1 / q - 0.5).clamp_min(0))
        return sizes.min() / slope * (_power_norm(torch.stack([_power_norm(torch.stack([x, y], -1), p), z], -1), q) - 1)

    return Shape(bound, Kind.BOUND)


def _apply_pose(shape: Shape, parameters: Float[Tensor, " n"]) -> Shape:
    """Rotates a shape by the rotation vector, parameters 3 to 5, then translates it by parameters 0 to 2."""
    return shape.rotate(_rotations(parameters)).translate(parameters[:3])


def _rotations(parameters: Float[Tensor, "*parts n"]) -> Float[Tensor, "*parts 3 3"]:
    """Rotation matrices of the rotation vectors, parameters 3 to 5."""
    vector = parameters[..., 3:6]
    return rigid(torch.cat([torch.zeros_like(vector), vector], dim=-1))[..., :3, :3]


def _power_norm(parts: Float[Tensor, "*batch 2"], power: Tensor) -> Float[Tensor, "*batch"]:
    """The p-norm for p = `power` of non-negative parts; scaled by the largest part, so that no power overflows."""
    largest = parts.amax(-1, keepdim=True).clamp_min(torch.finfo(parts.dtype).tiny)
    fractions = (parts / largest).clamp_min(MIN_NORM_FRACTION)  # 0 ** power has no gradient towards power
    return largest.squeeze(-1) * (fractions**power).sum(-1) ** (1 / power)


FORMULAS: dict[str, Callable[[Tensor], Shape]] = {  # all except the sphere begin with pose and log half sizes
    "sphere": lambda p: sphere(p[3].exp(), p[:3]),  # centre, logarithm of the radius
    "ellipsoid": lambda p: _apply_pose(sphere(1.0).stretch(p[6:9].exp()), p),
    "box": lambda p: _apply_pose(exact_box(p[6:9].exp()), p),
    "rounded_box": lambda p: union(p[None]),
    "superquadric": quadric,
    "union": union,
}
