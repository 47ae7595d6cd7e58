"""Sphere tracing with a band about the silhouette that carries its gradient (Wang et al., SIGGRAPH Asia 2024)."""

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.gradients import implicit_rendering, reevaluate_with_graph
from renderers.rendering import Rendering, Status, Volume, check_kind
from renderers.silhouette import SurfaceRenderer
from renderers.tracing.march import RayFront, Stepping, march_front

# Times the band: samples above it are no candidates. A sample of a distance is at most 1.16 times the ray's minimum.
CANDIDATE_FACTOR = 1.5
MAX_VALUE = 1e3  # larger and infinite values are clamped
STEPS_PER_BATCH = 8  # steps between two searches for near misses


@dataclass(frozen=True)
class RelaxedBoundary(SurfaceRenderer):
    """Sphere tracing with a visibility gradient on rays that pass close by a surface.

    A near miss is a ray's local minimum of the field within the band above `epsilon`. It has the weight 0, with the
    derivative of minus the value over the band's width. The hit behind it has the rest of the weight. The mean over a
    pixel's rays then has the derivative of the pixel's content: the integral over the outline, spread over the band.

    Source: "A Simple Approach to Differentiable Rendering of SDFs" (Wang et al. 2024, arXiv 2405.08733), Secs. 4, 5.
    Differentiable in: field parameters and rays. Hits by the implicit rule, exactly, up to `epsilon`. The visibility
        gradient comes from the band: a narrower band has less bias and more variance.
    Needs: a distance or a bound inside the sphere; the band's width is in field units.
    Deviates from the paper: the minimum is evaluated at the vertex of the parabola through three marched samples, where
        its value is up to a tenth too large next to sharp edges; only the first surface within the band counts; the
        band begins at `epsilon`, where hits end; the mask loss is IDR's, since a mask of one ray per pixel gives no
        gradient to rays inside the outline.

    Args:
        steps: maximum marching steps per ray.
        epsilon: a ray has converged if the field's magnitude is below this, in scene units.
        band: width of the band, in field units.
        least_slope, mask_sharpness, mask_weight, sphere_radius: see `silhouette.SurfaceRenderer`.
    """

    steps: int
    epsilon: float
    band: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("steps", self.steps, 1, "400 converges, also next to an outline")
        check_positive("epsilon", self.epsilon, "5e-5 is a four-hundredth of a pixel at 64 x 64")
        check_positive("band", self.band, "0.01 is a third of a pixel at 64 x 64")

    @property
    def blur(self) -> float:
        """The band's width, in scene units if the field is a distance."""
        return self.band

    def with_blur(self, blur: float) -> "RelaxedBoundary":
        return replace(self, band=blur)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches without a graph, then attaches the gradients of hits and of near misses."""
        check_kind(self, field)
        flat = rays.flat()
        with torch.no_grad():
            front, near_distance, near_value = march_past_near_misses(self, field, flat, self.band)
        rendering = implicit_rendering(field, rays, front, least_slope=self.least_slope, radius=self.sphere_radius)
        distance, hit = rendering.distance.view(-1), (front.status == Status.HIT).nonzero().squeeze(-1)
        near = near_value.isfinite().nonzero().squeeze(-1)
        value = reevaluate_with_graph(field, flat[near], near_distance[near], near_value[near])
        near_weight = (value.detach() - value) / self.band
        hit_weight = torch.ones_like(distance).index_put((near,), 1 - near_weight)[hit]
        distances, weights = torch.cat([near_distance[near], distance[hit]]), torch.cat([near_weight, hit_weight])
        return replace(rendering, volume=Volume(torch.cat([near, hit]), distances, weights))


@runtime_checkable
class Marching(Protocol):
    """The settings of a march; see `RelaxedBoundary`."""

    @property
    def steps(self) -> int: ...
    @property
    def epsilon(self) -> float: ...
    @property
    def sphere_radius(self) -> float: ...


def march_past_near_misses(
    settings: Marching, field: Field, rays: Rays, band: float | Float[Tensor, ""]
) -> tuple[RayFront, Float[Tensor, " n"], Float[Tensor, " n"]]:
    """The front of n rays, and the distance and value of each one's first near miss; the value is infinite without one.

    Args:
        band: a near miss has a value below `epsilon` plus this, in field units.
    """
    front = RayFront.on_sphere(rays, radius=settings.sphere_radius, samples=1)
    tracker = NearMissTracker(band, settings.epsilon, field, rays, front.distance)
    march_front(field, rays, front, Stepping(settings.epsilon), settings.steps, on_step=tracker.add_sample)
    tracker.find_near_misses()
    return front, tracker.distance, tracker.value


class NearMissTracker:
    """Finds the first near miss of each of n rays: its `distance` and its `value`, which is infinite before.

    Samples are stored during the march, and searched every `STEPS_PER_BATCH` steps.
    """

    def __init__(
        self, band: float | Float[Tensor, ""], epsilon: float, field: Field, rays: Rays, start: Float[Tensor, " n"]
    ) -> None:
        self.band, self.epsilon, self.field, self.rays, self.sample_count = band, epsilon, field, rays, 2
        self.distance, self.value = start.clone(), torch.full_like(start, torch.inf)
        # By step, distance or value, and ray; the first two steps are the last two of the batch before.
        self.samples = start.new_full((2 + STEPS_PER_BATCH, 2, len(start)), torch.nan)

    def add_sample(self, index: Int[Tensor, " m"], distance: Float[Tensor, " m"], value: Float[Tensor, " m"]) -> None:
        """Stores a sample of each ray in `index`."""
        self.samples[self.sample_count].index_copy_(1, index, torch.stack([distance, value]))
        self.sample_count += 1
        if self.sample_count == len(self.samples):
            self.find_near_misses()

    def find_near_misses(self) -> None:
        """Evaluates the field at local minima of the stored samples; the first one within the band is a near miss."""
        band, epsilon, values = self.band, self.epsilon, self.samples[:, 1]
        before, middle, after = values[:-2], values[1:-1], values[2:]
        # Rounding makes neighbours at a minimum equal: of these, the last one counts.
        minima = (middle <= before) & (middle < after) & (middle > 0) & (middle < CANDIDATE_FACTOR * band)
        step, ray = (minima & self.value.isinf()).nonzero(as_tuple=True)
        if len(ray):
            samples = torch.stack([self.samples[step + later, :, ray] for later in range(3)])
            distance = _parabola_vertex(samples[..., 0], samples[..., 1].clamp_max(MAX_VALUE))
            value = self.field(self.rays[ray].at(distance))
            order = torch.where((value > epsilon) & (value < band + epsilon), step, STEPS_PER_BATCH)
            first = torch.full_like(self.value, STEPS_PER_BATCH, dtype=step.dtype).scatter_reduce(0, ray, order, "amin")
            chosen = (order == first[ray]) & (order < STEPS_PER_BATCH)  # at most one per ray
            infinite, candidates = torch.full_like(self.value, torch.inf), (distance, value)
            columns = [torch.where(chosen, column, torch.inf) for column in candidates]
            distance, value = (infinite.scatter_reduce(0, ray, column, "amin") for column in columns)
            self.distance = torch.where(value < torch.inf, distance, self.distance)
            self.value = torch.minimum(self.value, value)
        self.samples[:2] = self.samples[-2:]
        self.samples[2:] = torch.nan
        self.sample_count = 2


def _parabola_vertex(distances: Float[Tensor, "3 n"], values: Float[Tensor, "3 n"]) -> Float[Tensor, " n"]:
    """The distance of the vertex of the parabola through three values, of which the middle one is the smallest."""
    fall, rise = distances[1] - distances[0], distances[2] - distances[1]
    down, up = (values[0] - values[1]) / fall, (values[2] - values[1]) / rise
    return distances[1] + (down * rise - up * fall) / (2 * (down + up))
