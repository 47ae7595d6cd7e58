"""A field with its parameters, the contract of a candidate, and the result of a fit."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

import torch
from jaxtyping import Float
from torch import Tensor

from bench.records.record import RunStatus
from bench.tasks.capacity.held_out import HeldOutError
from renderers.field import Counts, Field, Meter

FLOAT_BYTES = 4  # float32


@dataclass(frozen=True)
class Size:
    """The size of a field, in float32; its attributes are the measures of `models.size`.

    Args:
        free: numbers that the optimiser may change.
        stored: numbers that a file must contain to evaluate the field, including the free ones; for a grid, all
            samples.
        sparse_bytes: size of a file from which the field can be computed with only the free numbers; None if it would
            be the same file.
    """

    free: int
    stored: int
    sparse_bytes: int | None = None

    @property
    def bytes(self) -> int:
        return FLOAT_BYTES * self.stored

    def by(self, measure: str) -> int:
        return getattr(self, measure)

    def __str__(self) -> str:
        return f"{self.stored:,} numbers" + (f", {self.free:,} of them free" if self.free < self.stored else "")


@dataclass
class Model:
    """A field and its parameters.

    Args:
        metric: whether the values are distances or bounds by construction; otherwise an eikonal term is added.
        fixed_count: number of stored values that are not parameters.
    """

    candidate: str
    parameters: list[Tensor]
    make: Callable[[list[Tensor]], Field]
    learning_rate: float
    metric: bool
    fixed_count: int = 0
    sparse_bytes: int | None = None

    @property
    def size(self) -> Size:
        free = sum(parameter.numel() for parameter in self.parameters)
        return Size(free, free + self.fixed_count, self.sparse_bytes)

    def field(self) -> Field:
        """The field of the current parameters, differentiable in them."""
        return self.make(self.parameters)

    def frozen(self) -> Field:
        """The field of a copy of the parameters, without gradients."""
        return self.make([parameter.detach().clone() for parameter in self.parameters])


@dataclass(frozen=True)
class StartInputs:
    """The inputs of a candidate's start."""

    points: Float[Tensor, "n 3"]
    previous: Model | None
    seed: int
    device: torch.device
    counts: Counts = field(default_factory=Counts)  # of evaluations of the previous model

    @torch.no_grad()
    def previous_values(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """The previous model's values, counted, on the CPU."""
        return Meter(self.previous.frozen(), self.counts)(points.to(self.device)).cpu()


@dataclass(frozen=True)
class Candidate:
    """A kind of field of a certain size.

    Args:
        flops: floating-point operations per evaluation; an estimate for primitives, where a power counts as 20.
        starts: returns models to start from; the model with the smallest loss after a short warm start is fitted.
        follows: whether it starts from the previous field, not from the observed points.
    """

    name: str
    stored: int
    flops: int
    starts: Callable[[StartInputs], list[Model]]
    tries: int = 1
    follows: bool = False


@dataclass
class Evidence:
    """The result of a candidate's fit, and its cost.

    Args:
        candidate: name of the candidate.
        flops_per_query: floating-point operations per evaluation.
        error: on held-out rays; None if the fit failed.
        status, reason: of the end of the fit.
        seconds, evaluations, gradients, flops: of the fit with its warm start, without checkpoints.
        iterations: of the fit, without its warm start and without an undone round; see `Fitter.finish`.
        falling: whether the last of several rounds, or the second half of a trial, lowered the error.
        held_within, held_enough: the fractions of draws of further views on which the candidate is within one standard
            error of the best one, and under the footprint; None if they were not checked.
        checkpoints: seconds, evaluations, gradients, flops and error at each checkpoint.
    """

    candidate: str
    size: Size
    flops_per_query: int = 0
    error: HeldOutError | None = None
    status: RunStatus = RunStatus.OK
    reason: str = ""
    seconds: float = 0.0
    evaluations: int = 0
    gradients: int = 0
    flops: int = 0
    iterations: int = 0
    falling: bool = False
    held_within: float | None = None
    held_enough: float | None = None
    checkpoints: list[dict[str, float]] = field(default_factory=list)

    @property
    def mean(self) -> float:
        """The mean error on held-out rays; infinite if the fit failed."""
        return inf if self.error is None else self.error.mean

    def field(self) -> dict[str, str | int | float]:
        """The field and its error, as metrics of a run that chose this field."""
        size = {f"field_{measure}": self.size.by(measure) for measure in ("free", "stored", "bytes")}
        return {"field": self.candidate, **size, "field_error": self.mean}
