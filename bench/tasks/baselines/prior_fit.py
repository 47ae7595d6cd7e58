"""The best possible fit of a prior: its code fitted to the true distances of a shape."""

from dataclasses import dataclass

import torch

from bench.evaluate.evaluate import surface_metrics
from bench.evaluate.refined import refined_view
from bench.pictures.run_figures import save_images
from bench.setup.inputs import RunContext
from bench.shape_prior import Prior, near_surface_first, sample_distances
from bench.solve.latent_code import CodePenalty, CodeProblem, Terms
from bench.solve.optimise import OptimiserSettings
from bench.solve.solve import solve_task
from datasets.scene import Scene, sample_surface, see
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, autograd_gradients
from renderers.rendering import Renderer

MAX_OFFSET = 0.02  # scene units: the field's distance error is measured this close to the true surface
DEFINITIONS = {
    "floor_chamfer_l2": "chamfer_l2 between two independent samplings of the true surface, the least that can be "
    "measured; in squared scene units.",
    "distance_error": f"Mean absolute error of the field within {MAX_OFFSET} of the true surface, in scene units.",
    "slope_median": f"Median length of the field's gradient within {MAX_OFFSET} of the true surface; 1 for a distance.",
    "slope_p99": "99th percentile of the length of the gradient there.",
}


@dataclass(frozen=True)
class PriorFit:
    """Fits a code to signed distances of the true mesh: the best possible result of methods that use the prior.

    The renderer is not used in the fit, only for pictures and the evaluation.

    Args:
        distances: number of signed distances of the shape.
        batch: number of distances in an iteration.
        surface_width: see `bench.shape_prior.PriorSettings`.
        code: penalty on the code.
        optimiser: iterations and learning rates.
    """

    distances: int
    batch: int
    surface_width: float
    code: CodePenalty
    optimiser: OptimiserSettings

    def __post_init__(self) -> None:
        check_at_least("task.distances", self.distances, 100, "24000 works")
        check_at_least("task.batch", self.batch, 1, "4000 works")
        check_positive("task.surface_width", self.surface_width, "0.05 works")

    def execute(self, run: RunContext) -> None:
        """Fits the code, and evaluates the field as a surface and as a distance."""
        inputs, record = run.inputs, run.record
        state = solve_task(self, run)
        record.definitions |= DEFINITIONS
        resampled = sample_surface(inputs.scene.mesh, inputs.evaluation.points, inputs.seed + 1)
        floor = surface_metrics(resampled, inputs.true_surface, threshold=inputs.evaluation.fscore_threshold)
        points, distances = sample_distances(inputs.scene.mesh, self.distances, inputs.seed + 1)
        close = distances.abs() < MAX_OFFSET
        points, distances = points[close].to(inputs.device), distances[close].to(inputs.device)
        slopes = autograd_gradients(state.field, points).norm(dim=-1)
        median, p99 = slopes.double().quantile(torch.tensor([0.5, 0.99], dtype=torch.float64).to(slopes.device))
        with torch.no_grad():
            error = (state.field(points) - distances).abs().mean()
        record.metrics |= {
            "floor_chamfer_l2": floor["chamfer_l2"],
            "distance_error": error.item(),
            "slope_median": median.item(),
            "slope_p99": p99.item(),
        }
        size = inputs.evaluation.picture or inputs.scene.view.camera.height
        camera = inputs.scene.view.camera.resized(size, size)
        predicted, true = refined_view(state, camera), see(inputs.scene.raycaster, camera)
        save_images(run.folder, predicted, true)

    def problem(
        self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device
    ) -> CodeProblem:
        """The problem of a scene; it starts from code zero, the mean shape."""
        points, distances = sample_distances(scene.mesh, self.distances, seed)
        generator = torch.Generator(device=device).manual_seed(seed)
        points, distances = points.to(device), distances.to(device)
        count = min(self.batch, len(points))

        def compare(field: Field, iteration: int) -> Terms:
            """The mean absolute error at a random batch, weighted towards the surface as in the prior's training."""
            picked = torch.randint(len(points), (count,), generator=generator, device=device)
            error = (field(points[picked]) - distances[picked]).abs()
            return {"distance": near_surface_first(error, distances[picked], self.surface_width).mean()}

        nothing = torch.zeros_like(scene.view.mask)
        return CodeProblem(prior, self.code, compare, nothing, self.batch, device, mask=False)
