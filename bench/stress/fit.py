"""Stress tests of an inverse problem: a sphere is fitted to one depth image and its silhouette.

Its four parameters are the centre and the logarithm of the radius. The observations are disturbed, or the start or the
optimiser is made worse.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.machine.limits import Limits
from bench.records.record import RunStatus
from bench.solve.observed_view import GivenView
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.solve.solve import check_field_gradient
from bench.stress.trial import Conditions, Failure, Outcome
from datasets.scene import View
from datasets.stress.observations import DISTURBANCES, Observation
from datasets.stress.solids import Solid, sphere_solid
from datasets.views import ViewSampler
from renderers.field import Counts, Field, Meter
from renderers.rendering import Renderer

RADII, FACTORS = (0.35, 0.55), (0.75, 1.3)  # true radii; the radius at the start over the true one
SURFACE_SAMPLES = 2000
DEFINITIONS = {
    "surface_error": "mean magnitude of the fitted sphere's distance at points of the true surface, in scene units",
    "evaluations_per_ray": "field values computed, divided by rays times iterations",
}


def judge_fit(
    name: str, severity: float, draw: np.random.Generator, *, renderer: Renderer, conditions: Conditions
) -> Outcome:
    """Fits a sphere to observations, of which the severity is a disturbance or one of the fit's settings.

    Args:
        name: of the fit, in `FITS`.
        severity: of what it names.
        draw: of spheres, camera and disturbance.
        renderer: that is tested.
        conditions: of all trials.

    Raises:
        Unsupported: where the renderer has no gradient towards the field.
        LimitReached: where the fit exceeds its values or memory.
    """
    check_field_gradient(renderer)
    fit = conditions.fit
    if name in SETTINGS:
        fit = replace(fit, **{SETTINGS[name]: severity})
    true, start = _draw_spheres(draw, fit.offset)
    given = _observe(_sphere(true), fit.resolution, draw)
    if name in DISTURBANCES:
        given = DISTURBANCES[name](given, severity, draw)
    view = View(given.camera, given.depth, torch.zeros(*given.depth.shape, 3), given.mask)
    compared = GivenView.of(view, fit, renderer, observed=given.observed, mask=given.mask, device=conditions.device)
    problem = SphereProblem(start.to(conditions.device).requires_grad_(), compared, conditions.limits)
    history = History()
    settings = OptimiserSettings(fit.iterations, fit.learning_rate, "cosine")
    optimise(problem, settings, conditions.device, history=history, on_step=lambda line: None)
    error = float(problem.field()(_surface(true, draw).to(conditions.device)).abs().mean())
    spent = history.counts.value / problem.rays_per_iteration / max(len(history.curve), 1)
    return Outcome(
        _failure(history, error, conditions.criteria.surface_error),
        {"surface_error": error, "evaluations_per_ray": spent},
    )


@dataclass
class SphereProblem:
    """The problem of finding a sphere's four parameters; see `bench.solve.solve.Objective`."""

    free: Float[Tensor, "4"]
    given: GivenView
    limits: Limits
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        self.watched = self.limits.watch(self.field(), self.free.device)  # the limit is on the whole fit

    @property
    def parameters(self) -> list[Tensor]:
        """The parameters that the optimiser changes."""
        return [self.free]

    @property
    def rays_per_iteration(self) -> int:
        """The number of pixels: all are rendered."""
        return self.given.observed.numel()

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The terms and their sum."""
        self.watched.inner = _sphere(self.free).field
        terms = self.given.compare(Meter(self.watched, self.counts), iteration)
        return {"total": torch.stack(list(terms.values())).sum(), **terms}

    def field(self) -> Field:
        """The current sphere."""
        return _sphere(self.free.detach()).field


SETTINGS = {"far_start": "offset", "learning_rate": "learning_rate"}  # of the fit, which the severity replaces
FITS = (*DISTURBANCES, *SETTINGS, "a_ball")  # the last is undisturbed, for a severity that is a renderer's setting


def _draw_spheres(draw: np.random.Generator, offset: float) -> tuple[Tensor, Tensor]:
    """The four true parameters, and those at the start."""
    true = np.append(draw.uniform(-0.05, 0.05, 3), np.log(draw.uniform(*RADII)))
    direction = draw.normal(size=3)
    wrong = np.append(offset * direction / np.linalg.norm(direction), np.log(draw.uniform(*FACTORS)))
    return torch.from_numpy(true).float(), torch.from_numpy(true + wrong).float()


def _sphere(parameters: Float[Tensor, "4"]) -> Solid:
    return sphere_solid(parameters[3].exp()).moved(parameters[:3])


def _observe(solid: Solid, resolution: int, draw: np.random.Generator) -> Observation:
    """Exact depth and silhouette, from a random camera."""
    sampler = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), resolution)
    camera = sampler.camera(draw.uniform(*sampler.azimuth), draw.uniform(*sampler.elevation))
    first = solid.trace(camera.double().rays().flat())
    mask = first.hit.view(camera.height, camera.width)
    depth = camera.depth(first.distance.view_as(mask).float()) * mask
    return Observation(camera, depth, mask, mask)


def _surface(parameters: Float[Tensor, "4"], draw: np.random.Generator) -> Float[Tensor, "n 3"]:
    """Random points on the true sphere, uniform over its area."""
    directions = torch.nn.functional.normalize(torch.from_numpy(draw.normal(size=(SURFACE_SAMPLES, 3))).float(), dim=-1)
    return parameters[3].exp() * directions + parameters[:3]


def _failure(history: History, error: float, largest: float) -> Failure:
    if history.status is RunStatus.NAN or error != error:
        return Failure.NAN
    if history.status is RunStatus.DIVERGED:
        return Failure.DIVERGED
    return Failure.NONE if error <= largest else Failure.NOT_REACHED
