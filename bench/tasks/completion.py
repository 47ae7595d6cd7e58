"""Shape completion: find the code whose shape agrees with a sparse depth image and a mask (DIST, Sec. 4.2.1)."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.autodecoder import Prior
from bench.solve import solve
from bench.stage import Cell
from bench.tasks.code import CodePenalty, CodeProblem, Terms, code_problem
from bench.tasks.problem import OptimiserSettings, check_field_gradient
from datasets.observe import observed_pixels, parse_amount
from datasets.scene import Scene, View
from renderers.camera import Rays
from renderers.checks import check_at_least
from renderers.field import Field
from renderers.rendering import Renderer, at_iteration


@dataclass(frozen=True)
class Completion:
    """Shape from one sparse depth image, with or without its mask.

    Args:
        points: how much of the depth is given; see `datasets.observe.observed_pixels`. Dense depth implies the mask.
        mask: whether the silhouette is given.
        depth_weight: of the mean absolute depth error over pixels that are observed and hit (DIST, B.3).
        silhouette_weight: of the renderer's own silhouette loss.
        code_weight, code_average: see `bench.tasks.code.CodePenalty`.
        samples: K; read by renderers that have it, through their configuration.
        iterations, learning_rate, schedule: see `bench.tasks.problem.OptimiserSettings`.
    """

    points: str
    mask: bool
    depth_weight: float
    silhouette_weight: float
    code_weight: float
    code_average: str
    samples: int
    iterations: int
    learning_rate: float
    schedule: str

    def __post_init__(self) -> None:
        parse_amount(self.points)
        CodePenalty(self.code_weight, self.code_average)
        OptimiserSettings(self.iterations, self.learning_rate, self.schedule)
        for name in ("depth_weight", "silhouette_weight"):
            check_at_least(f"task.{name}", getattr(self, name), 0, "0 switches the term off")

    @property
    def optimiser(self) -> OptimiserSettings:
        """For how long and how fast."""
        return OptimiserSettings(self.iterations, self.learning_rate, self.schedule)

    def execute(self, cell: Cell) -> None:
        """Optimises the code, and judges the shape before and after."""
        solve(self, cell)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene, from the mean shape, code zero."""
        check_field_gradient(renderer)
        view = scene.view
        observed = observed_pixels(view, self.points, seed)
        mask = view.mask if self.mask or self.points == "dense" else None
        given = GivenView.of(view, self, renderer, observed=observed, mask=mask, device=device)
        penalty = CodePenalty(self.code_weight, self.code_average)
        return code_problem(prior, penalty, given.compare, observed=observed, rays=view.mask.numel(), device=device)


@runtime_checkable
class Weights(Protocol):
    """What weighs the terms of a view's loss."""

    @property
    def depth_weight(self) -> float: ...

    @property
    def silhouette_weight(self) -> float: ...


@dataclass(frozen=True)
class GivenView:
    """What is given of a view, or of rays of any leading shape; `compare` renders a field and compares."""

    settings: Weights
    renderer: Renderer
    rays: Rays
    depth: Float[Tensor, "*rays"]
    depth_of_distance: Float[Tensor, "*rays"]  # depth of a point at distance 1, the cosine of Eq. 2
    observed: Bool[Tensor, "*rays"]
    mask: Bool[Tensor, "*rays"] | None

    @staticmethod
    def of(
        view: View,
        settings: Weights,
        renderer: Renderer,
        *,
        observed: Bool[Tensor, "height width"],
        mask: Bool[Tensor, "height width"] | None,
        device: torch.device,
    ) -> "GivenView":
        """What `observed` and `mask` give of a view, on a device."""
        return GivenView(
            settings=settings,
            renderer=renderer,
            rays=view.camera.rays().to(device),
            depth=view.depth.to(device),
            depth_of_distance=view.camera.depth(torch.ones(view.depth.shape)).to(device),
            observed=observed.to(device),
            mask=None if mask is None else mask.to(device),
        )

    def some(self, rays: Int[Tensor, " n"]) -> "GivenView":
        """What is given of some rays of a row."""
        parts = {name: getattr(self, name)[rays] for name in ("rays", "depth", "depth_of_distance", "observed")}
        return replace(self, **parts, mask=None if self.mask is None else self.mask[rays])

    def compare(self, field: Field, iteration: int) -> Terms:
        """The weighted terms of DIST, Eq. 5, with the weights of B.4."""
        renderer = at_iteration(self.renderer, iteration)
        rendering = renderer.render(field, self.rays)
        compared = self.observed & rendering.hit
        error = (rendering.distance * self.depth_of_distance - self.depth).abs()
        terms = {"depth": self.settings.depth_weight * (error * compared).sum() / compared.sum().clamp_min(1)}
        if self.mask is not None:
            silhouette = renderer.silhouette_loss(field, self.rays, rendering, self.mask)
            terms["silhouette"] = self.settings.silhouette_weight * silhouette
        return terms
