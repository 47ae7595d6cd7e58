"""Stress tests of an inverse problem: the code of a trained prior is fitted to a depth image and its silhouette.

The ground truth is the shape of a training code. The observations are disturbed, the start or the optimiser is made
worse, or the shapes become harder.
"""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.machine.limits import Limits
from bench.records.record import RunStatus
from bench.shape_prior import Prior
from bench.solve.latent_code import total
from bench.solve.observed_view import ObservedView
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.solve.solve import check_field_gradient
from bench.tasks.stability.distortions import MIN_RESOLVED_THICKNESS
from bench.tasks.stability.solids import ReferenceTruth
from bench.tasks.stability.trial import Conditions, Failure, FitSettings, Outcome
from datasets.scene import View
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.field import Counts, Field, Meter, estimate_lipschitz
from renderers.fields import analytic
from renderers.fields.analytic import Shape
from renderers.rendering import Renderer

SLOPE_POINTS = 4096
HOLE_RADIUS = 0.3  # scene units
OCCLUDER_RADIUS, OCCLUDER_OFFSET = 0.2, 0.1  # scene units; the offset is that of the initial position
OCCLUDER_REACH = 0.6  # scene units: the maximum distance of its middle from the origin keeps it inside the sphere
OCCLUDER_ZOOM_FACTOR = 2.5
AZIMUTHS, ELEVATIONS = (0.0, 360.0), (15.0, 35.0)  # degrees
SPREAD_VIEWS, ALL_SIDES_DEGREES = 3, 240.0
DEFINITIONS = {
    "surface_error": "mean magnitude of the fitted field at the points of the true surface that the view shows, in "
    "scene units; on the axis one_sided_views, at those that three sides show; on the axes new_hole and occlusion, the "
    "error of the hole's radius or of the occluder's position",
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


def thin_parts(shape: Field, severity: float) -> Field:
    """A shape whose surface is moved inwards by a distance, so that its parts become thin (DIST, A.4)."""
    return Shape(lambda points: shape(points) + severity, shape.kind, shape.lipschitz)


def outside_family(shape: Field, severity: float) -> Field:
    """A shape that is twisted about the vertical axis, in degrees a scene unit: outside of the family (DIST, 4.2)."""

    def value(points: Tensor) -> Tensor:
        x, y, z = points.unbind(-1)
        angle = np.radians(severity) * y
        return shape(torch.stack([x * angle.cos() - z * angle.sin(), y, x * angle.sin() + z * angle.cos()], dim=-1))

    return Shape(value, shape.kind, shape.lipschitz)


def growing_slope(shape: Field, severity: float) -> Field:
    """A field that stops being a distance: its values are multiplied (IGR, Gropp 2020; IDR, Yariv 2020)."""
    return Shape(lambda points: severity * shape(points), shape.kind, shape.lipschitz)


OF_BOTH = {"thin_parts": thin_parts}
OF_TRUTH = {"outside_family": outside_family}
DURING_FIT = {"growing_slope": growing_slope}  # the severity grows from 1 over the fit
FIT_SETTINGS = {"far_start": "offset", "learning_rate": "learning_rate"}  # the severity replaces these settings
# The last has no disturbance: the severity is a renderer's setting.
OTHERS = ("new_hole", "occlusion", "one_sided_views", "a_code")
FITS = (*DISTURBANCES, *OF_BOTH, *OF_TRUTH, *DURING_FIT, *FIT_SETTINGS, *OTHERS)


@dataclass(frozen=True)
class Hole:
    """A straight hole of unknown radius through a shape; a negative radius is no hole."""

    start: Float[Tensor, "3"]
    direction: Float[Tensor, "3"]

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return torch.linalg.vector_norm(
            torch.linalg.cross(points - self.start.to(points), self.direction.to(points).expand_as(points)), dim=-1
        )

    def applied(self, shape: Field, radius: Float[Tensor, ""]) -> Field:
        return Shape(lambda points: torch.maximum(shape(points), radius - self.distance(points)), shape.kind, None)


@dataclass(frozen=True)
class Occluder:
    """A round part before a surface, at an unknown position across the view; near the sphere, it lies partly inside.

    It is a ball if its edge is rounded by its radius. With a sharp edge it is a short cylinder that faces the camera.
    Then its visible surface does not change when it moves across the view. Only its outline before the shape does.
    """

    middle: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]  # rows: to the right, towards the camera, downwards; scene directions
    rounding: float  # scene units

    def applied(self, shape: Field, position: Float[Tensor, "2"]) -> Field:
        half = OCCLUDER_RADIUS - self.rounding
        cylinder = analytic.cylinder(half, half)

        def value(points: Tensor) -> Tensor:
            moved = (points - self.middle.to(points)) @ self.axes.to(points).T
            across = torch.stack([position[0], torch.zeros_like(position[0]), position[1]])
            return torch.minimum(shape(points), cylinder(moved - across) - self.rounding)

        return Shape(value, shape.kind, shape.lipschitz)


@dataclass
class CodeFit:
    """The problem of finding a code, and the unknown of any modification; see `bench.solve.optimise.Optimisable`."""

    fit: str
    severity: float
    prior: Prior
    code: Float[Tensor, " code_length"]
    unknown: Float[Tensor, "*shape"]  # of the modification: a radius or a position
    modification: Hole | Occluder | None
    views: list[ObservedView]
    limits: Limits
    iterations: int
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        self.parameters = [self.code] if self.modification is None else [self.code, self.unknown]
        self.watched = self.limits.watch(self.field(0.0), self.code.device)  # the limit is on the whole fit

    def loss(self, iteration: int) -> dict[str, Tensor]:
        self.watched.inner = self.field((iteration + 1) / self.iterations)
        metered = Meter(self.watched, self.counts)
        of_views = [view.compare(metered, iteration) for view in self.views]
        terms = {name: torch.stack([each[name] for each in of_views]).mean() for name in of_views[0]}
        return {"total": total(terms), **terms}

    def field(self, progress: float) -> Field:
        """The fitted field after a fraction of the fit."""
        shape: Field = self.prior.decoder.at(self.code)
        if self.fit in OF_BOTH:
            shape = OF_BOTH[self.fit](shape, self.severity)
        if self.fit in DURING_FIT and progress > 0:
            shape = DURING_FIT[self.fit](shape, 1 + progress * (self.severity - 1))
        return shape if self.modification is None else self.modification.applied(shape, self.unknown)


def judge_fit(
    name: str, severity: float, draw: np.random.Generator, *, renderer: Renderer, conditions: Conditions
) -> Outcome:
    """Fits a code to observations. The severity controls a disturbance, the shapes or one of the fit's settings.

    Args:
        name: the fit, one of `FITS`.
        draw: generator of codes, cameras and disturbance.

    Raises:
        Unsupported: if the renderer has no gradient for the field.
        LimitReached: if the fit exceeds its limit of field evaluations or memory.
    """
    check_field_gradient(renderer)
    fit, prior, device = conditions.fit, conditions.prior, conditions.device
    if name in FIT_SETTINGS:
        fit = replace(fit, **{FIT_SETTINGS[name]: severity})
    is_occluded = name == "occlusion"  # then the initial code is the true one, and only the position is unknown
    code = prior.codes[draw.integers(len(prior.codes))]
    initial = (1 - (0.0 if is_occluded else fit.offset)) * code  # at an offset of 1 the mean shape
    true: Field = prior.decoder.at(code)
    if name in OF_BOTH or name in OF_TRUTH:
        true = (OF_BOTH | OF_TRUTH)[name](true, severity)
    direction = draw.uniform(*AZIMUTHS), draw.uniform(*ELEVATIONS)
    is_spread = name == "one_sided_views"
    cameras = _cameras(direction, fit.resolution, severity if is_spread else None)
    cameras = [camera.zoomed(OCCLUDER_ZOOM_FACTOR) for camera in cameras] if is_occluded else cameras
    observations = [_observe(true, camera) for camera in cameras]
    modification, unknown, initial_unknown = _modification(name, severity, observations[0], draw)
    if modification is not None:
        true = modification.applied(true, unknown)
        observations = [_observe(true, camera) for camera in cameras]
    sides = _cameras(direction, fit.resolution, ALL_SIDES_DEGREES) if is_spread else []
    undisturbed = [_observe(true, camera) for camera in sides] or observations
    visible = [each.camera.rays().at(each.camera.distance(each.depth))[each.mask] for each in undisturbed]
    points = torch.cat(visible).to(device) if any(map(len, visible)) else torch.zeros(1, 3, device=device)
    if name in DISTURBANCES:
        observations = [DISTURBANCES[name](each, severity, draw) for each in observations]
    fitted = replace(prior, decoder=deepcopy(prior.decoder).to(device))
    problem = CodeFit(
        *(name, severity, fitted, initial.to(device).requires_grad_()),
        unknown=initial_unknown.to(device).requires_grad_(),
        modification=modification,
        views=[_view(each, fit, renderer, device) for each in observations],
        limits=conditions.limits,
        iterations=fit.iterations,
    )
    history = History()
    settings = OptimiserSettings(fit.iterations, fit.learning_rate, "cosine")
    optimise(problem, settings, device, history=history, on_step=lambda line: None)
    with torch.no_grad():
        surface_error = problem.field(0.0)(points).abs().mean()
        error = float(surface_error if modification is None else (problem.unknown.cpu() - unknown).norm())
    rays = sum(each.observed.numel() for each in observations)
    evaluations_per_ray = history.counts.value / rays / max(len(history.curve), 1)
    return Outcome(
        _failure(history, error, conditions.criteria.surface_error),
        {"surface_error": error, "evaluations_per_ray": evaluations_per_ray},
    )


def _cameras(direction: tuple[float, float], resolution: int, spread: float | None) -> list[Camera]:
    """The camera at an azimuth and elevation; with a spread, three in an arc of that many degrees about it."""
    sampler = ViewSampler(2.5, 50.0, AZIMUTHS, ELEVATIONS, resolution)
    azimuth, elevation = direction
    turns = [0.0] if spread is None else np.linspace(-spread / 2, spread / 2, SPREAD_VIEWS).tolist()
    return [sampler.camera(azimuth + turn, elevation) for turn in turns]


def _observe(shape: Field, camera: Camera) -> Observation:
    """Depth and silhouette by safe steps, in float32: its rounding is far below a pixel."""
    slope = estimate_lipschitz(shape, radius=1.0, samples=SLOPE_POINTS, like=torch.zeros(1))
    with torch.no_grad():
        truth = ReferenceTruth(shape, slope, MIN_RESOLVED_THICKNESS, rounded=shape)
        first = truth.trace(camera.double().rays().flat())
    mask = first.hit.view(camera.height, camera.width)
    depth = camera.depth(first.distance.view_as(mask).float()) * mask
    return Observation(camera, depth, mask, mask)


def _view(observation: Observation, fit: FitSettings, renderer: Renderer, device: torch.device) -> ObservedView:
    depth, mask = observation.depth, observation.mask
    view = View(observation.camera, depth, torch.zeros(*depth.shape, 3), mask)
    return ObservedView.of(view, fit, renderer, observed=observation.observed, mask=mask, device=device)


def _modification(
    name: str, severity: float, observation: Observation, draw: np.random.Generator
) -> tuple[Hole | Occluder | None, Tensor, Tensor]:
    """The modification of the true shape, the true value of its unknown, and the initial value."""
    camera, hit = observation.camera, observation.mask.flatten()
    rays = camera.rays().flat()
    if name == "new_hole":
        middle = rays.directions[hit].mean(dim=0) if hit.any() else rays.directions.mean(dim=0)
        direction = torch.nn.functional.normalize(middle, dim=0)
        # The initial radius is that far below half of the true one (Mehta et al. 2022, on the topology of level sets).
        start = HOLE_RADIUS / 2 - severity
        return Hole(camera.center.float(), direction), torch.tensor(HOLE_RADIUS), torch.tensor(start)
    if name == "occlusion":
        # A ray that hits a surface has no gradient of such an outline (Li et al. 2018; Vicini et al. 2022).
        centre = rays.directions.mean(dim=0)
        nearest = ((rays.directions - centre).norm(dim=-1) + ~hit * 10.0).argmin()
        towards = -rays.directions[nearest]
        right = torch.nn.functional.normalize(torch.linalg.cross(towards, torch.tensor([0.0, -1.0, 0.0])), dim=0)
        axes = torch.stack([right, towards, torch.linalg.cross(right, towards)])
        shown = rays.at(camera.distance(observation.depth).flatten())[nearest]
        along = shown @ towards
        room = (along**2 - shown @ shown + OCCLUDER_REACH**2).clamp_min(0).sqrt() - along
        middle = shown + room.clamp(max=OCCLUDER_RADIUS) * towards
        angle = draw.uniform(0.0, 2 * np.pi)
        start = OCCLUDER_OFFSET * torch.tensor([np.cos(angle), np.sin(angle)]).float()
        return Occluder(middle, axes, severity * OCCLUDER_RADIUS), torch.zeros(2), start
    return None, torch.zeros(0), torch.zeros(0)


def _failure(history: History, error: float, max_error: float) -> Failure:
    if history.status is RunStatus.NAN or error != error:
        return Failure.NAN
    if history.status is RunStatus.DIVERGED:
        return Failure.DIVERGED
    return Failure.NONE if error <= max_error else Failure.NOT_REACHED


def _random_pixels(observation: Observation, fraction: float, draw: np.random.Generator) -> Bool[Tensor, "_ _"]:
    return torch.from_numpy(draw.uniform(size=observation.depth.shape) < fraction)
