"""How far a field is from what it was not fitted to: rays that were held out, never the true geometry."""

from dataclasses import dataclass
from math import inf

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field, autograd_normals
from renderers.rendering import Renderer

MISSED = 10.0  # footprints: the error of a ray that only one of field and observation hits, and the most that one has


@dataclass(frozen=True)
class HeldOutError:
    """The error over held-out rays, with what is needed to say how sure it is.

    The error of a ray that hits, and was seen to, is the distance between the two points along the field's normal; at
    most `MISSED` footprints. Where only one of the two hits it is that. The mean is over all rays on which either hits.

    Args:
        sums: of each group of rays: errors of hits, hits with a known distance, rays on which one hits, and either.
        missed: error of a ray on which only one hits, in scene units.
    """

    sums: Float[np.ndarray, "groups 4"]
    missed: float

    @property
    def mean(self) -> float:
        """In scene units."""
        return float(_means(self.sums.sum(0, keepdims=True), self.missed)[0])

    @property
    def standard_error(self) -> float:
        """Of the mean, by the jackknife over groups, whose rays are not independent (Efron and Tibshirani 1993).

        Groups count alike, whole views and what is held out of fitted ones.
        """
        return _jackknife(self._without_each())

    def noise_of_difference(self, other: "HeldOutError") -> float:
        """The standard error of the difference of the two means, over the same groups."""
        return _jackknife(self._without_each() - other._without_each())

    def some(self, groups: Int[np.ndarray, " n"]) -> "HeldOutError":
        """The error of some of the groups."""
        return HeldOutError(self.sums[groups], self.missed)

    def _without_each(self) -> Float[np.ndarray, " groups"]:
        return _means(self.sums.sum(0) - self.sums, self.missed)


@dataclass(frozen=True)
class HeldOut:
    """Held-out rays, and what is known of them.

    Args:
        rays: in a row.
        distance: along the ray, where `observed`.
        observed: whether the distance is known.
        mask: whether the ray hits.
        group: which group a ray belongs to, from 0: a view, or a part of one.
        footprint: half a pixel, in scene units.
    """

    rays: Rays
    distance: Float[Tensor, " n"]
    observed: Bool[Tensor, " n"]
    mask: Bool[Tensor, " n"]
    group: Int[Tensor, " n"]
    footprint: float

    @torch.no_grad()
    def error(self, field: Field, renderer: Renderer) -> HeldOutError:
        """The error of a field through a renderer."""
        missed = MISSED * self.footprint
        rendering = renderer.render(field, self.rays)
        compared = rendering.hit & self.observed
        apart = torch.zeros_like(self.distance)
        normals = autograd_normals(field, rendering.points[compared])
        flat = torch.linalg.vector_norm(normals, dim=-1) < 0.5  # no normal: the distance along the ray counts
        cosine = torch.where(flat, 1.0, (normals * self.rays.directions[compared]).sum(-1).abs())
        apart[compared] = ((rendering.distance - self.distance)[compared].abs() * cosine).clamp_max(missed)
        parts = [apart, compared, rendering.hit ^ self.mask, rendering.hit | self.mask]
        sums = [torch.bincount(self.group, part.double()) for part in parts]
        return HeldOutError(torch.stack(sums, dim=1).cpu().numpy(), missed)


def _means(sums: Float[np.ndarray, "n 4"], missed: float) -> Float[np.ndarray, " n"]:
    """Errors of hits and of misses, each by its share of the rays on which either hits."""
    errors, hits, disagree, either = sums.T
    share = disagree / np.maximum(either, 1)
    of_hits = np.where(hits > 0, errors / np.maximum(hits, 1), missed)  # where no known distance is hit, all is wrong
    return (1 - share) * of_hits + share * missed


def _jackknife(values: Float[np.ndarray, " groups"]) -> float:
    count = len(values)
    return float(np.sqrt((count - 1) / count * np.square(values - values.mean()).sum())) if count > 1 else inf
