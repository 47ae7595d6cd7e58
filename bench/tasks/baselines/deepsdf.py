"""Shape completion without a renderer, from samples along the normals of the depth image (DeepSDF, Sec. 6.3)."""

from dataclasses import dataclass

import torch

from bench.setup.inputs import RunContext
from bench.shape_prior import Prior
from bench.solve.latent_code import CodePenalty, CodeProblem, Terms
from bench.solve.optimise import OptimiserSettings
from bench.solve.solve import solve_task
from datasets.scene import Scene
from datasets.views import observed_pixels, parse_amount
from renderers.camera import sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.rendering import Renderer

FREE_SPACE_SAMPLES = 8  # per ray, evenly spaced from the unit sphere to the offset in front of the surface


@dataclass(frozen=True)
class DeepSDF:
    """Shape from one sparse depth image whose true normals are given: the baseline of DIST, Table 2.

    Each observed point p with normal n gives the samples p + offset n and p - offset n, whose distances are +offset and
    -offset. `free_space` switches on DeepSDF's samples of free space, on the rays in front of the surface: there the
    field must not be negative. The renderer is not used in the optimisation, only for pictures and the evaluation.

    Args:
        points: amount of given depth; see `datasets.views.observed_pixels`.
        offset: distance of the samples from the surface, in scene units.
        distance_weight: weight of the mean absolute error of the distances.
        code: penalty on the code.
        optimiser: iterations and learning rates.
        free_space: weight of the mean magnitude of negative values at `FREE_SPACE_SAMPLES` samples of each ray.
    """

    points: str
    offset: float
    distance_weight: float
    code: CodePenalty
    optimiser: OptimiserSettings
    free_space: float = 0.0

    def __post_init__(self) -> None:
        parse_amount(self.points)
        check_positive("task.offset", self.offset, "0.02 works")
        check_positive("task.distance_weight", self.distance_weight, "1 works")
        check_at_least("task.free_space", self.free_space, 0, "0 switches the samples of free space off")

    def execute(self, run: RunContext) -> None:
        run.record.notes.append("task=deepsdf fits without a renderer: it was used for pictures and evaluation only")
        solve_task(self, run)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene; it starts from code zero, the mean shape."""
        view = scene.view
        observed = observed_pixels(view.mask, self.points, seed)
        rays = view.camera.rays()[observed]
        distance = view.depth[observed] / view.camera.depth(torch.ones(view.depth.shape))[observed]
        shift = self.offset * view.normals[observed]
        surface = rays.at(distance)
        points = torch.cat([surface + shift, surface - shift]).to(device)
        distances = self.offset * torch.tensor([1.0, -1.0]).repeat_interleave(len(distance)).to(device)
        entry = sphere_span(rays)[0][:, None]
        free_length = (distance[:, None] - self.offset - entry).clamp_min(0)
        steps = torch.arange(FREE_SPACE_SAMPLES) + 0.5
        free = rays.at_each(entry + free_length * steps / FREE_SPACE_SAMPLES).to(device)

        def compare(field: Field, iteration: int) -> Terms:
            """The weighted mean absolute error (DeepSDF, Eq. 10, without its clamp), and the term of free space."""
            terms = {"distance": self.distance_weight * (field(points) - distances).abs().mean()}
            if self.free_space:
                terms["free_space"] = self.free_space * torch.relu(-field(free)).mean()
            return terms

        points_per_iteration = len(points) + (free.numel() // 3 if self.free_space else 0)
        return CodeProblem(prior, self.code, compare, observed, points_per_iteration, device, mask=False)
