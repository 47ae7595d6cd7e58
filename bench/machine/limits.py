"""Limits of the work and the memory of a rendering, checked at each evaluation of the field."""

import time
from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.machine.environment import MemoryPeak
from bench.records.record import RunStatus
from renderers.checks import check_positive
from renderers.field import Coarse, Field, Wrapper, coarse_version

MEMORY_CHECK_SECONDS = 0.05  # interval
MIN_VALUES_PER_CALL = 32  # a call with fewer points counts as this many, as it takes about as long


class LimitReached(Exception):
    """A limit was reached; `status` says which."""

    def __init__(self, status: RunStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class Limits:
    """The limits of one rendering, or of one step of an optimisation.

    Work is limited instead of time, so that the limit is the same on a busy, a slow and an idle machine.

    Args:
        values: maximum number of field evaluations, coarse ones included. A call counts as at least
            `MIN_VALUES_PER_CALL`, and a gradient propagated back through it counts the same again.
        memory: maximum growth of the process's memory, in GiB.
    """

    values: float
    memory: float

    def __post_init__(self) -> None:
        check_positive("limits.values", self.values, "4e6 is about a minute of a laptop with a network of 8 x 512")
        check_positive("limits.memory", self.memory, "8 GiB suit a laptop")

    def watch(self, inner: Field, device: torch.device, work: str = "") -> "Watched":
        """A field that evaluates `inner` until a limit is reached, counted from now.

        Args:
            device: with the memory to check.
            work: name of the limited work in the reason, such as "a step"; may be empty.
        """
        return Watched(inner, self, MemoryPeak(device), f" in {work}" if work else "")


@dataclass
class Watched(Wrapper):
    """A Field that raises LimitReached when it is evaluated, or differentiated, beyond the limits.

    Args:
        where: the end of the reason, such as " in a step".
        spent: field evaluations so far, as counted by `Limits`.
    """

    inner: Field
    limits: Limits
    memory: MemoryPeak
    where: str
    spent: int = 0
    memory_checked: float = 0.0
    keeps_values: ClassVar[bool] = True

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        self._spend(points.numel() // 3)
        values = self.inner(points)
        if values.requires_grad:
            values.register_hook(lambda gradient: self._spend(gradient.numel()))
        return values

    @property
    def coarse(self) -> Coarse | None:
        """The coarse values of the field, until a limit is reached."""
        coarse = coarse_version(self.inner)
        return coarse and coarse.with_counter(self._spend)

    def count_work(self, evaluations: int) -> None:
        self._spend(evaluations)

    def _spend(self, values: int) -> None:
        """Counts field evaluations before they are made.

        Raises:
            LimitReached: if they exceed the limit, or if the memory does.
        """
        self.spent += max(values, MIN_VALUES_PER_CALL)
        if self.spent > self.limits.values:
            reason = f"more than {self.limits.values:,.0f} field values{self.where}"
            raise LimitReached(RunStatus.TIMEOUT, reason)
        now = time.perf_counter()
        if now - self.memory_checked > MEMORY_CHECK_SECONDS:
            self.memory_checked = now
            growth = self.memory.growth()
            if growth is not None and growth > self.limits.memory * 2**30:
                raise LimitReached(RunStatus.OOM, f"more than {self.limits.memory:g} GiB of memory{self.where}")
