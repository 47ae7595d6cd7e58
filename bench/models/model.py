"""A field with its parameters, and the contract of a candidate."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from bench.setup.fields import SIZE_WORDS
from renderers.field import Counts, Field, Meter

FLOAT = 4  # bytes of a float32


@dataclass(frozen=True)
class Size:
    """The size of a field, in float32; its attributes are the measures of `models.size`.

    Args:
        free: numbers that the optimiser may change.
        stored: numbers that a file must hold so that the field can be evaluated, the free ones among them: of a grid,
            all its samples.
        sparse_bytes: of a file with the free numbers only, from which the same field can be computed; None where it
            would be the same file.
    """

    free: int
    stored: int
    sparse_bytes: int | None = None

    @property
    def bytes(self) -> int:
        """The size of a file with all stored numbers."""
        return FLOAT * self.stored

    def by(self, measure: str) -> int:
        """The size by a measure of `models.size`."""
        assert measure in SIZE_WORDS
        return getattr(self, measure)

    def __str__(self) -> str:
        """The numbers in words."""
        return f"{self.stored:,} numbers" + (f", {self.free:,} of them free" if self.free < self.stored else "")


@dataclass
class Model:
    """A field and its parameters.

    Args:
        candidate: its name.
        parameters: that are fitted.
        make: gives the field of such parameters.
        learning_rate: of Adam, for these parameters.
        metric: whether the values are distances or bounds by construction; else an eikonal term keeps them so.
        held: number of stored values in addition to the parameters.
        sparse_bytes: see `Size`.
    """

    candidate: str
    parameters: list[Tensor]
    make: Callable[[list[Tensor]], Field]
    learning_rate: float
    metric: bool
    held: int = 0
    sparse_bytes: int | None = None

    @property
    def size(self) -> Size:
        """Its free and its stored numbers."""
        free = sum(parameter.numel() for parameter in self.parameters)
        return Size(free, free + self.held, self.sparse_bytes)

    def field(self) -> Field:
        """The field of the current parameters, with gradients towards them."""
        return self.make(self.parameters)

    def frozen(self) -> Field:
        """The field of a copy of the parameters, without gradients."""
        return self.make([parameter.detach().clone() for parameter in self.parameters])


@dataclass(frozen=True)
class Seen:
    """What a candidate's start may use.

    Args:
        points: observed points of the surface; may be empty.
        previous: the best model so far, if there is one.
        seed: of random draws.
        device: of the parameters.
    """

    points: Float[Tensor, "n 3"]
    previous: Model | None
    seed: int
    device: torch.device
    counts: Counts = field(default_factory=Counts)  # of evaluations of the previous model

    @torch.no_grad()
    def previous_values(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """The previous model's values, counted, on the CPU."""
        assert self.previous is not None
        return Meter(self.previous.frozen(), self.counts)(points.to(self.device)).cpu()


@runtime_checkable
class Candidate(Protocol):
    """A kind of field, of a certain size."""

    @property
    def name(self) -> str: ...

    @property
    def stored(self) -> int:
        """Its stored numbers, see `Size`, which are known before its start; the free ones of a grid are not."""
        ...

    @property
    def flops(self) -> int:
        """Floating-point operations per value."""
        ...

    @property
    def tries(self) -> int:
        """The largest number of starts."""
        ...

    @property
    def follows(self) -> bool:
        """Whether it begins with the previous field, not with the observed points."""
        ...

    def starts(self, seen: Seen) -> list[Model]:
        """Models to start from; the one with the least loss after a short warm start is fitted."""
        ...
