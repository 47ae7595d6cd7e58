"""Fewer waits of the host for a device: marches keep rays that have ended, and counts are read late."""

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# After so many steps a march leaves out the rays that have ended, by type of device. It asks for values of fewer points
# then, and must know how many rays are left: on a CPU that costs nothing, any other is waited for.
STEPS = {"cpu": 1}
SELDOM = 8  # of devices that are not named above

_active: ContextVar[Tensor | None] = ContextVar("active", default=None)


def steps_between(device: torch.device) -> int:
    """After how many steps a march leaves out the rays that have ended; what it finds does not depend on it."""
    return STEPS.get(device.type, SELDOM)


def values_where(
    active: Bool[Tensor, " n"], values: Callable[[Tensor], Tensor], points: Float[Tensor, "n 3"]
) -> Float[Tensor, " n"]:
    """The values at n points, of which those that are not `active` are thrown away; a Meter counts these apart."""
    token = _active.set(active)
    try:
        return values(points)
    finally:
        _active.reset(token)


def active_among(points: int) -> Bool[Tensor, " n"] | None:
    """Which of so many points are asked for within `values_where`; None where all are."""
    active = _active.get()
    return active if active is not None and len(active) == points else None


class Late:
    """A number of a dataclass, 0 at first, that a device may still be counting: who reads it waits, `add` does not."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.place = f"_{name}"

    def __get__(self, counts: Any, owner: type) -> int:
        if counts is None:
            return 0  # the default of the dataclass
        number = int(vars(counts)[self.place])
        vars(counts)[self.place] = number
        return number

    def __set__(self, counts: Any, number: "int | Late") -> None:
        vars(counts)[self.place] = 0 if isinstance(number, Late) else number  # the default, within `dataclasses.field`

    @staticmethod
    def add(counts: Any, name: str, number: int | Tensor) -> None:
        """Adds to the number of that name."""
        vars(counts)[f"_{name}"] += number
