"""How well a prior can show a shape: a code fitted to the true distances, the best that a method can hope for."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bench.autodecoder import Prior, near_surface_first, sample_distances
from bench.images import save_images
from bench.judge import look, true_surface
from bench.metrics import surface_metrics
from bench.solve import solve
from bench.stage import Cell
from bench.tasks.code import CodePenalty, CodeProblem, Terms, code_problem
from bench.tasks.problem import OptimiserSettings
from datasets.scene import Scene, see
from datasets.truth import Truth
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, autograd_gradients
from renderers.rendering import Renderer

NEAR = 0.02  # scene units: the field is judged as a distance within this of the true surface
DEFINITIONS = {
    "floor_chamfer_l2": "chamfer_l2 between two independent samplings of the truth, which no prediction can beat;"
    " in squared scene units.",
    "distance_error": f"Mean error of the field within {NEAR} of the true surface, in scene units.",
    "slope_median": f"Median length of the field's gradient within {NEAR} of the true surface; 1 for a distance.",
    "slope_p99": "The length of the gradient that 99 % of these points stay below.",
}


@dataclass(frozen=True)
class PriorFit:
    """A code fitted to signed distances of the whole true mesh, which no observation gives: the oracle.

    The renderer has no part in it: it only draws the pictures, and the images that are judged.

    Args:
        distances: signed distances of the shape.
        batch: how many of them an iteration draws.
        surface_width: see `bench.autodecoder.PriorSettings`.
        code_weight, code_average: see `bench.tasks.code.CodePenalty`.
        iterations, learning_rate, schedule: see `bench.tasks.problem.OptimiserSettings`.
    """

    distances: int
    batch: int
    surface_width: float
    code_weight: float
    code_average: str
    iterations: int
    learning_rate: float
    schedule: str

    def __post_init__(self) -> None:
        check_at_least("task.distances", self.distances, 100, "24000 works")
        check_at_least("task.batch", self.batch, 1, "4000 works")
        check_positive("task.surface_width", self.surface_width, "0.05 works")
        CodePenalty(self.code_weight, self.code_average)
        OptimiserSettings(self.iterations, self.learning_rate, self.schedule)

    @property
    def optimiser(self) -> OptimiserSettings:
        """For how long and how fast."""
        return OptimiserSettings(self.iterations, self.learning_rate, self.schedule)

    def execute(self, cell: Cell) -> None:
        """Fits the code, and judges the field as a surface and as a distance."""
        stage, record = cell.stage, cell.record
        field = solve(self, cell)
        record.definitions |= DEFINITIONS
        samples = true_surface(stage, stage.seed + 1), true_surface(stage, stage.seed)
        floor = surface_metrics(*samples, threshold=stage.evaluation.fscore_threshold)
        points, distances = sample_distances(stage.scene.mesh, self.distances, stage.seed + 1)
        close = distances.abs() < NEAR
        points, distances = points[close].to(stage.device), distances[close].to(stage.device)
        lengths = autograd_gradients(field, points).norm(dim=-1)
        middle, high = lengths.double().quantile(torch.tensor([0.5, 0.99], dtype=torch.float64).to(lengths.device))
        with torch.no_grad():
            error = (field(points) - distances).abs().mean()
        record.metrics |= {
            "floor_chamfer_l2": floor["chamfer_l2"],
            "distance_error": error.item(),
            "slope_median": middle.item(),
            "slope_p99": high.item(),
        }
        size = stage.evaluation.picture or stage.scene.view.camera.height
        camera = stage.scene.view.camera.resized(size, size)
        found, true = look(field, camera, stage), see(Truth(stage.scene.mesh), camera)
        save_images(cell.folder, found, true, gradient_length=lengths.cpu().numpy())

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene, from the mean shape, code zero."""
        points, distances = sample_distances(scene.mesh, self.distances, seed)
        generator = torch.Generator(device=device).manual_seed(seed)
        given = TrueDistances(self, points.to(device), distances.to(device), generator)
        nothing = torch.zeros_like(scene.view.mask)
        penalty = CodePenalty(self.code_weight, self.code_average)
        return code_problem(prior, penalty, given.compare, observed=nothing, rays=self.batch, device=device)


@dataclass(frozen=True)
class TrueDistances:
    """Signed distances of the truth; `compare` asks a field at some of them."""

    settings: PriorFit
    points: Float[Tensor, "n 3"]
    distances: Float[Tensor, " n"]
    generator: torch.Generator

    def compare(self, field: Field, iteration: int) -> Terms:
        """The mean error, weighted towards the surface as in the prior's training."""
        count = min(self.settings.batch, len(self.points))
        picked = torch.randint(len(self.points), (count,), generator=self.generator, device=self.points.device)
        distances = self.distances[picked]
        error = (field(self.points[picked]) - distances).abs()
        return {"distance": near_surface_first(error, distances, self.settings.surface_width).mean()}
