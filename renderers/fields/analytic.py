"""Analytic shapes and their combinations; each states its kind. A shape is a few lines: `sphere(0.5) | box((1, 1, 1))`.

Formulas for distances are standard (Hart 1996; Quilez, "distance functions"). Tensors as parameters get gradients.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.field import Flops, Kind

Numbers = float | Sequence[float | Tensor] | Tensor


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
        return self._replace(lambda p: self(p - like(offset, p)))

    def rotate(self, rotation: Float[Tensor, "3 3"]) -> "Shape":
        """The shape turned by a rotation matrix: a surface point x goes to `rotation @ x`."""
        return self._replace(lambda p: self(p @ like(rotation, p)))

    def scale(self, factor: Numbers) -> "Shape":
        """The shape made `factor` times as large, `factor` a positive number; its kind is kept."""
        return self._replace(lambda p: self(p / like(factor, p)) * like(factor, p))

    def stretch(self, factors: Numbers) -> "Shape":
        """The shape stretched along the axes by `factors` [3].

        The value times the smallest factor is a bound, but no longer a distance.
        """

        def stretched(points: Tensor) -> Tensor:
            axes = like(factors, points)
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
        width = like(radius, a)
        overlap = (width - (a - b).abs()).clamp_min(0) / width
        return torch.minimum(a, b) - 0.25 * width * overlap**2

    return _combine(blend, first, second)


def sphere(radius: Numbers = 1.0, center: Numbers = (0.0, 0.0, 0.0)) -> Shape:
    """A sphere; exact distance."""
    return Shape(lambda p: torch.linalg.vector_norm(p - like(center, p), dim=-1) - like(radius, p))


def plane(normal: Numbers = (0.0, 1.0, 0.0), offset: Numbers = 0.0) -> Shape:
    """The half space below `normal . x = offset`; exact distance. `normal` [3] need not have unit length."""
    return Shape(lambda p: ((p * like(normal, p)).sum(-1) - like(offset, p)) / _norm(like(normal, p)))


def box(half_sizes: Numbers) -> Shape:
    """An axis-aligned box about the origin, with half side lengths `half_sizes` [3]; exact distance."""
    return Shape(lambda p: _box_distance(p.abs() - like(half_sizes, p)))


def rounded_box(half_sizes: Numbers, radius: Numbers) -> Shape:
    """A box whose edges are rounded by `radius`; `half_sizes` [3] include the rounding; exact distance."""
    return Shape(lambda p: box(like(half_sizes, p) - like(radius, p))(p) - like(radius, p))


def torus(major: Numbers, minor: Numbers) -> Shape:
    """A torus about the y axis: tube of radius `minor` around a circle of radius `major`; exact distance."""

    def distance(points: Tensor) -> Tensor:
        ring = _norm(points[..., [0, 2]]) - like(major, points)
        return _norm(torch.stack([ring, points[..., 1]], -1)) - like(minor, points)

    return Shape(distance)


def capsule(start: Numbers, end: Numbers, radius: Numbers) -> Shape:
    """All points within `radius` of the segment from `start` [3] to `end` [3]; exact distance."""

    def distance(points: Tensor) -> Tensor:
        a, b = like(start, points), like(end, points)
        along = ((points - a) @ (b - a) / (b - a).dot(b - a)).clamp(0, 1)
        return _norm(points - a - along[..., None] * (b - a)) - like(radius, points)

    return Shape(distance)


def cylinder(radius: Numbers, half_height: Numbers) -> Shape:
    """A cylinder about the y axis; exact distance."""

    def distance(points: Tensor) -> Tensor:
        side, end = _norm(points[..., [0, 2]]) - like(radius, points), points[..., 1].abs() - like(half_height, points)
        return _box_distance(torch.stack([side, end], -1))

    return Shape(distance)


def _combine(function: Callable[[Tensor, Tensor], Tensor], first: Shape, second: Shape) -> Shape:
    """Applies a function that is 1-Lipschitz in the two fields' values, so that two bounds give a bound."""
    kind = Kind.LEVEL if Kind.LEVEL in (first.kind, second.kind) else Kind.BOUND
    a, b = first.lipschitz, second.lipschitz
    lipschitz = None if a is None or b is None else max(a, b)
    return Shape(lambda p: function(first(p), second(p)), kind, lipschitz)


def like(value: Numbers, points: Tensor) -> Tensor:
    """The value as a tensor of the dtype and device of the points; tensors in a tuple keep their gradients."""
    if isinstance(value, tuple) and any(isinstance(number, Tensor) for number in value):
        return torch.stack([like(number, points) for number in value])
    return torch.as_tensor(value, dtype=points.dtype, device=points.device)


def _box_distance(beyond: Tensor) -> Tensor:
    """The distance of a box, from signed distances to its sides; on a side the gradient is that of the inside."""
    largest = beyond.amax(-1)
    inside = largest - largest.relu()  # not clamp_max: at 0 it has no gradient from PyTorch 2.14 on
    return _norm(beyond.clamp_min(0)) + inside


def _norm(vectors: Tensor) -> Tensor:
    """Euclidean length with a zero gradient, not NaN, at zero."""
    return torch.linalg.vector_norm(vectors, dim=-1)
