"""Fields: callables from points to values, negative inside; what they state of themselves; normals; the Meter."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor


class Kind(Enum):
    """What the values of a field mean, from most to least.

    DISTANCE: the signed distance to the surface. BOUND: its magnitude never exceeds the distance, so that a step of
    that length passes no surface. LEVEL: only the sign and the zero set mean anything.
    """

    DISTANCE = "distance"
    BOUND = "bound"
    LEVEL = "level"


@runtime_checkable
class Field(Protocol):
    """Points [*batch, 3] to values [*batch], negative inside.

    `lipschitz` bounds the length of the gradient where a bound is known. `flops` is what one value costs in
    floating-point operations where that is known; a value with its gradient is counted as three times that.
    """

    kind: Kind
    lipschitz: float | None
    flops: int | None

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]: ...


@dataclass
class Counts:
    """Evaluations counted by a Meter: points whose value, and points whose gradient, was computed."""

    value: int = 0
    gradient: int = 0

    def flops(self, field: Field) -> int | None:
        """What the field spent on them, in floating-point operations; a backward pass costs about two values."""
        return None if field.flops is None else field.flops * (self.value + 2 * self.gradient)

    def __sub__(self, other: "Counts") -> "Counts":
        return Counts(self.value - other.value, self.gradient - other.gradient)


@dataclass(frozen=True)
class Meter:
    """A Field that counts what is asked of the field that it wraps, so that no renderer can under-report.

    A value evaluation is one point passed to the field. A gradient evaluation is one point whose value was
    back-propagated through, counted when the backward pass arrives there.
    """

    inner: Field
    counts: Counts = field(default_factory=Counts)

    @property
    def kind(self) -> Kind:
        return self.inner.kind

    @property
    def lipschitz(self) -> float | None:
        return self.inner.lipschitz

    @property
    def flops(self) -> int | None:
        return self.inner.flops

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        values = self.inner(points)
        self.counts.value += values.numel()
        if values.requires_grad:
            values.register_hook(self._count_backward)
        return values

    def _count_backward(self, gradient: Tensor) -> None:
        self.counts.gradient += gradient.numel()


def autograd_normals(field: Field, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit gradients of the field by automatic differentiation; zero where the gradient vanishes."""
    with torch.enable_grad():
        leaf = points.detach().requires_grad_(True)
        (gradient,) = torch.autograd.grad(field(leaf).sum(), leaf)
    return torch.nn.functional.normalize(gradient, dim=-1)


def central_difference_normals(
    field: Field, points: Float[Tensor, "*batch 3"], *, delta: float
) -> Float[Tensor, "*batch 3"]:
    """Unit gradients of the field by central differences (DIST, Eq. 3), at six values a point.

    Args:
        points: where, in scene units.
        delta: half the distance between the two samples on an axis, in scene units, positive.
    """
    if delta <= 0:
        raise ValueError(f"delta must be positive, not {delta}: 1e-3 suits scenes in the unit sphere")
    offsets = delta * torch.eye(3, dtype=points.dtype, device=points.device)
    ahead = field(points[..., None, :] + offsets)
    behind = field(points[..., None, :] - offsets)
    return torch.nn.functional.normalize((ahead - behind) / (2 * delta), dim=-1)
