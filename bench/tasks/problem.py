"""What a task is to the runner, and what an inverse problem is to the one loop that solves it."""

from dataclasses import dataclass
from math import cos, pi
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.autodecoder import Prior
from bench.stage import Cell
from datasets.scene import Scene
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Counts, Field
from renderers.rendering import Renderer

SCHEDULES = ("constant", "cosine", "ramped")
RAMP = 0.1  # share of the iterations over which "ramped" rises


class Unsupported(Exception):
    """A renderer lacks what a task needs; the message says what."""


class NotReached(Exception):
    """An optimisation cannot go on, although nothing is wrong with the program; the message says why."""


@dataclass(frozen=True)
class OptimiserSettings:
    """Adam, for a fixed number of iterations.

    Args:
        iterations: how many.
        learning_rate: of Adam, at the start.
        schedule: "constant", or "cosine": the rate falls to zero along half a cosine; "ramped": a cosine that rises
            from zero over the first tenth, for a start that is nearly right.
    """

    iterations: int
    learning_rate: float
    schedule: str

    def __post_init__(self) -> None:
        check_at_least("task.iterations", self.iterations, 1, "the paper uses 100")
        check_positive("task.learning_rate", self.learning_rate, "0.01 to 0.1 suit")
        check_choice("task.schedule", self.schedule, SCHEDULES)

    def rate(self, iteration: int) -> float:
        """The learning rate of an iteration, counted from 0."""
        fall = 1.0 if self.schedule == "constant" else 0.5 * (1 + cos(pi * iteration / self.iterations))
        rise = min((iteration + 1) / (RAMP * self.iterations), 1.0) if self.schedule == "ramped" else 1.0
        return self.learning_rate * fall * rise


@runtime_checkable
class Descent(Protocol):
    """What the one loop descends. Every evaluation that `loss` makes is counted in `counts`."""

    parameters: list[Tensor]
    counts: Counts

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The loss at an iteration, counted from 0, as "total", beside its weighted terms."""
        ...


@runtime_checkable
class Problem(Descent, Protocol):
    """An inverse problem."""

    rays_per_iteration: int
    observed: Bool[Tensor, "height width"]  # pixels of the scene's view whose depth is given
    photographs: Float[np.ndarray, "views height width 3"] | None  # that are given, for pictures

    def objective(self) -> float | None:
        """The loss as it stands, not counted, where that of different iterations is not comparable; else None."""
        ...

    def field(self) -> Field:
        """The field of the free parameters as they stand, for judging; it is not counted."""
        ...


@runtime_checkable
class Task(Protocol):
    """Something that is done with a renderer and a scene. It names no renderer."""

    def execute(self, cell: Cell) -> None:
        """Does it, and fills the cell's record and folder.

        Raises:
            Unsupported: where the renderer cannot do what the task or its field needs.
        """
        ...


@runtime_checkable
class TakesField(Protocol):
    """A task that can do with any field in the place of a prior's, as `field` asks."""

    takes_field: ClassVar[bool]


@runtime_checkable
class InverseTask(Protocol):
    """A task that is an inverse problem; `bench.solve` executes it."""

    optimiser: OptimiserSettings

    def problem(self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device) -> Problem:
        """The inverse problem of a scene.

        Raises:
            Unsupported: where the renderer has no gradient that the task needs.
        """
        ...


def check_kind(renderer: Renderer, field: Field) -> None:
    """Raises Unsupported where a field is not of a kind that the renderer is meant for."""
    needs = renderer.capabilities.needs
    if field.kind not in needs:
        names = " or ".join(need.value for need in needs)
        raise Unsupported(f"{type(renderer).__name__} needs a {names} field, not a {field.kind.value} field")


def check_field_gradient(renderer: Renderer) -> None:
    """Raises Unsupported where a renderer has no gradient towards the field's parameters."""
    if not renderer.capabilities.field_gradient:
        raise Unsupported(f"{type(renderer).__name__} has no gradient towards the field")
