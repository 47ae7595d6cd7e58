"""Completion without a renderer: distances sampled off the depth image along its normals (DeepSDF, Sec. 6.3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bench.autodecoder import Prior
from bench.solve import solve
from bench.stage import Cell
from bench.tasks.code import CodePenalty, CodeProblem, Terms, code_problem
from bench.tasks.problem import OptimiserSettings
from datasets.observe import observed_pixels, parse_amount
from datasets.scene import Scene
from renderers.checks import check_positive
from renderers.field import Field
from renderers.rendering import Renderer


@dataclass(frozen=True)
class DeepSDF:
    """Shape from one sparse depth image whose true normals are given: the baseline of DIST, Table 2.

    Each observed point p with normal n gives the samples p + offset n and p - offset n, whose distances are +offset and
    -offset. DeepSDF's samples of free space are left out: they did no better on validation shapes. The renderer has no
    part in it: it only draws the pictures, and the images that are judged.

    Args:
        points: how much of the depth is given; see `datasets.observe.observed_pixels`.
        offset: in scene units.
        distance_weight: of the mean absolute error of the distances.
        code_weight, code_average: see `bench.tasks.code.CodePenalty`.
        iterations, learning_rate, schedule: see `bench.tasks.problem.OptimiserSettings`.
    """

    points: str
    offset: float
    distance_weight: float
    code_weight: float
    code_average: str
    iterations: int
    learning_rate: float
    schedule: str

    def __post_init__(self) -> None:
        parse_amount(self.points)
        CodePenalty(self.code_weight, self.code_average)
        OptimiserSettings(self.iterations, self.learning_rate, self.schedule)
        check_positive("task.offset", self.offset, "0.02 works")
        check_positive("task.distance_weight", self.distance_weight, "1 works")

    @property
    def optimiser(self) -> OptimiserSettings:
        """For how long and how fast."""
        return OptimiserSettings(self.iterations, self.learning_rate, self.schedule)

    def execute(self, cell: Cell) -> None:
        """Optimises the code, and judges the shape before and after."""
        cell.record.notes.append("task=deepsdf renders nothing: the renderer drew the pictures and judged images only")
        solve(self, cell)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene, from the mean shape, code zero."""
        view = scene.view
        observed = observed_pixels(view, self.points, seed)
        rays = view.camera.rays()[observed]
        distance = view.depth[observed] / view.camera.depth(torch.ones(view.depth.shape))[observed]
        shift = self.offset * view.normals[observed]
        surface = rays.at(distance)
        samples = Samples(
            settings=self,
            points=torch.cat([surface + shift, surface - shift]).to(device),
            distances=self.offset * torch.tensor([1.0, -1.0]).repeat_interleave(len(distance)).to(device),
        )
        penalty = CodePenalty(self.code_weight, self.code_average)
        rows = len(samples.points)
        return code_problem(prior, penalty, samples.compare, observed=observed, rays=rows, device=device)


@dataclass(frozen=True)
class Samples:
    """Points of known distance; `compare` asks a field at all of them."""

    settings: DeepSDF
    points: Float[Tensor, "n 3"]
    distances: Float[Tensor, " n"]

    def compare(self, field: Field, iteration: int) -> Terms:
        """The weighted error (DeepSDF, Eq. 10, without its clamp)."""
        return {"distance": self.settings.distance_weight * (field(self.points) - self.distances).abs().mean()}
