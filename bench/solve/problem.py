"""The contracts of an inverse problem and of the optimisation loop's objective, and the optimiser's settings."""

from dataclasses import dataclass
from math import cos, pi
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool
from torch import Tensor

from bench.evaluate.evaluate import Evaluation
from bench.pictures.filmstrip import Shown
from bench.setup.inputs import RunInputs
from bench.shape_prior.autodecoder import Prior
from datasets.scene import Scene
from renderers.camera import Camera
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Counts, Field
from renderers.rendering import Renderer

SCHEDULES = ("constant", "cosine", "ramped")
RAMP = 0.1  # share of the iterations over which the rate of "ramped" rises


class Unsupported(Exception):
    """A renderer lacks what a task needs; the message says what."""


class NotReached(Exception):
    """An optimisation cannot continue, without an error of the program; the message says why."""


@dataclass(frozen=True)
class OptimiserSettings:
    """Adam, for a fixed number of iterations.

    Args:
        iterations: their number.
        learning_rate: of Adam, at the start.
        schedule: "constant", or "cosine": the rate falls to zero along half a cosine; "ramped": a cosine that rises
            from zero over the first tenth, for a start that is nearly right.
    """

    iterations: int
    learning_rate: float
    schedule: str

    def __post_init__(self) -> None:
        check_at_least("task.optimiser.iterations", self.iterations, 1, "the paper uses 100")
        check_positive("task.optimiser.learning_rate", self.learning_rate, "0.01 to 0.1 suit")
        check_choice("task.optimiser.schedule", self.schedule, SCHEDULES)

    def rate(self, iteration: int) -> float:
        """The learning rate of an iteration, counted from 0."""
        fall = 1.0 if self.schedule == "constant" else 0.5 * (1 + cos(pi * iteration / self.iterations))
        rise = min((iteration + 1) / (RAMP * self.iterations), 1.0) if self.schedule == "ramped" else 1.0
        return self.learning_rate * fall * rise


@runtime_checkable
class Objective(Protocol):
    """What the optimisation loop minimises. Every evaluation that `loss` makes is counted in `counts`."""

    parameters: list[Tensor]
    counts: Counts

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The loss of an iteration, counted from 0, as "total", and its weighted terms."""
        ...


@runtime_checkable
class Problem(Objective, Protocol):
    """An inverse problem: its unknown, how a state of it is evaluated, and how it is drawn."""

    tracked: tuple[str, ...]  # metrics that each checkpoint writes into the curve
    rays_per_iteration: int
    observed: Bool[Tensor, "height width"]  # pixels of the scene's view whose depth is given

    @property
    def shown(self) -> Shown | None:
        """What the filmstrip's frames are compared with; None for the scene's shape in its view."""
        ...

    def objective(self) -> float | None:
        """The current loss, not counted, where losses of different iterations are not comparable; else None."""
        ...

    def field(self) -> Field:
        """The field of the current parameters; its evaluations are not counted."""
        ...

    def frame(self) -> tuple[Field, Camera | None]:
        """The filmstrip's frame of the current state: a field, and the camera where it is not the scene's."""
        ...

    def evaluate(self, inputs: RunInputs) -> Evaluation:
        """The current state against the truth."""
        ...

    def checkpoint(self, inputs: RunInputs) -> dict[str, float]:
        """The `tracked` metrics of the current state alone."""
        ...

    def draw(self, inputs: RunInputs, folder: Path, first: Field, curve: list[dict[str, Any]], title: str) -> None:
        """Writes the pictures of the run into its folder.

        Args:
            inputs: of the run.
            folder: the run folder.
            first: the field before the optimisation.
            curve: lines of curve.jsonl.
            title: of the summary.
        """
        ...


@runtime_checkable
class InverseTask(Protocol):
    """A task that is an inverse problem of a prior's code; `bench.solve.solve.solve_task` executes it."""

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
