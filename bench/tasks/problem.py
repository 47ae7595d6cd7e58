"""What a task is to the runner: it builds a Problem, which has free parameters, a loss, and a field to judge."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool
from torch import Tensor

from bench.autodecoder import Prior
from datasets.scene import Scene
from renderers.field import Counts, Field
from renderers.rendering import Renderer


class Unsupported(Exception):
    """A renderer lacks what a task needs; the message says what."""


@dataclass(frozen=True)
class OptimiserSettings:
    """Adam, for a fixed number of iterations."""

    iterations: int
    learning_rate: float


@runtime_checkable
class Problem(Protocol):
    """An inverse problem. Every evaluation that `loss` makes is counted in `counts`."""

    parameters: list[Tensor]
    counts: Counts
    rays_per_iteration: int
    observed: Bool[Tensor, "height width"]  # pixels of the scene's view whose depth is given

    def loss(self) -> dict[str, Tensor]:
        """The loss as "total", beside its weighted terms."""
        ...

    def field(self) -> Field:
        """The field of the free parameters as they stand, for judging; it is not counted."""
        ...


@runtime_checkable
class Task(Protocol):
    """Builds problems. It names no renderer."""

    optimiser: OptimiserSettings

    def problem(self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device) -> Problem:
        """The inverse problem of a scene.

        Raises:
            Unsupported: where the renderer has no gradient that the task needs.
        """
        ...
