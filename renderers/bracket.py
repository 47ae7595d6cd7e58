"""Roots between two samples of a field on a ray: the first change from free to occupied, and its refinement.

Everything here runs without a graph; `gradients.implicit` attaches the gradient afterwards.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field

REFINEMENTS = ("secant", "bisection")
BLOCK = 2**20  # samples along rays at a time: bounds memory, does not change results


@dataclass(frozen=True)
class Bracket:
    """Distances along n rays between which the field falls from positive to at most zero, and its values there."""

    near: Float[Tensor, " n"]
    far: Float[Tensor, " n"]
    near_value: Float[Tensor, " n"]
    far_value: Float[Tensor, " n"]

    def secant(self) -> Float[Tensor, " n"]:
        """Where the line through both ends meets zero."""
        share = self.near_value / (self.near_value - self.far_value)
        return self.near + share * (self.far - self.near)

    def middle(self) -> Float[Tensor, " n"]:
        """Half way between both ends."""
        return (self.near + self.far) / 2

    @property
    def columns(self) -> tuple[Tensor, ...]:
        """The tensors in the order of the constructor."""
        return self.near, self.far, self.near_value, self.far_value

    def some(self, index: Int[Tensor, " m"]) -> "Bracket":
        """The same of some of the rays."""
        return Bracket(*(column.index_select(0, index) for column in self.columns))

    def replaced(self, index: Int[Tensor, " m"], by: Bool[Tensor, " m"], others: "Bracket") -> "Bracket":
        """The same with the others, of m of the rays, for those of them that are to be replaced."""
        pairs = zip(self.columns, others.columns, strict=True)
        return Bracket(*(mine.index_put((index,), torch.where(by, other, mine[index])) for mine, other in pairs))

    def joined(self, other: "Bracket") -> "Bracket":
        """These brackets, and behind them the others."""
        return Bracket(*(torch.cat(pair) for pair in zip(self.columns, other.columns, strict=True)))


def evenly(entry: Float[Tensor, " n"], leave: Float[Tensor, " n"], count: int) -> Float[Tensor, "n count"]:
    """Equally spaced distances from where rays enter to where they leave."""
    shares = torch.linspace(0, 1, count, dtype=entry.dtype, device=entry.device)
    return entry[:, None] + shares * (leave - entry)[:, None]


def first_crossing(
    distance: Float[Tensor, "n samples"], value: Float[Tensor, "n samples"]
) -> tuple[Bool[Tensor, " n"], Bracket]:
    """The first interval between neighbouring samples over which the field falls from free to occupied (DVR, Eq. 10).

    Args:
        distance: of the samples, rising along each ray.
        value: of the field there, positive in free space.

    Returns:
        which rays have such an interval, and the intervals, without meaning where there is none.
    """
    falls = (value[:, :-1] > 0) & (value[:, 1:] <= 0)
    before = falls.to(torch.int8).argmax(dim=1, keepdim=True)
    pick = [table.gather(1, index).squeeze(1) for table in (distance, value) for index in (before, before + 1)]
    return falls.gather(1, before).squeeze(1), Bracket(*pick)


def narrow(field: Field, rays: Rays, bracket: Bracket, *, method: str, steps: int) -> Bracket:
    """Narrows brackets about the root, with one field value per step and ray.

    Args:
        field: where it has no finite value it counts as occupied, except at a bracket's near end.
        rays: n rays, as many as the bracket has.
        method: "secant", where the line through both ends meets zero, or "bisection", the middle.
    """
    near, far, near_value, far_value = bracket.near, bracket.far, bracket.near_value.nan_to_num(1.0), bracket.far_value
    for _ in range(steps):
        middle = _GUESSES[method](Bracket(near, far, near_value, far_value))
        value = field(rays.at(middle))
        value = torch.where(value.isfinite(), value, far_value)
        free = value > 0
        near, near_value = torch.where(free, middle, near), torch.where(free, value, near_value)
        far, far_value = torch.where(free, far, middle), torch.where(free, far_value, value)
    return Bracket(near, far, near_value, far_value)


def refine(
    field: Field, rays: Rays, bracket: Bracket, *, method: str, steps: int
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """The root in a bracket: the last estimate after `narrow`, and the field's value at the better end."""
    closer = narrow(field, rays, bracket, method=method, steps=steps)
    better = closer.near_value.abs() < closer.far_value.abs()
    return _GUESSES[method](closer), torch.where(better, closer.near_value, closer.far_value)


_GUESSES: dict[str, Callable[[Bracket], Tensor]] = {"secant": Bracket.secant, "bisection": Bracket.middle}
