"""Volume rendering along rays: weights of samples from their transmittance, and the rendering from the weights."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, carries_gradient
from renderers.gradients import reevaluate_with_graph
from renderers.rendering import (
    DISTANCE_CAPABILITIES,
    Capabilities,
    Deferred,
    Rendering,
    Status,
    Volume,
    assemble,
    check_kind,
)
from renderers.schedule import schedule_position
from renderers.tracing.bracket import SAMPLES_PER_BATCH, equally_spaced

MIN_LIGHT = 1e-5  # samples that absorb less of a ray's light have neither a weight nor a gradient
HIT_OPACITY = 0.5  # a ray with a larger opacity is a hit
MIN_FIELD_CHANGE = 1e-5  # scene units: smaller changes between two samples are rounding
MIN_IMPORTANCE = 1e-12  # spread evenly over a ray, so that a ray without importance is sampled evenly
MIN_LOSS_OPACITY = 1e-3  # clamp of the silhouette loss, as in the official code of NeuS; no gradient outside it


@dataclass(frozen=True)
class Samples:
    """Samples along n rays, without a graph.

    Args:
        distance: along the rays, increasing.
        value: of the field at the samples; non-finite values become free space.
    """

    distance: Float[Tensor, "n samples"]
    value: Float[Tensor, "n samples"]

    @staticmethod
    def of(field: Field, rays: Rays, distance: Float[Tensor, "n samples"]) -> "Samples":
        """The field's values at distances along n rays."""
        return Samples(distance, _finite(field(rays.at_each(distance))))

    def select(self, index: Tensor) -> "Samples":
        """The samples of the rays at `index`."""
        return Samples(self.distance[index], self.value[index])

    def merge(self, other: "Samples") -> "Samples":
        """The samples of both, by increasing distance."""
        distance, order = torch.cat([self.distance, other.distance], dim=1).sort(dim=1)
        return Samples(distance, torch.cat([self.value, other.value], dim=1).gather(1, order))


# From values and distances [n, samples] to the logarithm of the fraction of light that passes each sample [n, samples],
# or each interval between two samples [n, samples - 1]; at most 0.
LogTransmittance = Callable[[Tensor, Tensor], Tensor]
Search = Callable[[Field, Rays, Tensor, Tensor], Samples]  # field, rays, entry and exit distances


def schedule(first: float, last: float, over: int, iteration: int) -> float:
    """A setting at an iteration from 0: from `first` to `last` in `over` iterations, by a constant factor."""
    return last * (first / last) ** max(1 - schedule_position(iteration) / over, 0) if over else last


def weights(log_transmittance: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The fraction of a ray's light that each sample absorbs: it passes all samples before, but not this one."""
    return _log_light_before(log_transmittance).exp() * -torch.expm1(log_transmittance)


def resample(
    distance: Float[Tensor, "n samples"], importance: Float[Tensor, "n intervals"], count: int
) -> Float[Tensor, "n count"]:
    """Distances at the midpoints of `count` equal fractions of a piecewise constant density.

    Args:
        distance: the ends of the intervals, increasing.
        importance: of each interval, at least 0; if all are 0, the density is uniform.
    """
    lengths = distance[:, 1:] - distance[:, :-1]
    density_offset = MIN_LIGHT * importance.sum(dim=1, keepdim=True) + MIN_IMPORTANCE
    density = importance + density_offset * lengths / lengths.sum(dim=1, keepdim=True)
    total = torch.nn.functional.pad(density.cumsum(dim=1), (1, 0))
    total = total / total[:, -1:]
    fractions = (torch.arange(count, dtype=distance.dtype, device=distance.device) + 0.5) / count
    fractions = fractions.expand(len(distance), count).contiguous()
    after = torch.searchsorted(total, fractions, right=True).clamp(1, distance.shape[1] - 1)
    low, high = total.gather(1, after - 1), total.gather(1, after)
    position = ((fractions - low) / (high - low).clamp_min(torch.finfo(low.dtype).tiny)).clamp(0, 1)
    start = distance.gather(1, after - 1)
    return start + position * (distance.gather(1, after) - start)


def render_volume(
    field: Field, rays: Rays, search: Search, log_transmittance: LogTransmittance, *, radius: float
) -> Rendering:
    """Renders a volume: searches samples without a graph, then sums them with a graph.

    `distance` of a hit is the weighted mean of its samples' distances; its gradient is that of the weights. It covers
    only samples of the surface that absorbs the median of the ray's light, so that two surfaces are not averaged.
    `residual` is the field's value at that distance, interpolated between the two nearest samples.

    Args:
        rays: of any leading shape.
        search: returns the samples.
        log_transmittance: from the samples' values and distances.
        radius: of the sphere about the origin that contains the shape.
    """
    flat = rays.flat()
    entry, leave, meets = (column.detach() for column in sphere_span(flat, radius))
    queried = meets.nonzero().squeeze(-1)
    blocks = queried.split(SAMPLES_PER_BATCH // 256)  # bounds the memory of a search; one block, even of no rays
    results = [_BatchResult.of(field, flat, index, (entry, leave), search, log_transmittance) for index in blocks]
    result = _BatchResult(*map(torch.cat, zip(*(vars(batch).values() for batch in results), strict=True)))
    inside = result.starts_inside
    hit = (result.opacity.detach() > HIT_OPACITY) & ~inside
    hit_index = hit.nonzero().squeeze(-1)
    status = torch.full_like(inside, Status.MISS, dtype=torch.int8)
    status = status.masked_fill(inside, Status.STARTED_INSIDE).masked_fill(hit, Status.HIT)
    end = torch.where(hit, result.mean, torch.where(inside, entry[queried], leave[queried]))
    closest_distance, closest_value = result.closest_distance, result.closest_value
    values = reevaluate_with_graph(
        field, flat[queried[hit_index]], closest_distance[hit_index], closest_value[hit_index]
    )
    closest_value = closest_value.index_put((hit_index,), values)
    rendering = assemble(
        rays,
        radius,
        distance=torch.where(meets, entry, leave).index_put((queried,), end),
        status=torch.full_like(meets, Status.MISS, dtype=torch.int8).index_put((queried,), status),
        residual=torch.zeros_like(entry).index_put((queried,), torch.where(hit, result.residual, result.closest_value)),
        closest=(queried, closest_value),
    )
    is_deferred = torch.zeros_like(meets).index_put((queried,), ~hit)
    deferred = Deferred(leave.index_put((queried,), closest_distance).view(rays.shape), is_deferred.view(rays.shape))
    volume = Volume(result.ray, result.distance, result.weight)
    return replace(rendering, deferred=deferred, volume=volume)


@dataclass(frozen=True, kw_only=True)
class VolumeRenderer(ABC):
    """The common part of all volume renderers.

    Args:
        sharpening: iterations from the first to the last blur, by a constant factor.
        mask_weight: of the silhouette loss.
        sphere_radius: of the sphere about the origin that contains the shape.
    """

    sharpening: int
    mask_weight: float
    sphere_radius: float

    capabilities: ClassVar[Capabilities] = DISTANCE_CAPABILITIES

    def __post_init__(self) -> None:
        check_at_least("sharpening", self.sharpening, 0, "as many as the optimisation has, or 0 to be sharp at once")
        check_at_least("mask_weight", self.mask_weight, 0, "0.1 is that of NeuS")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")

    @abstractmethod
    def render(self, field: Field, rays: Rays) -> Rendering:
        """See `Renderer`."""

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """The mean cross entropy of opacities and a mask (NeuS, Sec. 3.2); the other papers do not use masks."""
        opacity = rendering.opacity.clamp(MIN_LOSS_OPACITY, 1 - MIN_LOSS_OPACITY)
        entropy = -torch.where(mask, opacity, 1 - opacity).log().sum() / max(mask.numel(), 1)
        return self.mask_weight * entropy


@dataclass(frozen=True)
class SharpenedVolume(VolumeRenderer):
    """A volume of one sharpness, whose samples lie where the weights of sharper and sharper volumes are large.

    Args:
        samples: equally spaced from the ray's entry into the sphere to its exit, both included.
        rounds: of further samples by importance.
        round_samples: in each round.
        round_sharpness: sharpness in the first round, per scene unit; it doubles with each round.
        sharpness: inverse of the blur of the surface, per scene unit.
        first_sharpness: at the first iteration of an optimisation.
        sharpening, mask_weight, sphere_radius: see `VolumeRenderer`.
    """

    samples: int
    rounds: int
    round_samples: int
    round_sharpness: float
    sharpness: float
    first_sharpness: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("samples", self.samples, 2, "the paper of NeuS uses 64")
        check_at_least("rounds", self.rounds, 0, "the official code of NeuS uses 4")
        check_at_least("round_samples", self.round_samples, 1, "the official code of NeuS uses 16")
        check_positive("round_sharpness", self.round_sharpness, "the official code of NeuS begins at 64")
        check_positive("sharpness", self.sharpness, "1000 blurs the surface over .004 of the unit sphere")
        check_positive("first_sharpness", self.first_sharpness, "the official code of NeuS begins at 20")

    @property
    def blur(self) -> float:
        """The inverse of the sharpness, in scene units."""
        return 1 / self.sharpness

    def with_blur(self, blur: float) -> "SharpenedVolume":
        return replace(self, sharpness=1 / blur, sharpening=0)

    def at_iteration(self, iteration: int) -> "SharpenedVolume":
        """The renderer at an iteration, with a sharpness between `first_sharpness` and `sharpness`."""
        return replace(self, sharpness=schedule(self.first_sharpness, self.sharpness, self.sharpening, iteration))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Samples where the weights are large, then sums with a graph."""
        check_kind(self, field)
        return render_volume(field, rays, self._search, self._log_transmittance, radius=self.sphere_radius)

    @abstractmethod
    def _log_transmittance(
        self, value: Float[Tensor, "n samples"], distance: Float[Tensor, "n samples"]
    ) -> Float[Tensor, "n intervals"]:
        """The logarithm of the fraction of light that passes each interval between samples."""

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> Samples:
        """Equally spaced samples, then rounds of further ones where the weight is largest."""
        samples = Samples.of(field, rays, equally_spaced(entry, leave, self.samples))
        for index in range(self.rounds):
            sharper = replace(self, sharpness=self.round_sharpness * 2**index)
            importance = weights(sharper._log_transmittance(samples.value, samples.distance))
            distance = resample(samples.distance, importance, self.round_samples)
            samples = samples.merge(Samples.of(field, rays, distance))
        return samples


@dataclass(frozen=True)
class _BatchResult:
    """For n rays: opacity, mean distance, the field's value there, and the sample with the smallest magnitude.

    `ray`, `distance` and `weight` describe the samples with a weight, of all flattened rays.
    """

    opacity: Float[Tensor, " n"]
    mean: Float[Tensor, " n"]
    residual: Float[Tensor, " n"]
    closest_value: Float[Tensor, " n"]
    closest_distance: Float[Tensor, " n"]
    starts_inside: Bool[Tensor, " n"]
    ray: Int[Tensor, " samples"]
    distance: Float[Tensor, " samples"]
    weight: Float[Tensor, " samples"]

    @staticmethod
    def of(
        field: Field,
        rays: Rays,
        index: Int[Tensor, " n"],
        span: tuple[Tensor, Tensor],
        search: Search,
        log_transmittance: LogTransmittance,
    ) -> "_BatchResult":
        """Searches and sums samples along the rays at `index`."""
        batch, (entry, leave) = rays[index], (bound[index] for bound in span)
        with torch.no_grad():
            samples = search(field, batch, entry, leave)
            value, distance = samples.value, samples.distance
            closest = value.abs().argmin(dim=1, keepdim=True)
        weight = weights(log_transmittance(_values_with_graph(field, batch, samples, log_transmittance), distance))
        if weight.shape[1] < distance.shape[1]:
            distance = (distance[:, 1:] + distance[:, :-1]) / 2
        opacity = weight.sum(dim=1)
        surface_weight = weight * _median_surface_mask(weight.detach(), value)
        mean = (surface_weight * distance).sum(dim=1) / surface_weight.sum(dim=1).clamp_min(MIN_LIGHT)
        row, column = (weight.detach() > MIN_LIGHT).nonzero(as_tuple=True)
        return _BatchResult(
            opacity,
            mean,
            _interpolate(samples, mean.detach()),
            value.gather(1, closest).squeeze(1),
            samples.distance.gather(1, closest).squeeze(1),
            value[:, 0] < 0,
            index[row],
            distance[row, column],
            weight[row, column],
        )


def _values_with_graph(
    field: Field, rays: Rays, samples: Samples, log_transmittance: LogTransmittance
) -> Float[Tensor, "n samples"]:
    """The samples' values, with a graph where weights depend on them by more than `MIN_LIGHT`."""
    is_required = rays.origins.requires_grad or rays.directions.requires_grad or carries_gradient(field, rays.origins)
    if not (torch.is_grad_enabled() and is_required):
        return samples.value
    with torch.no_grad():
        log_light = log_transmittance(samples.value, samples.distance)
        matters = (_log_light_before(log_light) > log(MIN_LIGHT)) & (-torch.expm1(log_light) > MIN_LIGHT)
        if matters.shape[1] < samples.value.shape[1]:  # both ends of an interval
            pad = torch.nn.functional.pad
            matters = pad(matters, (0, 1)) | pad(matters, (1, 0))
    row, column = matters.nonzero(as_tuple=True)
    values = _finite(field(rays[row].at(samples.distance[row, column])))
    return samples.value.index_put((row, column), values)


def _median_surface_mask(weight: Float[Tensor, "n k"], value: Float[Tensor, "n samples"]) -> Bool[Tensor, "n k"]:
    """A mask of the samples of the surface that absorbs the median of the ray's absorbed light.

    A surface begins where the field, still positive, changes from increasing to decreasing.
    """
    absorbed = weight.cumsum(dim=1)
    middle = (absorbed < absorbed[:, -1:] / 2).sum(dim=1, keepdim=True).clamp_max(weight.shape[1] - 1)
    step = value[:, 1:] - value[:, :-1]
    changes = step.abs() > MIN_FIELD_CHANGE
    last_change = torch.where(changes, torch.arange(step.shape[1], device=step.device), 0).cummax(dim=1)[0]
    rising = (step.gather(1, last_change) > MIN_FIELD_CHANGE)[:, :-1]
    starts_surface = rising & (step[:, 1:] < -MIN_FIELD_CHANGE) & (value[:, 1:-1] > 0)
    surface_number = torch.nn.functional.pad(starts_surface, (1, 1)).cumsum(dim=1)[:, : weight.shape[1]]
    return surface_number == surface_number.gather(1, middle)


def _finite(values: Tensor) -> Tensor:
    return torch.where(values.isfinite(), values, 1.0)


def _log_light_before(log_transmittance: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The logarithm of the fraction of light that passes all samples before each one."""
    return log_transmittance.cumsum(dim=1) - log_transmittance


def _interpolate(samples: Samples, distance: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The field at a distance along each ray, interpolated linearly between the nearest samples."""
    last = samples.distance.shape[1] - 1
    after = torch.searchsorted(samples.distance, distance[:, None]).clamp(1, last)
    near, far, low, high = (
        table.gather(1, index).squeeze(1) for table in (samples.distance, samples.value) for index in (after - 1, after)
    )
    fraction = (distance - near) / (far - near).clamp_min(torch.finfo(near.dtype).tiny)
    return low + fraction.clamp(0, 1) * (high - low)
