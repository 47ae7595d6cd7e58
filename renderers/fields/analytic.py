"""Analytic shapes and their combinations; each states its kind. A shape is a few lines: `sphere(0.5) | box((1, 1, 1))`.

Formulas for distances are standard (Hart 1996; Quilez, "distance functions"). Tensors as parameters get gradients.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.field import Flops, Kind

Numbers = float | Sequence[float] | Tensor
MIN_NORM_FRACTION = 1e-6  # parts of a norm below this fraction of the largest are raised to it: an error below 1e-6


@dataclass(frozen=True)
class Shape:
    """A Field from a formula. `|` is union, `&` intersection, `-` difference."""

    function: Callable[[Tensor], Tensor]
    kind: Kind = Kind.DISTANCE
    lipschitz: float | None = 1.0
    flops: Flops | None = None

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.function(points)

    def __or__(self, other: "Shape") -> "Shape":
        return _combine(torch.minimum, self, other)

    def __and__(self, other: "Shape") -> "Shape":
        return _combine(torch.maximum, self, other)

    def __sub__(self, other: "Shape") -> "Shape":
        return _combine(lambda a, b: torch.maximum(a, -b), self, other)

    def translate(self, offset: Numbers) -> "Shape":
        """The shape moved by `offset` [3]."""
        return self._replace(lambda p: self(p - _like(offset, p)))

    def rotate(self, rotation: Float[Tensor, "3 3"]) -> "Shape":
        """The shape turned by a rotation matrix: a surface point x goes to `rotation @ x`."""
        return self._replace(lambda p: self(p @ _like(rotation, p)))

    def scale(self, factor: Numbers) -> "Shape":
        """The shape made `factor` times as large, `factor` a positive number; its kind is kept."""
        return self._replace(lambda p: self(p / _like(factor, p)) * _like(factor, p))

    def stretch(self, factors: Numbers) -> "Shape":
        """The shape stretched along the axes by `factors` [3].

        The value times the smallest factor is a bound, but no longer a distance.
        """

        def stretched(points: Tensor) -> Tensor:
            axes = _like(factors, points)
            return self(points / axes) * axes.min()

        kind = Kind.LEVEL if self.kind is Kind.LEVEL else Kind.BOUND
        return Shape(stretched, kind, self.lipschitz)

    def _replace(self, function: Callable[[Tensor], Tensor]) -> "Shape":
        return Shape(function, self.kind, self.lipschitz)


def smooth_union(first: Shape, second: Shape, *, radius: Numbers) -> Shape:
    """Union with a fillet of about `radius` (quadratic smooth minimum).

    Its gradient is a convex combination of the two gradients, so the union of two bounds is a bound.
    """

    def blend(a: Tensor, b: Tensor) -> Tensor:
        width = _like(radius, a)
        overlap = (width - (a - b).abs()).clamp_min(0) / width
        return torch.minimum(a, b) - 0.25 * width * overlap**2

    return _combine(blend, first, second)


def sphere(radius: Numbers = 1.0, center: Numbers = (0.0, 0.0, 0.0)) -> Shape:
    """A sphere; exact distance."""
    return Shape(lambda p: torch.linalg.vector_norm(p - _like(center, p), dim=-1) - _like(radius, p))


def plane(normal: Numbers = (0.0, 1.0, 0.0), offset: Numbers = 0.0) -> Shape:
    """The half space below `normal . x = offset`; exact distance. `normal` [3] need not have unit length."""
    return Shape(lambda p: ((p * _like(normal, p)).sum(-1) - _like(offset, p)) / _norm(_like(normal, p)))


def box(half_sizes: Numbers) -> Shape:
    """An axis-aligned box about the origin, with half side lengths `half_sizes` [3]; exact distance."""
    return Shape(lambda p: _box_distance(p.abs() - _like(half_sizes, p)))


def rounded_box(half_sizes: Numbers, radius: Numbers) -> Shape:
    """A box whose edges are rounded by `radius`; `half_sizes` [3] include the rounding; exact distance."""
    return Shape(lambda p: box(_like(half_sizes, p) - _like(radius, p))(p) - _like(radius, p))


def superquadric(half_sizes: Numbers, exponents: Numbers) -> Shape:
    """A superquadric (Barr 1981) of half sizes `half_sizes` [3] about the origin; a bound.

    On its surface the norm ((|x|^p + |y|^p)^(q/p) + |z|^q)^(1/q) of the coordinates over the half sizes is 1. The
    Lipschitz constant of this norm, by which values are divided, has a factor 2^(1/p - 1/2) per exponent p below 2.

    Args:
        half_sizes: along x, y and z, in scene units, positive.
        exponents: p across x and y, q towards z, at least 1: 1 gives an octahedron, 2 an ellipsoid, 20 nearly a box.
    """

    def bound(points: Tensor) -> Tensor:
        sizes = _like(half_sizes, points)
        p, q = _like(exponents, points).unbind()
        x, y, z = (points / sizes).abs().unbind(-1)
        slope = 2 ** ((1 / p - 0.5).clamp_min(0) + (1 / q - 0.5).clamp_min(0))
        return sizes.min() / slope * (_power_norm(torch.stack([_power_norm(torch.stack([x, y], -1), p), z], -1), q) - 1)

    return Shape(bound, Kind.BOUND)


def torus(major: Numbers, minor: Numbers) -> Shape:
    """A torus about the y axis: tube of radius `minor` around a circle of radius `major`; exact distance."""

    def distance(points: Tensor) -> Tensor:
        ring = _norm(points[..., [0, 2]]) - _like(major, points)
        return _norm(torch.stack([ring, points[..., 1]], -1)) - _like(minor, points)

    return Shape(distance)


def capsule(start: Numbers, end: Numbers, radius: Numbers) -> Shape:
    """All points within `radius` of the segment from `start` [3] to `end` [3]; exact distance."""

    def distance(points: Tensor) -> Tensor:
        a, b = _like(start, points), _like(end, points)
        along = ((points - a) @ (b - a) / (b - a).dot(b - a)).clamp(0, 1)
        return _norm(points - a - along[..., None] * (b - a)) - _like(radius, points)

    return Shape(distance)


def cylinder(radius: Numbers, half_height: Numbers) -> Shape:
    """A cylinder about the y axis; exact distance."""

    def distance(points: Tensor) -> Tensor:
        beyond = torch.stack(
            [
                _norm(points[..., [0, 2]]) - _like(radius, points),
                points[..., 1].abs() - _like(half_height, points),
            ],
            -1,
        )
        return _box_distance(beyond)

    return Shape(distance)


def _combine(function: Callable[[Tensor, Tensor], Tensor], first: Shape, second: Shape) -> Shape:
    """Applies a function that is 1-Lipschitz in the two fields' values, so that two bounds give a bound."""
    kind = Kind.LEVEL if Kind.LEVEL in (first.kind, second.kind) else Kind.BOUND
    a, b = first.lipschitz, second.lipschitz
    lipschitz = None if a is None or b is None else max(a, b)
    return Shape(lambda p: function(first(p), second(p)), kind, lipschitz)


def _like(value: Numbers, points: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=points.dtype, device=points.device)


def _power_norm(parts: Float[Tensor, "*batch 2"], power: Tensor) -> Float[Tensor, "*batch"]:
    """The p-norm for p = `power` of non-negative parts; scaled by the largest part, so that no power overflows."""
    largest = parts.amax(-1, keepdim=True).clamp_min(torch.finfo(parts.dtype).tiny)
    fractions = (parts / largest).clamp_min(MIN_NORM_FRACTION)  # 0 ** power has no gradient towards power
    return largest.squeeze(-1) * (fractions**power).sum(-1) ** (1 / power)


def _box_distance(beyond: Tensor) -> Tensor:
    """The distance of a box, from signed distances to its sides; on a side the gradient is that of the inside."""
    largest = beyond.amax(-1)
    inside = largest - largest.relu()  # not clamp_max: at 0 it has no gradient from PyTorch 2.14 on
    return _norm(beyond.clamp_min(0)) + inside


def _norm(vectors: Tensor) -> Tensor:
    """Euclidean length with a zero gradient, not NaN, at zero."""
    return torch.linalg.vector_norm(vectors, dim=-1)
