"""Trains a `SingleView` over many shapes: from images (2D), from depths (2.5D), or from the true occupancy (3D)."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from math import isfinite
from pathlib import Path
from pickle import UnpicklingError

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from bench.progress import Report, notice
from bench.reconstruct.losses import Losses
from bench.single_view.images import ImagesOf
from bench.single_view.network import SingleView, SingleViewNetwork
from bench.solve.optimise import SCHEDULES, OptimiserSettings
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Counts, Meter, occupancy_logits
from renderers.fields.coloured import LOGIT_WIDTH, OccupancyOf
from renderers.rendering import Renderer, at_iteration
from renderers.silhouette import DEPTH

LARGEST_GRADIENT = 1.0  # norm to which a step's gradient is shortened


@dataclass(frozen=True)
class Supervision:
    """What a training may know of its shapes.

    Args:
        losses: of renderings: of colours and masks (2D), of depths (2.5D); see `bench.reconstruct.losses.Losses`.
        occupancy: weight of the cross entropy at points of known occupancy (3D; Occupancy Networks, Eq. 3).
        hull: share of the steps, the first, that learn from the visual hull of the masks in place of all else, by the
            same cross entropy and without a rendering: the images' masks alone, and many times quicker.
        points: of a cross entropy, of each shape in a step.
    """

    losses: Losses
    occupancy: float
    hull: float
    points: int

    def __post_init__(self) -> None:
        check_at_least("supervision.occupancy", self.occupancy, 0, "0 switches the term off")
        if not 0 <= self.hull <= 1:
            raise ValueError(f"supervision.hull must be a share of the steps, 0 to 1, not {self.hull:g}")
        if self.hull < 1 and not self.renders and not self.occupancy:
            raise ValueError("supervision has no term after the hull's steps: give a weight, or supervision.hull=1")
        check_at_least("supervision.points", self.points, 1, "1024 work")
        if self.losses.colour_gradient:
            raise ValueError("supervision.losses.colour_gradient must be 0: no patches are drawn, but single pixels")

    @property
    def to_hull(self) -> bool:
        """Whether a loss of the mask asks for a depth (DVR, Eq. 15) and none is given, but that of the visual hull."""
        return getattr(self.losses.silhouette, "occupied_at", None) == DEPTH and not self.losses.depth

    @property
    def renders(self) -> bool:
        """Whether any term is of a rendering."""
        return self.hull < 1 and any((self.losses.colour, self.losses.depth, self.losses.silhouette_weight))


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained.

    Args:
        steps: optimiser steps, each on `shapes_per_step` shapes, of each a random image to encode and one to compare.
        shapes_per_step: their number.
        rays: of the image that is compared.
        learning_rate: of Adam at the start.
        schedule: of the rate, see `OptimiserSettings`.
        keep_every: steps after which the state is kept on disk, for a training that is stopped.
        seed: of weights, batches and rays.
    """

    steps: int
    shapes_per_step: int
    rays: int
    learning_rate: float
    schedule: str
    keep_every: int
    seed: int

    def __post_init__(self) -> None:
        for name in ("steps", "shapes_per_step", "rays", "keep_every"):
            check_at_least(f"task.training.{name}", getattr(self, name), 1, "conf/scale has values that work")
        check_positive("task.training.learning_rate", self.learning_rate, "1e-3 works")
        check_choice("task.training.schedule", self.schedule, SCHEDULES)


@dataclass
class Course:
    """The course of a training: losses of its steps, and what they cost."""

    losses: list[float] = field(default_factory=list)
    seconds: float = 0.0
    counts: Counts = field(default_factory=Counts)


class Failed(ValueError):
    """The loss or its gradient is not finite at a step; `kept` is the number of steps of the last state on disk."""

    def __init__(self, step: int, kept: int, path: Path) -> None:
        state = f"; the state after {kept} steps is in {path}" if kept else ""
        super().__init__(f"the training failed: not a number at step {step}{state}: lower task.training.learning_rate")


@dataclass(frozen=True)
class Lessons:
    """A training: the images of the training shapes, what it may know of them, and how they are compared."""

    images: Sequence[ImagesOf]
    supervision: Supervision
    renderer: Renderer
    settings: TrainingSettings
    device: torch.device

    def train(self, network: SingleViewNetwork, state: Path, progress: Report) -> tuple[SingleView, Course]:
        """Trains a network; a training that was stopped goes on from `state`, and ends with the same weights.

        Args:
            state: file of the state of the training, also of one that has ended, until the caller has stored the
                network.

        Raises:
            Failed: where the loss or its gradient is not finite; `state` stays.
        """
        settings = self.settings
        rates = OptimiserSettings(settings.steps, settings.learning_rate, settings.schedule)
        torch.manual_seed(settings.seed)
        with torch.device("cpu"):  # whatever the default, so that all devices begin with the same weights
            model = SingleView(network).to(self.device)
        optimiser, course = torch.optim.Adam(model.parameters(), lr=settings.learning_rate), Course()
        begun = _restored(state, model, optimiser, course)
        if 0 < begun < settings.steps:
            notice(f"the training goes on after step {begun} of {settings.steps}")
        for step in range(begun, settings.steps):
            started = time.perf_counter()
            for group in optimiser.param_groups:
                group["lr"] = rates.rate(step)
            loss = self.give(model, step, course.counts)
            norm = torch.nn.utils.clip_grad_norm_(model.parameters(), LARGEST_GRADIENT)
            if not isfinite(loss) or not bool(norm.isfinite()):
                raise Failed(step, step - step % settings.keep_every, state)
            optimiser.step()
            course.losses.append(loss)
            course.seconds += time.perf_counter() - started
            progress("training", step + 1, settings.steps, loss)
            if (step + 1) % settings.keep_every == 0 or step + 1 == settings.steps:
                _keep(state, model, optimiser, course)
        return model.eval().requires_grad_(False), course

    def give(self, model: SingleView, step: int, counts: Counts) -> float:
        """The mean loss over a step's shapes, whose gradients are left in the weights; one shape's graph at a time."""
        draw = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + step)
        torch.manual_seed(draw.initial_seed())  # of what the losses draw
        chosen = torch.randperm(len(self.images), generator=draw, device="cpu")[
            : self.settings.shapes_per_step
        ].tolist()
        inputs = torch.randint(len(self.images[0].cameras), (len(chosen),), generator=draw, device="cpu").tolist()
        shown = torch.stack([self.images[shape].image(view) for shape, view in zip(chosen, inputs, strict=True)])
        for parameter in model.parameters():
            parameter.grad = None
        codes = model(shown.to(self.device))
        cut, renderer, total = codes.detach().requires_grad_(), at_iteration(self.renderer, step), 0.0
        for place, number in enumerate(chosen):
            shape = model.at(cut[place])
            if step < self.supervision.hull * self.settings.steps:
                terms = [self._known(shape, *self._hulls[number], draw)]
            else:
                terms = self._terms(renderer, shape, Meter(shape, counts), self.images[number], draw)
            loss = torch.stack(terms).sum() / len(chosen)
            loss.backward()
            total += loss.item()
        codes.backward(cut.grad)
        return total

    def _terms(
        self, renderer: Renderer, shape: OccupancyOf, metered: Meter, images: ImagesOf, draw: torch.Generator
    ) -> list[Tensor]:
        terms, given = [], self.supervision
        if given.renders:
            view = int(torch.randint(len(images.cameras), (1,), generator=draw, device="cpu"))
            pixels = images.pixels(view, self.settings.rays, draw, self.device, hull=given.to_hull)
            terms.append(given.losses(renderer, shape, metered, pixels)["total"])
        if given.occupancy:
            terms.append(given.occupancy * self._known(shape, images.points, images.inside, draw))
        return terms

    @cached_property
    def _hulls(self) -> list[tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]]:
        return [one.in_hull(self.settings.seed) for one in self.images]

    def _known(
        self,
        shape: OccupancyOf,
        points: Float[Tensor, "points 3"],
        inside: Bool[Tensor, " points"],
        draw: torch.Generator,
    ) -> Float[Tensor, ""]:
        """The cross entropy at some points of which it is known whether they lie inside."""
        some = torch.randint(len(points), (self.supervision.points,), generator=draw, device="cpu")
        logits = occupancy_logits(shape, shape(points[some].to(self.device)), width=LOGIT_WIDTH)
        return binary_cross_entropy_with_logits(logits, inside[some].to(logits))


def _keep(path: Path, model: SingleView, optimiser: torch.optim.Adam, course: Course) -> None:
    scratch = path.with_suffix(".partial")
    torch.save({"weights": model.state_dict(), "adam": optimiser.state_dict(), "course": asdict(course)}, scratch)
    scratch.replace(path)


def _restored(path: Path, model: SingleView, optimiser: torch.optim.Adam, course: Course) -> int:
    """Fills model, optimiser and course from a kept state, if there is a whole one; gives the number of its steps."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, UnpicklingError):  # none, or one that was cut short
        return 0
    model.load_state_dict(state["weights"])
    optimiser.load_state_dict(state["adam"])
    course.losses, course.seconds = state["course"]["losses"], state["course"]["seconds"]
    course.counts = Counts(**state["course"]["counts"])
    return len(course.losses)
