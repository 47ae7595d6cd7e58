"""A field with free numbers: what a rung of the ladder is fitted as."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.field import Counts, Field, Meter

FLOAT = 4  # bytes of a float32


@dataclass
class Model:
    """A field and its free numbers.

    Args:
        rung: its name.
        parameters: what is free.
        make: the field of such numbers.
        learning_rate: of Adam, at which these numbers are fitted.
        metric: whether the values are distances, or bounds, whatever the numbers; else they have to be kept so.
        held: numbers, beside the free ones, that the field is kept in.
    """

    rung: str
    parameters: list[Tensor]
    make: Callable[[list[Tensor]], Field]
    learning_rate: float
    metric: bool
    held: int = 0

    @property
    def size(self) -> int:
        """How many numbers are free."""
        return sum(parameter.numel() for parameter in self.parameters)

    @property
    def bytes(self) -> int:
        """What it takes to keep the field."""
        return FLOAT * (self.size + self.held)

    def field(self) -> Field:
        """The field of the numbers as they stand, with gradients towards them."""
        return self.make(self.parameters)

    def frozen(self) -> Field:
        """The field of a copy of the numbers, without gradients."""
        return self.make([parameter.detach().clone() for parameter in self.parameters])


@dataclass(frozen=True)
class Seen:
    """What a rung may begin with.

    Args:
        points: of the surface, where the observed pixels saw it; may be empty.
        previous: the best model so far, if there is one.
        seed: of what is drawn.
        device: of the numbers.
    """

    points: Float[Tensor, "n 3"]
    previous: Model | None
    seed: int
    device: torch.device
    counts: Counts = field(default_factory=Counts)  # of the previous model's values that were asked for

    @torch.no_grad()
    def ask(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """The previous model's values, counted, on the CPU."""
        assert self.previous is not None
        return Meter(self.previous.frozen(), self.counts)(points.to(self.device)).cpu()


@runtime_checkable
class Rung(Protocol):
    """A kind of field of a certain size."""

    @property
    def name(self) -> str: ...

    @property
    def flops(self) -> int:
        """That a value costs; what it costs to fit grows with it."""
        ...

    @property
    def tries(self) -> int:
        """How many starts it has, at most."""
        ...

    @property
    def follows(self) -> bool:
        """Whether it begins with another field, and not with the observed points."""
        ...

    def starts(self, seen: Seen) -> list[Model]:
        """Models before they are fitted, of which the one whose warm start ends best goes on."""
        ...
