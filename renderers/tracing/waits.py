"""Fewer synchronisations with a GPU: marches keep finished rays for some steps."""

from collections.abc import Callable
from contextvars import ContextVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Steps between two removals of finished rays from a march, by type of device. A removal saves field evaluations, but
# needs the number of rays that are left: on a CPU that costs nothing, for any other device the host waits.
COMPACTION_INTERVALS = {"cpu": 1}
DEFAULT_COMPACTION_INTERVAL = 8

_active: ContextVar[Tensor | None] = ContextVar("active", default=None)


def compaction_interval(device: torch.device) -> int:
    """The number of steps between two removals of finished rays. It affects speed only, not the rendering."""
    return COMPACTION_INTERVALS.get(device.type, DEFAULT_COMPACTION_INTERVAL)


def evaluate_masked(
    active: Bool[Tensor, " n"], values: Callable[[Tensor], Tensor], points: Float[Tensor, "n 3"]
) -> Float[Tensor, " n"]:
    """The values at n points. Those of inactive points are thrown away; a Meter counts them separately."""
    token = _active.set(active)
    try:
        return values(points)
    finally:
        _active.reset(token)


def active_mask(points: int) -> Bool[Tensor, " n"] | None:
    """The mask of `evaluate_masked`, if it is running and has this number of points; None if all points are active."""
    active = _active.get()
    return active if active is not None and len(active) == points else None
