"""Roots between two samples of a field on a ray: the first change from free to occupied, and its refinement.

Nothing here builds a graph; `gradients.attach_implicit_gradient` attaches the gradient afterwards.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field

REFINEMENTS = ("secant", "bisection")
SAMPLES_PER_BATCH = 2**20  # limits memory, does not change results


@dataclass(frozen=True)
class Bracket:
    """Distances along n rays between which the field falls from positive to at most zero, with the values there."""

    near: Float[Tensor, " n"]
    far: Float[Tensor, " n"]
    near_value: Float[Tensor, " n"]
    far_value: Float[Tensor, " n"]

    def secant(self) -> Float[Tensor, " n"]:
        """Where the line through both ends meets zero."""
        fraction = self.near_value / (self.near_value - self.far_value)
        return self.near + fraction * (self.far - self.near)

    def middle(self) -> Float[Tensor, " n"]:
        """Half way between both ends."""
        return (self.near + self.far) / 2

    @property
    def columns(self) -> tuple[Tensor, ...]:
        """The tensors in the order of the constructor."""
        return self.near, self.far, self.near_value, self.far_value

    def select(self, index: Int[Tensor, " m"]) -> "Bracket":
        """The brackets of the rays in `index`."""
        return Bracket(*(column.index_select(0, index) for column in self.columns))


def equally_spaced(start: Float[Tensor, " n"], end: Float[Tensor, " n"], count: int) -> Float[Tensor, "n count"]:
    """Equally spaced distances along n rays, `start` and `end` included."""
    fractions = torch.linspace(0, 1, count, dtype=start.dtype, device=start.device)
    return start[:, None] + fractions * (end - start)[:, None]


def first_crossing(
    distance: Float[Tensor, "n samples"], value: Float[Tensor, "n samples"]
) -> tuple[Bool[Tensor, " n"], Bracket]:
    """The first interval between neighbouring samples over which the field falls from free to occupied (DVR, Eq. 10).

    Args:
        distance: of the samples, rising along each ray.
        value: of the field at the samples, positive in free space.

    Returns:
        which rays have such an interval, and the intervals; the intervals of other rays are meaningless.
    """
    falls = (value[:, :-1] > 0) & (value[:, 1:] <= 0)
    first = falls.to(torch.int8).argmax(dim=1, keepdim=True)
    columns = [table.gather(1, index).squeeze(1) for table in (distance, value) for index in (first, first + 1)]
    return falls.gather(1, first).squeeze(1), Bracket(*columns)


def narrow(field: Field, rays: Rays, bracket: Bracket, *, method: str, steps: int) -> Bracket:
    """Narrows brackets about the root, with one field evaluation per step and ray.

    Args:
        field: points without a finite value count as occupied, except at a bracket's near end.
        rays: the n rays of the bracket.
        method: "secant", where the line through both ends meets zero, or "bisection", the middle.
    """
    near, far, near_value, far_value = bracket.near, bracket.far, bracket.near_value.nan_to_num(1.0), bracket.far_value
    for _ in range(steps):
        estimate = _ROOT_ESTIMATORS[method](Bracket(near, far, near_value, far_value))
        value = field(rays.at(estimate))
        value = torch.where(value.isfinite(), value, far_value)
        free = value > 0
        near, near_value = torch.where(free, estimate, near), torch.where(free, value, near_value)
        far, far_value = torch.where(free, far, estimate), torch.where(free, far_value, value)
    return Bracket(near, far, near_value, far_value)


def refine(
    field: Field, rays: Rays, bracket: Bracket, *, method: str, steps: int
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """The root in a bracket: the last estimate after `narrow`, and the field's value at the better end."""
    closer = narrow(field, rays, bracket, method=method, steps=steps)
    better = closer.near_value.abs() < closer.far_value.abs()
    return _ROOT_ESTIMATORS[method](closer), torch.where(better, closer.near_value, closer.far_value)


_ROOT_ESTIMATORS: dict[str, Callable[[Bracket], Tensor]] = {"secant": Bracket.secant, "bisection": Bracket.middle}
