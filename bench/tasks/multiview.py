"""Shape from many views: find the code whose depths carry each view's colours onto the next (DIST, Sec. 4.2.2)."""

from dataclasses import dataclass
from math import radians
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.autodecoder import Prior
from bench.ladder.observations import Observations
from bench.ladder.solve import solve_shape
from bench.pictures import Given
from bench.stage import Cell
from bench.starts import StartSettings
from bench.tasks.code import CodePenalty, CodeProblem, code_problem
from bench.tasks.photographs import GivenPhotographs, PhotographObservations
from bench.tasks.problem import OptimiserSettings, check_field_gradient
from datasets.photographs import Photography
from datasets.scene import Scene
from datasets.truth import Truth
from renderers.checks import check_at_least, check_positive
from renderers.rendering import Renderer

LEAST_SCALE, MOST_SHIFT = 0.8, 0.2
FAR_APART = 60.0  # degrees between two photographs that a note is made of


@dataclass(frozen=True)
class Multiview:
    """Shape from photographs whose cameras are known; no mask is used.

    Args:
        images: how the photographs are taken.
        focal: of the photographs' cameras, times that of the scene's camera (DIST, Fig. 10 a).
        views_per_step: views that an iteration compares, evenly spaced; they move on from one iteration to the next.
        neighbour: how many views further on the one is that a view is compared with.
        visible: squared difference of depths below which both views see a point, in squared scene units (DIST, B.3).
        photometric_weight: of the mean absolute difference of colours (Eq. 6).
        code_weight, code_average: see `bench.tasks.code.CodePenalty`.
        start_scale: of the random code at the start, in standard deviations of the prior's training codes; 0 is the
            mean shape.
        starts, trial: see `bench.starts.StartSettings`.
        coarse_blur: standard deviation of the Gaussian that the images begin with, as a share of their height; it falls
            to 0 over the first half of a start's iterations.
        scale, degrees, shift: by how much the shape is too large, turned and shifted at the start; where one is not
            neutral the similarity is optimised, too (DIST, Fig. 12). Degrees, scene units.
        iterations, learning_rate, schedule: see `bench.tasks.problem.OptimiserSettings`.
    """

    images: Photography
    focal: float
    views_per_step: int
    neighbour: int
    visible: float
    photometric_weight: float
    code_weight: float
    code_average: str
    start_scale: float
    starts: int
    trial: int
    coarse_blur: float
    scale: float
    degrees: float
    shift: float
    iterations: int
    learning_rate: float
    schedule: str

    takes_field: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_at_least("task.views_per_step", self.views_per_step, 1, "the paper uses 8")
        check_at_least("task.neighbour", self.neighbour, 1, "1 is the closest next view")
        if self.neighbour % self.images.views == 0:
            both = f"task.neighbour={self.neighbour} compares each of {self.images.views} views with itself"
            raise ValueError(f"{both}: set task.neighbour=1")
        check_positive("task.visible", self.visible, "the paper uses 0.001")
        check_positive("task.focal", self.focal, "1 is the scene's; from 1.07 on shapes may leave the image")
        check_positive("task.scale", self.scale, "1 is the true size")
        check_positive("task.photometric_weight", self.photometric_weight, "the paper uses 5")
        for name in ("start_scale", "coarse_blur", "degrees", "shift"):
            check_at_least(f"task.{name}", getattr(self, name), 0, f"task.{name}=0 is the least")
        if not (LEAST_SCALE <= self.scale <= 1 / LEAST_SCALE and self.shift <= MOST_SHIFT):
            raise ValueError(
                f"task.scale must lie between {LEAST_SCALE} and {1 / LEAST_SCALE}, and task.shift be {MOST_SHIFT} at "
                f"most, not {self.scale} and {self.shift}: further off, a shape leaves the space priors are trained in"
            )
        self.turns.check(self.iterations)
        _ = self.optimiser, self.penalty

    @property
    def turns(self) -> StartSettings:
        """How the random codes share the iterations."""
        return StartSettings(self.starts, self.trial)

    @property
    def optimiser(self) -> OptimiserSettings:
        """For how long and how fast."""
        return OptimiserSettings(self.iterations, self.learning_rate, self.schedule)

    @property
    def penalty(self) -> CodePenalty:
        """What the code costs."""
        return CodePenalty(self.code_weight, self.code_average)

    def execute(self, cell: Cell) -> None:
        """Optimises the code, and judges the shape before and after."""
        apart = 360 / self.images.views * min(self.neighbour, self.images.views - self.neighbour)
        if apart > FAR_APART:
            told = f"compared photographs are {apart:.0f} degrees apart and share little: task.images.views=24 has 15"
            cell.record.notes = [*cell.record.notes, told]
        solve_shape(self, cell)

    def observations(
        self, scene: Scene, renderer: Renderer, *, seed: int, device: torch.device
    ) -> tuple[Observations, Given]:
        """What a field without a prior is fitted to; some photographs are held out.

        Raises:
            ValueError: for settings of a prior's code, and for too few photographs.
        """
        if self.scale != 1 or self.degrees or self.shift or self.starts > 1:
            raise ValueError("task.scale, degrees, shift and starts are those of a prior's shape: set field=prior")
        own = scene.seed(seed)
        photographs = self.images.take(Truth(scene.mesh), scene.view.camera.zoomed(self.focal), seed=own)
        given = GivenPhotographs(self, renderer, photographs, device)
        nothing = np.zeros(scene.view.mask.shape, dtype=bool)
        return PhotographObservations.of(given), Given(scene.view, nothing, given.colours.cpu().numpy())

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene's mesh."""
        check_field_gradient(renderer)
        own = scene.seed(seed)  # another texture and other codes for each shape
        generator = torch.Generator().manual_seed(own)
        photographs = self.images.take(Truth(scene.mesh), scene.view.camera.zoomed(self.focal), seed=own)
        given = GivenPhotographs(self, renderer, photographs, device)
        if len(prior.codes) < 2:
            raise ValueError("a prior of one shape has no spread to draw a code from: set scale.shapes=96")
        spread = self.start_scale * prior.codes.std(0)
        codes = spread * torch.randn(self.starts, prior.decoder.code_length, generator=generator)
        problem = code_problem(
            prior,
            self.penalty,
            given.compare,
            observed=torch.zeros_like(scene.view.mask),
            rays=2 * given.per_step * scene.view.mask.numel(),
            device=device,
            codes=codes,
            similarities=self._misplaced(generator) if self.scale != 1 or self.degrees or self.shift else None,
            trial=self.trial,
        )
        problem.photographs = given.colours.cpu().numpy()
        problem.judged_at = self.iterations  # the images are not blurred any more
        return problem

    def _misplaced(self, generator: torch.Generator) -> Float[Tensor, "starts 7"]:
        """A similarity of the given size in random directions, the same for all starts: it is what is known."""
        axis, direction = torch.nn.functional.normalize(torch.randn(2, 3, generator=generator), dim=1)
        similarity = torch.cat([self.shift * direction, radians(self.degrees) * axis, torch.tensor([self.scale]).log()])
        return similarity.expand(self.starts, -1)
