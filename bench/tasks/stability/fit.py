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
from bench.tasks.stability.solids import Solid, sphere_solid
from bench.tasks.stability.trial import Conditions, Failure, Outcome
from datasets.scene import View
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.field import Counts, Field, Meter
from renderers.rendering import Renderer

TRUE_RADII, INITIAL_RADIUS_FACTORS = (0.35, 0.55), (0.75, 1.3)  # the factors are the initial radius over the true one
SURFACE_SAMPLES = 2000
DEFINITIONS = {
    "surface_error": "mean magnitude of the fitted sphere's distance at points of the true surface, in scene units",
    "evaluations_per_ray": "field values computed, divided by rays times iterations",
}


@dataclass(frozen=True)
class Observation:
    camera: Camera  # assumed by the fit
    depth: Float[Tensor, "height width"]
    observed: Bool[Tensor, "height width"]
    mask: Bool[Tensor, "height width"]


Disturb = Callable[[Observation, float, np.random.Generator], Observation]


def depth_noise(observation: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Adds normal noise to each depth; the severity is its standard deviation, in scene units."""
    noise = torch.from_numpy(draw.normal(size=observation.depth.shape)).float()
    return replace(observation, depth=observation.depth + severity * noise)


def depth_outliers(observation: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Replaces a fraction of the depths by random ones between 1.5 and 3.5."""
    depth = torch.from_numpy(draw.uniform(1.5, 3.5, observation.depth.shape)).float()
    return replace(observation, depth=depth.where(_random_pixels(observation, severity, draw), observation.depth))


def depth_steps(observation: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Rounds depths to multiples of a step, in scene units."""
    return replace(observation, depth=severity * torch.round(observation.depth / severity))


def missing_depth(observation: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Removes a fraction of the depths."""
    return replace(observation, observed=observation.observed & ~_random_pixels(observation, severity, draw))


def mask_errors(observation: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Inverts a fraction of the mask's pixels; the depths are unchanged."""
    return replace(observation, mask=observation.mask ^ _random_pixels(observation, severity, draw))


def wrong_focal_length(observation: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Makes the assumed focal length too long by a fraction."""
    return replace(observation, camera=observation.camera.zoomed(1 + severity))


def wrong_pose(observation: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Turns the assumed camera about its centre by an angle, in degrees."""
    axis = draw.normal(size=3)
    turn = torch.from_numpy(np.radians(severity) * axis / np.linalg.norm(axis)).float()
    return replace(observation, camera=observation.camera.moved(torch.cat([torch.zeros(3), turn])))


DISTURBANCES: dict[str, Disturb] = {
    function.__name__: function
    for function in (
        depth_noise, depth_outliers, depth_steps, missing_depth, mask_errors, wrong_focal_length, wrong_pose,
    )
}  # fmt: skip
FIT_SETTINGS = {"far_start": "offset", "learning_rate": "learning_rate"}  # the severity replaces these settings
FITS = (*DISTURBANCES, *FIT_SETTINGS, "a_ball")  # the last has no disturbance: the severity is a renderer's setting


def judge_fit(
    name: str, severity: float, draw: np.random.Generator, *, renderer: Renderer, conditions: Conditions
) -> Outcome:
    """Fits a sphere to observations. The severity controls a disturbance or one of the fit's settings.

    Args:
        name: the fit, one of `FITS`.
        draw: generator of spheres, camera and disturbance.

    Raises:
        Unsupported: if the renderer has no gradient for the field.
        LimitReached: if the fit exceeds its limit of field evaluations or memory.
    """
    check_field_gradient(renderer)
    fit = conditions.fit
    if name in FIT_SETTINGS:
        fit = replace(fit, **{FIT_SETTINGS[name]: severity})
    true_parameters, initial = _draw_parameters(draw, fit.offset)
    observation = _observe(_sphere(true_parameters), fit.resolution, draw)
    if name in DISTURBANCES:
        observation = DISTURBANCES[name](observation, severity, draw)
    depth, mask, device = observation.depth, observation.mask, conditions.device
    view = View(observation.camera, depth, torch.zeros(*depth.shape, 3), mask)
    observed_view = ObservedView.of(view, fit, renderer, observed=observation.observed, mask=mask, device=device)
    problem = SphereProblem(initial.to(device).requires_grad_(), observed_view, conditions.limits)
    history = History()
    settings = OptimiserSettings(fit.iterations, fit.learning_rate, "cosine")
    optimise(problem, settings, device, history=history, on_step=lambda line: None)
    error = float(problem.field()(_surface_points(true_parameters, draw).to(device)).abs().mean())
    evaluations_per_ray = history.counts.value / observation.observed.numel() / max(len(history.curve), 1)
    return Outcome(
        _failure(history, error, conditions.criteria.surface_error),
        {"surface_error": error, "evaluations_per_ray": evaluations_per_ray},
    )


@dataclass
class SphereProblem:
    """The problem of finding a sphere's four parameters; see `bench.solve.optimise.Optimisable`."""

    sphere: Float[Tensor, "4"]
    view: ObservedView
    limits: Limits
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        self.parameters = [self.sphere]
        self.watched = self.limits.watch(self.field(), self.sphere.device)  # the limit is on the whole fit

    def loss(self, iteration: int) -> dict[str, Tensor]:
        self.watched.inner = _sphere(self.sphere).field
        terms = self.view.compare(Meter(self.watched, self.counts), iteration)
        return {"total": torch.stack(list(terms.values())).sum(), **terms}

    def field(self) -> Field:
        return _sphere(self.sphere.detach()).field


def _draw_parameters(draw: np.random.Generator, offset: float) -> tuple[Tensor, Tensor]:
    """The four true parameters, and the initial ones."""
    true = np.append(draw.uniform(-0.05, 0.05, 3), np.log(draw.uniform(*TRUE_RADII)))
    direction = draw.normal(size=3)
    offsets = np.append(offset * direction / np.linalg.norm(direction), np.log(draw.uniform(*INITIAL_RADIUS_FACTORS)))
    return torch.from_numpy(true).float(), torch.from_numpy(true + offsets).float()


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


def _surface_points(parameters: Float[Tensor, "4"], draw: np.random.Generator) -> Float[Tensor, "n 3"]:
    """Random points on the true sphere, uniform over its area."""
    directions = torch.nn.functional.normalize(torch.from_numpy(draw.normal(size=(SURFACE_SAMPLES, 3))).float(), dim=-1)
    return parameters[3].exp() * directions + parameters[:3]


def _failure(history: History, error: float, max_error: float) -> Failure:
    if history.status is RunStatus.NAN or error != error:
        return Failure.NAN
    if history.status is RunStatus.DIVERGED:
        return Failure.DIVERGED
    return Failure.NONE if error <= max_error else Failure.NOT_REACHED


def _random_pixels(observation: Observation, fraction: float, draw: np.random.Generator) -> Bool[Tensor, "_ _"]:
    return torch.from_numpy(draw.uniform(size=observation.depth.shape) < fraction)
