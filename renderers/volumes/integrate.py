"""Volume rendering along rays: weights from the share of light that passes, and the rendering that they give."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.bracket import SAMPLES_PER_BATCH
from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, carries_gradient
from renderers.gradients import reevaluate_with_graph
from renderers.rendering import DISTANCE_CAPABILITIES, Capabilities, Deferred, Rendering, Status, Volume, assemble

FAINT = 1e-5  # share of a ray's light below which a sample has no part: neither a weight nor a gradient
SEEN = 0.5  # opacity above which a ray has hit
RISE = 1e-5  # of the field between two samples, scene units: less is rounding
LEAST_IMPORTANCE = 1e-12  # of a whole ray, spread evenly: where nothing is important all of it is
LEAST_OPACITY = 1e-3  # in the mask loss, which has no gradient beyond it; as in the official code of NeuS


@dataclass(frozen=True)
class Samples:
    """Samples along n rays, found without a graph.

    Args:
        distance: along the rays, rising.
        value: of the field there; what is not finite counts as free space.
    """

    distance: Float[Tensor, "n samples"]
    value: Float[Tensor, "n samples"]

    @staticmethod
    def of(field: Field, rays: Rays, distance: Float[Tensor, "n samples"]) -> "Samples":
        """The field's values at distances along n rays."""
        return Samples(distance, _finite(field(rays.at_each(distance))))

    def of_rays(self, index: Tensor) -> "Samples":
        """Those of some of the rays, by their places."""
        return Samples(self.distance[index], self.value[index])

    def joined(self, other: "Samples") -> "Samples":
        """The samples of both, in rising order."""
        distance, order = torch.cat([self.distance, other.distance], dim=1).sort(dim=1)
        return Samples(distance, torch.cat([self.value, other.value], dim=1).gather(1, order))


# From values and distances [n, samples] to the logarithm of the share of light that passes each sample [n, samples], or
# each interval between two [n, samples - 1]; at most 0.
Passing = Callable[[Tensor, Tensor], Tensor]
Search = Callable[[Field, Rays, Tensor, Tensor], Samples]  # field, rays, where they enter and leave the sphere


def scheduled(first: float, last: float, over: int, iteration: int) -> float:
    """A setting at an iteration, counted from 0: from `first` to `last` in `over` iterations, by equal factors."""
    return last * (first / last) ** max(1 - iteration / over, 0) if over else last


def weights(passing: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The share of a ray's light that stays in each sample: what has passed all before, and does not pass this one."""
    return _before(passing).exp() * -torch.expm1(passing)


def by_importance(
    distance: Float[Tensor, "n samples"], importance: Float[Tensor, "n intervals"], count: int
) -> Float[Tensor, "n count"]:
    """Distances drawn from a piecewise constant density, at the middles of `count` equal shares of it.

    Args:
        distance: the ends of the intervals, rising.
        importance: of each interval, at least 0; where all are 0 the density is even.
    """
    lengths = distance[:, 1:] - distance[:, :-1]
    least = FAINT * importance.sum(dim=1, keepdim=True) + LEAST_IMPORTANCE
    density = importance + least * lengths / lengths.sum(dim=1, keepdim=True)
    total = torch.nn.functional.pad(density.cumsum(dim=1), (1, 0))
    total = total / total[:, -1:]
    shares = (torch.arange(count, dtype=distance.dtype, device=distance.device) + 0.5) / count
    shares = shares.expand(len(distance), count).contiguous()
    after = torch.searchsorted(total, shares, right=True).clamp(1, distance.shape[1] - 1)
    low, high = total.gather(1, after - 1), total.gather(1, after)
    part = ((shares - low) / (high - low).clamp_min(torch.finfo(low.dtype).tiny)).clamp(0, 1)
    start = distance.gather(1, after - 1)
    return start + part * (distance.gather(1, after) - start)


def render_volume(field: Field, rays: Rays, search: Search, passing: Passing, *, radius: float) -> Rendering:
    """The rendering of a volume: samples are searched without a graph, then summed with one.

    `distance` of a hit is a mean of its samples' distances by weight, whose gradient is that of the weights: over the
    samples of the surface in which the middle of the ray's light stays, so that one that it passes and one behind that
    are not averaged. `residual` is the field's value there, between those of the samples beside it.

    Args:
        rays: of any leading shape.
        search: of the samples.
        passing: of light, by the samples' values.
        radius: of the sphere about the origin that holds the shape.
    """
    flat = rays.flat()
    entry, leave, meets = (part.detach() for part in sphere_span(flat, radius))
    queried = meets.nonzero().squeeze(-1)
    blocks = queried.split(SAMPLES_PER_BATCH // 256)  # bounds the memory of a search; one block, even of no rays
    parts = [_Part.of(field, flat, some, (entry, leave), search, passing) for some in blocks]
    whole = _Part(*(torch.cat(part) for part in zip(*(vars(part).values() for part in parts), strict=True)))
    inside = whole.begun_inside
    hit = (whole.opacity.detach() > SEEN) & ~inside
    seen = hit.nonzero().squeeze(-1)
    status = torch.full_like(inside, Status.MISS, dtype=torch.int8)
    status = status.masked_fill(inside, Status.STARTED_INSIDE).masked_fill(hit, Status.HIT)
    ended = torch.where(hit, whole.mean, torch.where(inside, entry[queried], leave[queried]))
    least = whole.least.index_put(
        (seen,), reevaluate_with_graph(field, flat[queried[seen]], whole.least_distance[seen], whole.least[seen])
    )
    rendering = assemble(
        rays,
        radius,
        distance=torch.where(meets, entry, leave).index_put((queried,), ended),
        status=torch.full_like(meets, Status.MISS, dtype=torch.int8).index_put((queried,), status),
        residual=torch.zeros_like(entry).index_put((queried,), torch.where(hit, whole.residual, whole.least)),
        closest=(queried, least),
    )
    left_out = torch.zeros_like(meets).index_put((queried,), ~hit)
    deferred = Deferred(leave.index_put((queried,), whole.least_distance).view(rays.shape), left_out.view(rays.shape))
    volume = Volume(whole.ray, whole.distance, whole.weight)
    return replace(rendering, deferred=deferred, volume=volume)


@dataclass(frozen=True, kw_only=True)
class VolumeRenderer(ABC):
    """What renderers share that see through a volume.

    Args:
        sharpening: iterations in which the first blur becomes the last one, by equal factors.
        mask_weight: of the mask loss.
        sphere_radius: of the sphere about the origin that holds the shape.
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
        """The mean cross entropy of opacities and a mask (NeuS, Sec. 3.2); the other papers have no masks."""
        opacity = rendering.opacity.clamp(LEAST_OPACITY, 1 - LEAST_OPACITY)
        entropy = -torch.where(mask, opacity, 1 - opacity).log().sum() / max(mask.numel(), 1)
        return self.mask_weight * entropy


@dataclass(frozen=True)
class _Part:
    """Of n rays, one number each: opacity, mean distance, the field there, the sample of least magnitude.

    `ray`, `distance`, `weight` are those of the samples that have a part, of all the rays in one row.
    """

    opacity: Float[Tensor, " n"]
    mean: Float[Tensor, " n"]
    residual: Float[Tensor, " n"]
    least: Float[Tensor, " n"]
    least_distance: Float[Tensor, " n"]
    begun_inside: Bool[Tensor, " n"]
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
        passing: Passing,
    ) -> "_Part":
        """Searches, and sums, along the rays at `index`."""
        some, (entry, leave) = rays[index], (part[index] for part in span)
        with torch.no_grad():
            samples = search(field, some, entry, leave)
            value, distance = samples.value, samples.distance
            place = value.abs().argmin(dim=1, keepdim=True)
        found = weights(passing(_with_graph(field, some, samples, passing), distance))
        if found.shape[1] < distance.shape[1]:
            distance = (distance[:, 1:] + distance[:, :-1]) / 2
        opacity = found.sum(dim=1)
        main = found * _around_middle(found.detach(), value)
        mean = (main * distance).sum(dim=1) / main.sum(dim=1).clamp_min(FAINT)
        row, column = (found.detach() > FAINT).nonzero(as_tuple=True)
        return _Part(
            opacity,
            mean,
            _between(samples, mean.detach()),
            value.gather(1, place).squeeze(1),
            samples.distance.gather(1, place).squeeze(1),
            value[:, 0] < 0,
            index[row],
            distance[row, column],
            found[row, column],
        )


def _with_graph(field: Field, rays: Rays, samples: Samples, passing: Passing) -> Float[Tensor, "n samples"]:
    """The samples' values, with a graph where the weights depend on them by more than `FAINT`."""
    wanted = rays.origins.requires_grad or rays.directions.requires_grad or carries_gradient(field, rays.origins)
    if not (torch.is_grad_enabled() and wanted):
        return samples.value
    with torch.no_grad():
        logs = passing(samples.value, samples.distance)
        needed = (_before(logs) > log(FAINT)) & (-torch.expm1(logs) > FAINT)
        if needed.shape[1] < samples.value.shape[1]:  # of an interval both ends
            pad = torch.nn.functional.pad
            needed = pad(needed, (0, 1)) | pad(needed, (1, 0))
    row, column = needed.nonzero(as_tuple=True)
    values = _finite(field(rays[row].at(samples.distance[row, column])))
    return samples.value.index_put((row, column), values)


def _around_middle(weight: Float[Tensor, "n k"], value: Float[Tensor, "n samples"]) -> Bool[Tensor, "n k"]:
    """The samples of the surface at which half of the light has stayed.

    Between two surfaces the field, still positive, turns from rising to falling.
    """
    passed = weight.cumsum(dim=1)
    middle = (passed < passed[:, -1:] / 2).sum(dim=1, keepdim=True).clamp_max(weight.shape[1] - 1)
    step = value[:, 1:] - value[:, :-1]
    moves = step.abs() > RISE
    last = torch.where(moves, torch.arange(step.shape[1], device=step.device), 0).cummax(dim=1)[0]  # that moved
    rising = (step.gather(1, last) > RISE)[:, :-1]
    turns = rising & (step[:, 1:] < -RISE) & (value[:, 1:-1] > 0)
    group = torch.nn.functional.pad(turns, (1, 1)).cumsum(dim=1)[:, : weight.shape[1]]
    return group == group.gather(1, middle)


def _finite(values: Tensor) -> Tensor:
    return torch.where(values.isfinite(), values, 1.0)


def _before(passing: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """The logarithm of the share of light that has passed all before each sample."""
    return passing.cumsum(dim=1) - passing


def _between(samples: Samples, distance: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """The field at a distance along each ray, on the line between the samples beside it."""
    last = samples.distance.shape[1] - 1
    after = torch.searchsorted(samples.distance, distance[:, None]).clamp(1, last)
    near, far, low, high = (
        table.gather(1, place).squeeze(1) for table in (samples.distance, samples.value) for place in (after - 1, after)
    )
    part = (distance - near) / (far - near).clamp_min(torch.finfo(near.dtype).tiny)
    return low + part.clamp(0, 1) * (high - low)
