"""Shape completion: find the code whose shape agrees with a sparse depth image and a mask (DIST, Sec. 4.2.1)."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool
from torch import Tensor

from bench.auto import footprint
from bench.autodecoder import Prior
from bench.ladder.observations import Holdout, Observations, hold_out, together
from bench.ladder.solve import solve_shape
from bench.pictures import Given
from bench.stage import Cell
from bench.tasks.code import CodePenalty, CodeProblem, code_problem
from bench.tasks.given import GivenView
from bench.tasks.problem import OptimiserSettings, check_field_gradient
from datasets.observe import observed_pixels, parse_amount
from datasets.scene import Scene, View
from renderers.checks import check_at_least
from renderers.rendering import Renderer

HELD_OUT, TILES = 0.2, 4  # share of what is given that judges a field; tiles of the view along each side


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

    takes_field: ClassVar[bool] = True

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
        """Optimises the code, or the field that is asked for, and judges the shape before and after."""
        solve_shape(self, cell)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene, from the mean shape, code zero."""
        check_field_gradient(renderer)
        given, observed = self._given(scene.view, renderer, seed=seed, device=device)
        penalty = CodePenalty(self.code_weight, self.code_average)
        rays = observed.numel()
        return code_problem(prior, penalty, given.compare, observed=observed, rays=rays, device=device)

    def observations(
        self, scene: Scene, renderer: Renderer, *, seed: int, device: torch.device
    ) -> tuple[Observations, Given]:
        """What a field without a prior is fitted to; a fifth of it is held out, in the tiles of the view."""
        view, observed = self._given(scene.view, renderer, seed=seed, device=device)
        camera, (rows, columns) = scene.view.camera, observed.shape
        tile = (torch.arange(rows) * TILES // rows)[:, None] * TILES + torch.arange(columns) * TILES // columns
        half_pixel = footprint(float(camera.intrinsics[0, 0]), float(torch.linalg.vector_norm(camera.center)))
        split = Holdout(HELD_OUT, (), half_pixel, seed)
        held = hold_out(together([view]), tile.flatten(), split, rays=observed.numel())
        return held, Given(scene.view, observed.numpy(), mask=view.mask is not None)

    def _given(
        self, view: View, renderer: Renderer, *, seed: int, device: torch.device
    ) -> tuple[GivenView, Bool[Tensor, "height width"]]:
        """What is given of a view, and the pixels whose depth is."""
        observed = observed_pixels(view, self.points, seed)
        mask = view.mask if self.mask or self.points == "dense" else None
        return GivenView.of(view, self, renderer, observed=observed, mask=mask, device=device), observed
