"""The error of a field on held-out rays, without the ground truth."""

from dataclasses import dataclass, replace
from math import inf

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.boundary import render_checked
from renderers.camera import Rays
from renderers.field import Field, autograd_normals
from renderers.rendering import Renderer

MISSED_FOOTPRINTS = 10.0  # largest error, and the error of a ray on which only the field or the observation hits


@dataclass(frozen=True)
class HeldOutError:
    """The error over held-out rays, and its standard error.

    If field and observation both hit, the error of a ray is the distance between the two points along the field's
    normal, at most `MISSED_FOOTPRINTS` footprints. If only one of them hits, it is `MISSED_FOOTPRINTS` footprints. The
    mean is over all rays on which at least one hits.

    Args:
        sums: per group of rays: errors of hits; counts of hits with an observed distance, of rays on which only one
            hits, and of rays on which at least one hits.
        missed: error of a ray on which only one hits, in scene units.
    """

    sums: Float[np.ndarray, "groups 4"]
    missed: float

    @property
    def mean(self) -> float:
        return float(_means(self.sums.sum(0, keepdims=True), self.missed)[0])

    @property
    def standard_error(self) -> float:
        """The standard error of the mean, by the jackknife over groups (Efron and Tibshirani 1993).

        Rays of a group are not independent. A held-out view is one group, as are the held-out rays of a fitted view.
        """
        return _jackknife(self._without_each())

    def noise_of_difference(self, other: "HeldOutError") -> float:
        """The standard error of the difference of the two means, over the same groups."""
        return _jackknife(self._without_each() - other._without_each())

    def select(self, groups: Int[np.ndarray, " n"]) -> "HeldOutError":
        return HeldOutError(self.sums[groups], self.missed)

    def _without_each(self) -> Float[np.ndarray, " groups"]:
        return _means(self.sums.sum(0) - self.sums, self.missed)


@dataclass(frozen=True)
class HeldOut:
    """Held-out rays and their observations.

    Args:
        rays: in one row.
        distance: along the ray, if `observed`.
        observed: whether the distance is observed.
        mask: whether the ray hits.
        group: index of the ray's group, from 0: a view, or a part of a view.
        footprint: half a pixel, in scene units.
    """

    rays: Rays
    distance: Float[Tensor, " n"]
    observed: Bool[Tensor, " n"]
    mask: Bool[Tensor, " n"]
    group: Int[Tensor, " n"]
    footprint: float

    def thinned(self, per_group: int, seed: int) -> "HeldOut":
        """At most `per_group` random rays of each group, in their order."""
        order = torch.randperm(len(self.group), generator=torch.Generator().manual_seed(seed)).to(self.group.device)
        by_group = order[self.group[order].argsort(stable=True)]
        counts = torch.bincount(self.group)
        rank = torch.arange(len(order), device=order.device) - (counts.cumsum(0) - counts)[self.group[by_group]]
        kept = by_group[rank < per_group].sort().values
        tensors = {name: getattr(self, name)[kept] for name in ("distance", "observed", "mask", "group")}
        return replace(self, rays=self.rays[kept], **tensors)

    @torch.no_grad()
    def error(self, field: Field, renderer: Renderer) -> HeldOutError:
        missed = MISSED_FOOTPRINTS * self.footprint
        rendering = render_checked(renderer, field, self.rays)
        compared = rendering.hit & self.observed
        errors = torch.zeros_like(self.distance)
        normals = autograd_normals(field, rendering.points[compared])
        has_no_normal = torch.linalg.vector_norm(normals, dim=-1) < 0.5  # then the distance along the ray counts
        cosine = torch.where(has_no_normal, 1.0, (normals * self.rays.directions[compared]).sum(-1).abs())
        errors[compared] = ((rendering.distance - self.distance)[compared].abs() * cosine).clamp_max(missed)
        columns = [errors, compared, rendering.hit ^ self.mask, rendering.hit | self.mask]
        sums = [torch.bincount(self.group, column.double()) for column in columns]
        return HeldOutError(torch.stack(sums, dim=1).cpu().numpy(), missed)


def _means(sums: Float[np.ndarray, "n 4"], missed: float) -> Float[np.ndarray, " n"]:
    """The mean errors of hits and of misses, weighted by their fractions of the rays on which at least one hits."""
    errors, hits, disagreeing, rays = sums.T
    fraction = disagreeing / np.maximum(rays, 1)
    hit_error = np.where(hits > 0, errors / np.maximum(hits, 1), missed)  # without hits the largest error
    return (1 - fraction) * hit_error + fraction * missed


def _jackknife(values: Float[np.ndarray, " groups"]) -> float:
    count = len(values)
    return float(np.sqrt((count - 1) / count * np.square(values - values.mean()).sum())) if count > 1 else inf
