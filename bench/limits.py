"""Limits on what one rendering may take, watched at the field, which every renderer must ask."""

import time
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from bench.environment import MemoryPeak
from bench.records import RunStatus
from renderers.checks import check_positive
from renderers.field import Field, Flops, Kind

BETWEEN = 0.05  # seconds between two looks at the memory


class LimitReached(Exception):
    """A limit was reached; `status` says which."""

    def __init__(self, status: RunStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class Limits:
    """What one rendering, or one step of an optimisation, may take.

    Args:
        seconds: of wall-clock time.
        memory: above where the process stood before, in GiB.
    """

    seconds: float
    memory: float

    def __post_init__(self) -> None:
        check_positive("limits.seconds", self.seconds, "60 suits a laptop")
        check_positive("limits.memory", self.memory, "8 GiB suit a laptop")

    def watch(self, inner: Field, device: torch.device) -> "Watched":
        """A field that gives what `inner` gives until a limit is reached, counted from now."""
        return Watched(inner, self, MemoryPeak(device))


@dataclass
class Watched:
    """A Field that raises LimitReached when it is asked, or propagated back through, beyond the limits."""

    inner: Field
    limits: Limits
    memory: MemoryPeak
    started: float = field(default_factory=time.perf_counter)
    looked: float = 0.0

    @property
    def kind(self) -> Kind:
        return self.inner.kind

    @property
    def lipschitz(self) -> float | None:
        return self.inner.lipschitz

    @property
    def flops(self) -> Flops | None:
        return self.inner.flops

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        self._check()
        values = self.inner(points)
        if values.requires_grad:
            values.register_hook(self._check_backward)
        return values

    def _check_backward(self, gradient: Tensor) -> None:
        self._check()

    def _check(self) -> None:
        now = time.perf_counter()
        if now - self.started > self.limits.seconds:
            raise LimitReached(RunStatus.TIMEOUT, f"more than {self.limits.seconds:g} s")
        if now - self.looked > BETWEEN:
            self.looked = now
            growth = self.memory.growth()
            if growth is not None and growth > self.limits.memory * 2**30:
                raise LimitReached(RunStatus.OOM, f"more than {self.limits.memory:g} GiB of memory")
