"""Stress tests of an inverse problem: a sphere is fitted to one depth image and its silhouette.

Its four parameters are the centre and the logarithm of the radius. The observations are disturbed, or the start or the
optimiser is made worse.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.machine.limits import Limits
from bench.records.record import RunStatus
from bench.solve.observed_view import ObservedView
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.solve.solve import check_field_gradient
from bench.stress.trial import Conditions, Failure, Outcome
from datasets.scene import View
from datasets.stress.solids import Solid, sphere_solid
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.field import Counts, Field, Meter
from renderers.rendering import Renderer

RADII, FACTORS = (0.35, 0.55), (0.75, 1.3)  # true radii; the radius at the start over the true one
SURFACE_SAMPLES = 2000
DEFINITIONS = {
    "surface_error": "mean magnitude of the fitted sphere's distance at points of the true surface, in scene units",
    "evaluations_per_ray": "field values computed, divided by rays times iterations",
}


@dataclass(frozen=True)
class Observation:
    """The observations given to a fit."""

    camera: Camera  # assumed by the fit
    depth: Float[Tensor, "height width"]
    observed: Bool[Tensor, "height width"]
    mask: Bool[Tensor, "height width"]


Disturb = Callable[[Observation, float, np.random.Generator], Observation]


def depth_noise(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Normal noise of a standard deviation, in scene units, on each depth."""
    noise = torch.from_numpy(draw.normal(size=given.depth.shape)).float()
    return replace(given, depth=given.depth + severity * noise)


def depth_outliers(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the depths is replaced by random ones between 1.5 and 3.5."""
    wild = torch.from_numpy(draw.uniform(1.5, 3.5, given.depth.shape)).float()
    return replace(given, depth=torch.where(_drawn(given, severity, draw), wild, given.depth))


def depth_steps(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Depths are rounded to multiples of a step, in scene units."""
    return replace(given, depth=severity * torch.round(given.depth / severity))


def missing_depth(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the depths is missing."""
    return replace(given, observed=given.observed & ~_drawn(given, severity, draw))


def mask_errors(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the mask's pixels is wrong; the depths are unchanged."""
    return replace(given, mask=given.mask ^ _drawn(given, severity, draw))


def wrong_focal_length(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """The assumed focal length is too long by a share."""
    return replace(given, camera=given.camera.zoomed(1 + severity))


def wrong_pose(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """The assumed camera is turned about its centre by an angle, in degrees."""
    axis = draw.normal(size=3)
    turn = torch.from_numpy(np.radians(severity) * axis / np.linalg.norm(axis)).float()
    return replace(given, camera=given.camera.moved(torch.cat([torch.zeros(3), turn])))


DISTURBANCES: dict[str, Disturb] = {
    function.__name__: function
    for function in (
        depth_noise, depth_outliers, depth_steps, missing_depth, mask_errors, wrong_focal_length, wrong_pose,
    )
}  # fmt: skip
SETTINGS = {"far_start": "offset", "learning_rate": "learning_rate"}  # of the fit, which the severity replaces
FITS = (*DISTURBANCES, *SETTINGS, "a_ball")  # the last is undisturbed, for a severity that is a renderer's setting


def judge_fit(
    name: str, severity: float, draw: np.random.Generator, *, renderer: Renderer, conditions: Conditions
) -> Outcome:
    """Fits a sphere to observations, of which the severity is a disturbance or one of the fit's settings.

    Args:
        name: of the fit, in `FITS`.
        draw: of spheres, camera and disturbance.

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
    compared = ObservedView.of(view, fit, renderer, observed=given.observed, mask=given.mask, device=conditions.device)
    problem = SphereProblem(start.to(conditions.device).requires_grad_(), compared, conditions.limits)
    history = History()
    settings = OptimiserSettings(fit.iterations, fit.learning_rate, "cosine")
    optimise(problem, settings, conditions.device, history=history, on_step=lambda line: None)
    error = float(problem.field()(_surface(true, draw).to(conditions.device)).abs().mean())
    spent = history.counts.value / given.observed.numel() / max(len(history.curve), 1)
    return Outcome(
        _failure(history, error, conditions.criteria.surface_error),
        {"surface_error": error, "evaluations_per_ray": spent},
    )


@dataclass
class SphereProblem:
    """The problem of finding a sphere's four parameters; see `bench.solve.solve.Objective`."""

    free: Float[Tensor, "4"]
    given: ObservedView
    limits: Limits
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        self.parameters = [self.free]
        self.watched = self.limits.watch(self.field(), self.free.device)  # the limit is on the whole fit

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The terms and their sum."""
        self.watched.inner = _sphere(self.free).field
        terms = self.given.compare(Meter(self.watched, self.counts), iteration)
        return {"total": torch.stack(list(terms.values())).sum(), **terms}

    def field(self) -> Field:
        """The current sphere."""
        return _sphere(self.free.detach()).field


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


def _drawn(given: Observation, share: float, draw: np.random.Generator) -> Bool[Tensor, "height width"]:
    return torch.from_numpy(draw.uniform(size=given.depth.shape) < share)
