"""Limits of time and memory of a rendering, checked at each evaluation of the field."""

import time
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from bench.machine.environment import MemoryPeak
from bench.records.record import RunStatus
from renderers.checks import check_positive
from renderers.field import Field, Wrapper

MEMORY_INTERVAL = 0.05  # seconds between two checks of the memory


class LimitReached(Exception):
    """A limit was reached; `status` says which."""

    def __init__(self, status: RunStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@dataclass(frozen=True)
class Limits:
    """The limits of one rendering, or of one step of an optimisation.

    Args:
        seconds: of wall-clock time.
        memory: rise above the process's memory before, in GiB.
    """

    seconds: float
    memory: float

    def __post_init__(self) -> None:
        check_positive("limits.seconds", self.seconds, "60 suits a laptop")
        check_positive("limits.memory", self.memory, "8 GiB suit a laptop")

    def watch(self, inner: Field, device: torch.device, work: str = "") -> "Watched":
        """A field that evaluates `inner` until a limit is reached, counted from now.

        Args:
            inner: the field.
            device: whose memory is watched.
            work: what is limited, named in the reason: "a step"; may be empty.
        """
        return Watched(inner, self, MemoryPeak(device), f" in {work}" if work else "")


@dataclass
class Watched(Wrapper):
    """A Field that raises LimitReached when it is evaluated, or differentiated, beyond the limits."""

    inner: Field
    limits: Limits
    memory: MemoryPeak
    where: str = ""  # " in a step": the end of the reason
    started: float = field(default_factory=lambda: time.perf_counter())
    memory_checked: float = 0.0

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
            raise LimitReached(RunStatus.TIMEOUT, f"more than {self.limits.seconds:g} s{self.where}")
        if now - self.memory_checked > MEMORY_INTERVAL:
            self.memory_checked = now
            growth = self.memory.growth()
            if growth is not None and growth > self.limits.memory * 2**30:
                raise LimitReached(RunStatus.OOM, f"more than {self.limits.memory:g} GiB of memory{self.where}")
