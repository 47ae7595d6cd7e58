"""Does an inverse problem end where it should? A ball is fitted to one depth image and its silhouette.

Its four numbers, the middle and the logarithm of the radius, are free. What is given is then made worse, or the start.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.limits import Limits
from bench.optimise import Course, optimise
from bench.records import RunStatus
from bench.stress.conditions import Conditions, FitSettings
from bench.stress.outcome import Failure, Outcome
from bench.tasks.given import GivenView
from bench.tasks.problem import OptimiserSettings, check_field_gradient
from datasets.scene import View
from datasets.stress.solids import Solid, ball
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.field import Counts, Field, Meter
from renderers.rendering import Renderer

RADII, FACTORS = (0.35, 0.55), (0.75, 1.3)  # true radii; the radius at the start over the true one
SURFACE_SAMPLES = 2000
DEFINITIONS = {
    "surface_error": "mean magnitude of the fitted ball's distance at points of the true surface, in scene units",
    "evaluations_per_ray": "field values computed, over rays times iterations",
}


@dataclass(frozen=True)
class Observation:
    """What a fit is given."""

    camera: Camera  # that it believes in
    depth: Float[Tensor, "height width"]
    observed: Bool[Tensor, "height width"]
    mask: Bool[Tensor, "height width"]


Disturb = Callable[[Observation, float, np.random.Generator], Observation]


def judge_fit(trial: "FitTrial", renderer: Renderer, conditions: Conditions) -> Outcome:
    """Fits the ball that a trial draws, under its disturbance.

    Raises:
        Unsupported: where the renderer has no gradient towards the field.
        LimitReached: where it takes more than it may.
    """
    check_field_gradient(renderer)
    fit, draw = trial.settings(), trial.draw
    true, start = _balls(draw, fit.offset)
    given = trial.disturbed(_observe(_ball(true), fit.resolution, draw))
    view = View(given.camera, given.depth, torch.zeros(*given.depth.shape, 3), given.mask)
    compared = GivenView.of(view, fit, renderer, observed=given.observed, mask=given.mask, device=conditions.device)
    problem = BallProblem(start.to(conditions.device).requires_grad_(), compared, conditions.limits)
    course = Course()
    settings = OptimiserSettings(fit.iterations, fit.learning_rate, "cosine")
    optimise(problem, settings, conditions.device, course=course, on_step=lambda line: None)
    error = float(problem.field()(_surface(true, draw).to(conditions.device)).abs().mean())
    spent = course.counts.value / problem.rays_per_iteration / max(len(course.curve), 1)
    return Outcome(
        _failure(course, error, conditions.criteria.surface_error),
        {"surface_error": error, "evaluations_per_ray": spent},
    )


@dataclass(frozen=True)
class FitTrial:
    """A fit of a name in `FITS`, how severe it is, and what it may draw."""

    name: str
    fit: FitSettings
    severity: float
    draw: np.random.Generator

    def settings(self) -> FitSettings:
        """The fit's settings, with the one that the severity is."""
        if self.name not in SETTINGS:
            return self.fit
        return replace(self.fit, **{SETTINGS[self.name]: self.severity})

    def disturbed(self, given: Observation) -> Observation:
        """What is given in the place of the truth."""
        disturb = DISTURBANCES.get(self.name)
        return given if disturb is None else disturb(given, self.severity, self.draw)


@dataclass
class BallProblem:
    """Four numbers to be found; see `bench.tasks.problem.Descent`."""

    free: Float[Tensor, "4"]
    given: GivenView
    limits: Limits
    counts: Counts = field(default_factory=Counts)
    started: float = field(default_factory=time.perf_counter)

    @property
    def parameters(self) -> list[Tensor]:
        """What is free."""
        return [self.free]

    @property
    def rays_per_iteration(self) -> int:
        """All pixels."""
        return self.given.observed.numel()

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The terms and their sum."""
        shape = self.limits.watch(_ball(self.free).field, self.free.device)
        shape.started = self.started  # the limit is on the whole fit
        terms = self.given.compare(Meter(shape, self.counts), iteration)
        return {"total": torch.stack(list(terms.values())).sum(), **terms}

    def field(self) -> Field:
        """The ball as it stands."""
        return _ball(self.free.detach()).field


def depth_noise(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Normal noise of a standard deviation, in scene units, on each depth."""
    return replace(given, depth=given.depth + severity * _normal(given, draw))


def depth_outliers(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the depths is drawn anew, between 1.5 and 3.5."""
    wild = torch.from_numpy(draw.uniform(1.5, 3.5, given.depth.shape)).float()
    return replace(given, depth=torch.where(_drawn(given, severity, draw), wild, given.depth))


def depth_steps(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Depths are multiples of a step, in scene units."""
    return replace(given, depth=severity * torch.round(given.depth / severity))


def missing_depth(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the depths is not there."""
    return replace(given, observed=given.observed & ~_drawn(given, severity, draw))


def mask_errors(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the mask's pixels is wrong; depth is known where it was."""
    return replace(given, mask=given.mask ^ _drawn(given, severity, draw))


def wrong_focal_length(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """The camera is thought to have a longer focal length, by a share."""
    return replace(given, camera=given.camera.zoomed(1 + severity))


def wrong_pose(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """The camera is thought to be turned about its own centre by an angle, in degrees."""
    axis = draw.normal(size=3)
    turn = torch.from_numpy(np.radians(severity) * axis / np.linalg.norm(axis)).float()
    return replace(given, camera=given.camera.moved(torch.cat([torch.zeros(3), turn])))


DISTURBANCES: dict[str, Disturb] = {
    function.__name__: function
    for function in (
        depth_noise,
        depth_outliers,
        depth_steps,
        missing_depth,
        mask_errors,
        wrong_focal_length,
        wrong_pose,
    )
}
SETTINGS = {"far_start": "offset", "learning_rate": "learning_rate"}  # of the fit, that the severity is
FITS = (*DISTURBANCES, *SETTINGS, "a_ball")  # the last as it is, for a severity that is the renderer's own


def _balls(draw: np.random.Generator, offset: float) -> tuple[Tensor, Tensor]:
    """The true four numbers, and those at the start."""
    true = np.append(draw.uniform(-0.05, 0.05, 3), np.log(draw.uniform(*RADII)))
    direction = draw.normal(size=3)
    wrong = np.append(offset * direction / np.linalg.norm(direction), np.log(draw.uniform(*FACTORS)))
    return torch.from_numpy(true).float(), torch.from_numpy(true + wrong).float()


def _ball(numbers: Float[Tensor, "4"]) -> Solid:
    return ball(numbers[3].exp()).moved(numbers[:3])


def _observe(solid: Solid, resolution: int, draw: np.random.Generator) -> Observation:
    """Exact depth and silhouette, from a camera that is drawn."""
    sampler = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), resolution)
    camera = sampler.camera(draw.uniform(*sampler.azimuth), draw.uniform(*sampler.elevation))
    first = solid.trace(camera.double().rays().flat())
    mask = first.hit.view(camera.height, camera.width)
    depth = camera.depth(first.distance.view_as(mask).float()) * mask
    return Observation(camera, depth, mask, mask)


def _surface(numbers: Float[Tensor, "4"], draw: np.random.Generator) -> Float[Tensor, "n 3"]:
    """Points on the true ball, evenly over its area."""
    directions = torch.nn.functional.normalize(torch.from_numpy(draw.normal(size=(SURFACE_SAMPLES, 3))).float(), dim=-1)
    return numbers[3].exp() * directions + numbers[:3]


def _normal(given: Observation, draw: np.random.Generator) -> Float[Tensor, "height width"]:
    return torch.from_numpy(draw.normal(size=given.depth.shape)).float()


def _drawn(given: Observation, share: float, draw: np.random.Generator) -> Bool[Tensor, "height width"]:
    return torch.from_numpy(draw.uniform(size=given.depth.shape) < share)


def _failure(course: Course, error: float, largest: float) -> Failure:
    if course.status is RunStatus.NAN or error != error:
        return Failure.NAN
    if course.status is RunStatus.DIVERGED:
        return Failure.DIVERGED
    return Failure.NONE if error <= largest else Failure.NOT_REACHED
