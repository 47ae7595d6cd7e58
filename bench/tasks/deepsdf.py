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
from renderers.camera import sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.rendering import Renderer


@dataclass(frozen=True)
class DeepSDF:
    """Shape from one sparse depth image whose true normals are given: the baseline of DIST, Table 2.

    Each observed point p with normal n gives the samples p + offset n and p - offset n, whose distances are +offset and
    -offset, and `free` points between the camera and p, whose distance may not be negative. The renderer has no part
    in it: it only draws the pictures, and the images that are judged.

    Args:
        points: how much of the depth is given; see `datasets.observe.observed_pixels`.
        offset: in scene units.
        free: points drawn on the part of each ray before its surface, within the unit sphere.
        distance_weight: of the mean absolute error of the distances.
        free_weight: of the mean of what is below zero in free space.
        code_weight, code_average: see `bench.tasks.code.CodePenalty`.
        iterations, learning_rate, schedule: see `bench.tasks.problem.OptimiserSettings`.
    """

    points: str
    offset: float
    free: int
    distance_weight: float
    free_weight: float
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
        for name in ("free", "distance_weight", "free_weight"):
            check_at_least(f"task.{name}", getattr(self, name), 0, "0 switches the term off")

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
        shares = torch.rand((self.free, len(distance)), generator=torch.Generator().manual_seed(seed))
        entry = sphere_span(rays, 1.0)[0]
        ahead = entry + shares * (distance - self.offset - entry).clamp_min(0)
        samples = Samples(
            settings=self,
            points=torch.cat([surface + shift, surface - shift]).to(device),
            distances=self.offset * torch.tensor([1.0, -1.0]).repeat_interleave(len(distance)).to(device),
            free=torch.cat([rays.at(row) for row in ahead] or [surface[:0]]).to(device),
        )
        penalty = CodePenalty(self.code_weight, self.code_average)
        rows = len(samples.points) + len(samples.free)
        return code_problem(prior, penalty, samples.compare, observed=observed, rays=rows, device=device)


@dataclass(frozen=True)
class Samples:
    """Points of known distance, and points known to be free; `compare` asks a field at all of them."""

    settings: DeepSDF
    points: Float[Tensor, "n 3"]
    distances: Float[Tensor, " n"]
    free: Float[Tensor, "m 3"]

    def compare(self, field: Field, iteration: int) -> Terms:
        """The weighted errors (DeepSDF, Eq. 10, without its clamp, beyond which no sample lies)."""
        values = field(torch.cat([self.points, self.free]))
        near, free = values[: len(self.points)], values[len(self.points) :]
        return {
            "distance": self.settings.distance_weight * (near - self.distances).abs().mean(),
            "free": self.settings.free_weight * (-free).clamp_min(0).sum() / max(len(free), 1),
        }
