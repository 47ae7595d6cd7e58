"""The best possible surface of a reconstruction: its field, fitted to the true distances of the shape."""

from dataclasses import dataclass, fields

import torch

from bench.setup.inputs import RunContext
from bench.shape_prior import near_surface_first, sample_distances
from bench.solve.latent_code import Terms
from bench.solve.pixel_draw import generator_of
from bench.tasks.reconstruction.problem import ReconstructionProblem
from bench.tasks.reconstruction.subject import Subject
from bench.tasks.reconstruction.task import Reconstruction
from renderers.checks import BadInput, check_at_least, check_positive
from renderers.field import Meter


@dataclass(frozen=True, kw_only=True)
class DistanceFit(Reconstruction):
    """Fits the field of a reconstruction to signed distances of the true mesh; no renderer takes part in the fit.

    The settings of `Reconstruction` keep their meaning. But `rays`, `losses`, `guide`, `pixel_block`
    and `blur_points` have no effect.

    Args:
        distances: number of signed distances of the shape.
        batch: number of distances in an iteration.
        surface_width: see `bench.shape_prior.PriorSettings`.
    """

    distances: int
    batch: int
    surface_width: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("task.distances", self.distances, 100, "100000 works")
        check_at_least("task.batch", self.batch, 1, "2000 works")
        check_positive("task.surface_width", self.surface_width, "0.05 works")

    def problem(self, name: str, subject: Subject, run: RunContext) -> "DistanceProblem":
        if subject.truth is None:
            raise BadInput("task=distance_fit needs the true surface: set dataset.truth, or take a scene")
        problem = super().problem(name, subject, run)
        settings = {each.name: getattr(problem, each.name) for each in fields(problem) if each.init}
        return DistanceProblem(**settings, task=self)


@dataclass
class DistanceProblem(ReconstructionProblem):
    """The problem of fitting a field to true distances; colours are not learnt."""

    task: DistanceFit | None = None

    def __post_init__(self) -> None:
        points, distances = sample_distances(self.subject.truth, self.task.distances, self.seed)
        device = self.parameters[0].device
        self.points, self.distances = points.to(device), distances.to(device)

    def loss(self, iteration: int) -> Terms:
        """The mean absolute error at random points, weighted towards the surface as in the prior's training."""
        picked = torch.randint(len(self.points), (self.task.batch,), generator=generator_of(self.seed, iteration))
        picked = picked.to(self.points.device)
        true = self.distances[picked]
        error = (Meter(self.model.field, self.counts)(self.points[picked]) - true).abs()
        distance = near_surface_first(error, true, self.task.surface_width).mean()
        return {"total": distance, "distance": distance.detach()}

    def objective(self) -> None:
        """Returns None: losses of different iterations are comparable."""
