"""Limits of work and memory of a rendering, checked at each evaluation of the field."""

import time
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bench.machine.environment import MemoryPeak
from bench.records.record import RunStatus
from renderers.checks import check_positive
from renderers.field import Bounds, Coarse, Field, Wrapper, coarse_version, counted_bounds

MEMORY_INTERVAL = 0.05  # seconds between two checks of the memory
LEAST = 32  # values that a call counts as at least: calls for fewer points take about as long


class LimitReached(Exception):
    """A limit was reached; `status` says which."""

    def __init__(self, status: RunStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class Limits:
    """The limits of one rendering, or of one step of an optimisation.

    Work is limited, and not time, so that a busy or a slow machine reaches no other limit than a quiet one.

    Args:
        values: of the field, most of them that are evaluated, coarse ones included. A call counts as `LEAST` or more,
            and as much again where a gradient is propagated back through it.
        memory: rise above the process's memory before, in GiB.
    """

    values: float
    memory: float

    def __post_init__(self) -> None:
        check_positive("limits.values", self.values, "4e6 is about a minute of a laptop with a network of 8 x 512")
        check_positive("limits.memory", self.memory, "8 GiB suit a laptop")

    def watch(self, inner: Field, device: torch.device, work: str = "") -> "Watched":
        """A field that evaluates `inner` until a limit is reached, counted from now.

        Args:
            device: whose memory is watched.
            work: what is limited, named in the reason: "a step"; may be empty.
        """
        return Watched(inner, self, MemoryPeak(device), f" in {work}" if work else "")


@dataclass
class Watched(Wrapper):
    """A Field that raises LimitReached when it is evaluated, or differentiated, beyond the limits.

    Args:
        where: the end of the reason: " in a step".
        spent: values evaluated so far, as `Limits` counts them.
    """

    inner: Field
    limits: Limits
    memory: MemoryPeak
    where: str
    spent: int = 0
    memory_checked: float = 0.0

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        self._spend(points.numel() // 3)
        values = self.inner(points)
        if values.requires_grad:
            values.register_hook(lambda gradient: self._spend(gradient.numel()))
        return values

    @property
    def coarse(self) -> Coarse | None:
        """The coarse values of the field, until a limit is reached."""
        offered = coarse_version(self.inner)
        return offered and offered.with_counter(self._spend)

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that the field offers, until a limit is reached."""
        return counted_bounds(self.inner, self._spend)

    def _spend(self, values: int) -> None:
        """Counts values before they are evaluated.

        Raises:
            LimitReached: where they are too many, or the memory has grown too much.
        """
        self.spent += max(values, LEAST)
        if self.spent > self.limits.values:
            reason = f"more than {self.limits.values:,.0f} field values{self.where}"
            raise LimitReached(RunStatus.TIMEOUT, reason)
        now = time.perf_counter()
        if now - self.memory_checked > MEMORY_INTERVAL:
            self.memory_checked = now
            growth = self.memory.growth()
            if growth is not None and growth > self.limits.memory * 2**30:
                raise LimitReached(RunStatus.OOM, f"more than {self.limits.memory:g} GiB of memory{self.where}")
