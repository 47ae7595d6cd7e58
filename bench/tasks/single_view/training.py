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
from bench.solve.optimise import SCHEDULES, OptimiserSettings
from bench.tasks.reconstruction.losses import Losses
from bench.tasks.single_view.images import ShapeImages
from bench.tasks.single_view.network import SingleView, SingleViewNetwork
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Counts, Meter, occupancy_logits
from renderers.fields.networks.coloured import LOGIT_WIDTH, OccupancyOf
from renderers.rendering import Renderer, at_iteration
from renderers.silhouette import DEPTH

MAX_GRADIENT_NORM = 1.0


@dataclass(frozen=True)
class Supervision:
    """The observations of the training shapes that the losses use.

    Args:
        losses: of renderings: of colours and masks (2D), of depths (2.5D); see the class `Losses`.
        occupancy: weight of the cross entropy at points of known occupancy (3D; Occupancy Networks, Eq. 3).
        hull: fraction of the steps, at the start, that use only this cross entropy in the visual hull of the masks. A
            step without a rendering is many times faster.
        points: number of points per shape in a step, for the cross entropy.
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
    def needs_hull_depth(self) -> bool:
        """Whether the silhouette loss needs a depth (DVR, Eq. 15) and only the visual hull provides one."""
        return getattr(self.losses.silhouette, "occupied_at", None) == DEPTH and not self.losses.depth

    @property
    def renders(self) -> bool:
        """Whether any loss term needs a rendering."""
        return self.hull < 1 and any((self.losses.colour, self.losses.depth, self.losses.silhouette_weight))


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training of a network.

    Args:
        steps: optimiser steps; each takes a random image to encode and a random image to compare per shape.
        shapes_per_step: number of shapes in a step.
        rays: of the image that is compared.
        learning_rate: of Adam at the start.
        schedule: of the rate, see `OptimiserSettings`.
        keep_every: steps between two saved states, from which a stopped training continues.
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
class TrainingHistory:
    losses: list[float] = field(default_factory=list)
    seconds: float = 0.0
    counts: Counts = field(default_factory=Counts)


class TrainingFailed(ValueError):
    """The loss or its gradient is not finite at a step; `saved_steps` is the number of steps of the saved state."""

    def __init__(self, step: int, saved_steps: int, path: Path) -> None:
        state = f"; the state after {saved_steps} steps is in {path}" if saved_steps else ""
        super().__init__(f"the training failed: not a number at step {step}{state}: lower task.training.learning_rate")


@dataclass(frozen=True)
class Training:
    """A training: the images of the training shapes, the losses, and the renderer that compares them."""

    images: Sequence[ShapeImages]
    supervision: Supervision
    renderer: Renderer
    settings: TrainingSettings
    device: torch.device

    def train(self, network: SingleViewNetwork, state: Path, progress: Report) -> tuple[SingleView, TrainingHistory]:
        """Trains a network; a stopped training continues from `state`, and ends with the same weights.

        Args:
            state: file of the state of the training. It stays after the last step, until the caller has stored the
                network.

        Raises:
            TrainingFailed: the loss or its gradient is not finite; `state` stays.
        """
        settings = self.settings
        rates = OptimiserSettings(settings.steps, settings.learning_rate, settings.schedule)
        torch.manual_seed(settings.seed)
        with torch.device("cpu"):  # so that all devices start with the same weights
            model = SingleView(network).to(self.device)
        optimiser, history = torch.optim.Adam(model.parameters(), lr=settings.learning_rate), TrainingHistory()
        first_step = _restore(state, model, optimiser, history)
        if 0 < first_step < settings.steps:
            notice(f"the training goes on after step {first_step} of {settings.steps}")
        for step in range(first_step, settings.steps):
            started = time.perf_counter()
            for group in optimiser.param_groups:
                group["lr"] = rates.rate(step)
            loss = self.accumulate_gradients(model, step, history.counts)
            norm = torch.nn.utils.clip_grad_norm_(model.parameters(), MAX_GRADIENT_NORM)
            if not isfinite(loss) or not bool(norm.isfinite()):
                raise TrainingFailed(step, step - step % settings.keep_every, state)
            optimiser.step()
            history.losses.append(loss)
            history.seconds += time.perf_counter() - started
            progress("training", step + 1, settings.steps, loss)
            if (step + 1) % settings.keep_every == 0 or step + 1 == settings.steps:
                _save_state(state, model, optimiser, history)
        return model.eval().requires_grad_(False), history

    def accumulate_gradients(self, model: SingleView, step: int, counts: Counts) -> float:
        """The mean loss over a step's shapes; its gradients are left in the weights. There is one graph at a time."""
        draw = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + step)
        torch.manual_seed(draw.initial_seed())  # for random draws of the losses
        order = torch.randperm(len(self.images), generator=draw, device="cpu")
        chosen = order[: self.settings.shapes_per_step].tolist()
        inputs = torch.randint(len(self.images[0].cameras), (len(chosen),), generator=draw, device="cpu").tolist()
        shown = torch.stack([self.images[shape].image(view) for shape, view in zip(chosen, inputs, strict=True)])
        for parameter in model.parameters():
            parameter.grad = None
        codes = model(shown.to(self.device))
        code_leaves, renderer, total = codes.detach().requires_grad_(), at_iteration(self.renderer, step), 0.0
        for row, shape_index in enumerate(chosen):
            shape = model.at(code_leaves[row])
            if step < self.supervision.hull * self.settings.steps:
                terms = [self._occupancy_loss(shape, *self._hulls[shape_index], draw)]
            else:
                terms = self._loss_terms(renderer, shape, Meter(shape, counts), self.images[shape_index], draw)
            loss = torch.stack(terms).sum() / len(chosen)
            loss.backward()
            total += loss.item()
        codes.backward(code_leaves.grad)
        return total

    def _loss_terms(
        self, renderer: Renderer, shape: OccupancyOf, metered: Meter, images: ShapeImages, draw: torch.Generator
    ) -> list[Tensor]:
        terms, supervision = [], self.supervision
        if supervision.renders:
            view = int(torch.randint(len(images.cameras), (1,), generator=draw, device="cpu"))
            pixels = images.pixels(view, self.settings.rays, draw, self.device, hull=supervision.needs_hull_depth)
            terms.append(supervision.losses(renderer, shape, metered, pixels)["total"])
        if supervision.occupancy:
            terms.append(supervision.occupancy * self._occupancy_loss(shape, images.points, images.inside, draw))
        return terms

    @cached_property
    def _hulls(self) -> list[tuple[Float[Tensor, "points 3"], Bool[Tensor, " points"]]]:
        return [images.hull_samples(self.settings.seed) for images in self.images]

    def _occupancy_loss(
        self,
        shape: OccupancyOf,
        points: Float[Tensor, "points 3"],
        inside: Bool[Tensor, " points"],
        draw: torch.Generator,
    ) -> Float[Tensor, ""]:
        """The cross entropy at a random choice of points with known occupancy."""
        chosen = torch.randint(len(points), (self.supervision.points,), generator=draw, device="cpu")
        logits = occupancy_logits(shape, shape(points[chosen].to(self.device)), width=LOGIT_WIDTH)
        return binary_cross_entropy_with_logits(logits, inside[chosen].to(logits))


def _save_state(path: Path, model: SingleView, optimiser: torch.optim.Adam, history: TrainingHistory) -> None:
    scratch = path.with_suffix(".partial")
    torch.save({"weights": model.state_dict(), "adam": optimiser.state_dict(), "course": asdict(history)}, scratch)
    scratch.replace(path)


def _restore(path: Path, model: SingleView, optimiser: torch.optim.Adam, history: TrainingHistory) -> int:
    """Loads model, optimiser and history from a saved state; returns the number of its steps, 0 without a state."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, UnpicklingError):  # missing or truncated
        return 0
    model.load_state_dict(state["weights"])
    optimiser.load_state_dict(state["adam"])
    history.losses, history.seconds = state["course"]["losses"], state["course"]["seconds"]
    history.counts = Counts(**state["course"]["counts"])
    return len(history.losses)
