"""Silhouette losses: of each paper one, for the rendering of any renderer, so that renderers can be compared under one.

`Own` is the renderer's own. The other three are made of what every renderer gives: `hit`, `distance` and `closest`.
Their gradient is that of the renderer's `closest`, which the hinge asks for only on rays that are wrong: on a hit, that
of `naive` follows the surface, so that its spurious hits are hardly pushed away.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import softplus

from renderers import boundary
from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Field, occupancy_logits
from renderers.rendering import OF_LENGTHS, Capabilities, Observed, Renderer, Rendering, closest_values

RANDOM, DEPTH = "random", "depth"  # where L_occupancy is; see `Occupancy`
PLACES = (RANDOM, DEPTH)
AVERAGES = ("all", "violating", "missed_plus_spurious")  # over which rays `Hinge` averages
CLOSEST = "its closest field values carry"  # what a loss is made of, in the message where they carry no gradient


@runtime_checkable
class SilhouetteLoss(Protocol):
    """A loss between a rendering and a binary mask, or what else is observed of its rays."""

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: Observed
    ) -> Float[Tensor, ""]:
        """The loss.

        Args:
            renderer, field, rays: of which `rendering` is the outcome.
            observed: the mask, and the distances that are given.
        """
        ...


@dataclass(frozen=True)
class Own:
    """The renderer's own silhouette loss, checked by `boundary.silhouette_loss`."""

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: Observed
    ) -> Float[Tensor, ""]:
        return boundary.silhouette_loss(renderer, field, rays, rendering, observed)


@dataclass(frozen=True)
class Hinge:
    """DIST, Eq. 11: the soft silhouette should be at most 0 on the foreground and at least 0 on the background.

    Args:
        epsilon: the threshold between them, in scene units.
        signed: False takes the magnitude of `closest`, as the paper does. A background ray that stops just inside the
            shape is then pushed deeper. True keeps the sign, which avoids that.
        average: the mean over "all" rays, or over "violating" ones. With "missed_plus_spurious" it is the mean over
            violating rays of the foreground plus that over violating rays of the background. The official code has this
            sum, but counts missed pixels whose violation is 0 as well. With "all", a missed pixel weighs next to
            nothing, and an optimiser can lower the depth loss by losing hits.
        weight: of the loss.
    """

    epsilon: float
    signed: bool
    average: str
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_positive("epsilon", self.epsilon, "the paper uses 5e-5")
        check_choice("average", self.average, AVERAGES)
        check_at_least("weight", self.weight, 0, "0 switches the loss off")

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: Observed
    ) -> Float[Tensor, ""]:
        loss = self.of_rendering(field, rays, rendering, observed.mask)
        boundary.check_loss_gradient(renderer, field, rays, loss, CLOSEST)
        return loss

    def of_rendering(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """The loss of a rendering; a hit is right on the foreground and wrong on the background, whatever its value.

        Volume renderers and meshes hit where the least value that they know is larger than `epsilon`. On the background
        such a hit is off by `epsilon`, as one whose value is 0.
        """
        violates = self.violation(rendering.closest, mask) > 0
        silent = rendering.hit & ~mask & ~violates
        wrong = silent | (violates & ~(rendering.hit & mask))
        excess = self._excess(closest_values(field, rays, rendering, wrong), mask)
        excess = torch.where(silent, excess - excess.detach() + self.epsilon, excess)
        return self._mean(torch.where(wrong, excess, 0.0), mask)

    def of(self, closest: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        """The loss of the field's values of least magnitude on each ray, with their sign."""
        return self._mean(self.violation(closest, mask), mask)

    def violation(self, closest: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
        """By how much the soft silhouette is on the wrong side; 0 where it is on the right one."""
        return self._excess(closest, mask).clamp_min(0)

    def _excess(self, closest: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
        """The violation, which is negative on the right side."""
        soft = (closest if self.signed else closest.abs()) - self.epsilon
        return torch.where(mask, soft, -soft)

    def _mean(self, violation: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        if self.average == "missed_plus_spurious":
            return self._mean_over(violation, mask) + self._mean_over(violation, ~mask)
        if self.average == "violating":
            return self._mean_over(violation, torch.ones_like(mask))
        return self.weight * violation.sum() / max(violation.numel(), 1)

    def _mean_over(self, violation: Float[Tensor, "*rays"], rays: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        """The weighted mean over those of the rays that violate the mask."""
        return self.weight * (violation * rays).sum() / ((violation > 0) & rays).sum().clamp_min(1)


@dataclass(frozen=True)
class CrossEntropy:
    """IDR, Sec. 3.3: cross entropy of a sigmoid of the least field value, over all rays but correct hits.

    Args:
        sharpness: of the sigmoid, for a length of one scene unit; the paper begins at 50 and doubles it.
        weight: rho in the paper, which takes 100.
    """

    sharpness: float
    weight: float

    def __post_init__(self) -> None:
        check_positive("sharpness", self.sharpness, "the paper begins at 50")
        check_at_least("weight", self.weight, 0, "the paper uses 100")

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: Observed
    ) -> Float[Tensor, ""]:
        wanted = ~(observed.mask & rendering.hit)
        loss = self.of(replace(rendering, closest=closest_values(field, rays, rendering, wanted)), observed.mask)
        boundary.check_loss_gradient(renderer, field, rays, loss, CLOSEST)
        return loss

    def of(self, rendering: Rendering, mask: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        """The loss of a rendering."""
        logits = -self.sharpness * rendering.closest
        entropy = softplus(torch.where(mask, -logits, logits))
        total = (entropy * ~(mask & rendering.hit)).sum()
        return self.weight * total / (self.sharpness * max(mask.numel(), 1))


@dataclass(frozen=True, kw_only=True)
class SurfaceRenderer(ABC):
    """What renderers share whose hits have the exact gradient, and whose mask loss is IDR's.

    Args:
        least_slope: see `gradients.implicit`.
        mask_sharpness, mask_weight: of the mask loss; see `CrossEntropy`.
        sphere_radius: of the sphere about the origin that holds the shape.
    """

    least_slope: float
    mask_sharpness: float
    mask_weight: float
    sphere_radius: float

    capabilities: ClassVar[Capabilities] = OF_LENGTHS

    def __post_init__(self) -> None:
        check_positive("least_slope", self.least_slope, "1e-3 leaves all but the most grazing rays as they are")
        check_positive("mask_sharpness", self.mask_sharpness, "the paper of IDR begins at 50")
        check_at_least("mask_weight", self.mask_weight, 0, "the paper of IDR uses 100")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")

    @abstractmethod
    def render(self, field: Field, rays: Rays) -> Rendering:
        """See `Renderer`."""

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """Cross entropy of a sigmoid of the least field value (IDR, Sec. 3.3); see `CrossEntropy`."""
        return CrossEntropy(self.mask_sharpness, self.mask_weight).of(rendering, mask)


@dataclass(frozen=True)
class Occupancy:
    """DVR, Eqs. 14 and 15, summed and divided by the number of rays.

    On the background, the hit or else a point drawn on the ray should be free (L_freespace); on the foreground without
    a hit, a point of the ray should be occupied (L_occupancy). Points are drawn evenly, from PyTorch's own generator.
    A point where the field is not finite has no part in the loss.

    Args:
        width: length in scene units over which a distance turns from occupied to free; see `field.occupancy_logits`.
            Occupancy networks do not use it.
        weight: of both terms; 1 leaves them as the paper's equations have them.
        sphere_radius: of the sphere about the origin on whose chords points are drawn.
        occupied_at: the point of L_occupancy. "random": drawn, as in Eq. 15. "depth": at the observed distance, where
            the ray has one within the sphere, as the paper does with depth supervision; drawn on other rays. The
            paper's third, the depth of the visual hull, is such a distance where a task gives it.
    """

    width: float
    weight: float
    sphere_radius: float
    occupied_at: str

    def __post_init__(self) -> None:
        check_positive("width", self.width, "0.02 suits distances in the unit sphere")
        check_at_least("weight", self.weight, 0, "1 keeps the paper's equations")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")
        check_choice("occupied_at", self.occupied_at, PLACES)

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: Observed
    ) -> Float[Tensor, ""]:
        return self.of(field, rays, rendering, observed)

    def of(self, field: Field, rays: Rays, rendering: Rendering, observed: Observed) -> Float[Tensor, ""]:
        """The loss of a rendering of the field along the rays."""
        flat, hit, wanted = rays.flat(), rendering.hit.flatten(), observed.mask.flatten()
        entry, leave, meets = (part.detach() for part in sphere_span(flat, self.sphere_radius))
        place = entry + torch.rand_like(entry) * (leave - entry)
        if self.occupied_at == DEPTH and observed.distance is not None:
            given = observed.distance.detach().flatten()
            place = torch.where(wanted & (given >= entry) & (given <= leave), given, place)
        distance = torch.where(hit, rendering.distance.detach().flatten(), place)
        judged = meets & ~(wanted & hit)
        values = field(flat[judged].at(distance[judged]))
        finite = values.isfinite()
        logits = occupancy_logits(field, values[finite], width=self.width)
        total = softplus(torch.where(wanted[judged][finite], -logits, logits)).sum()
        return self.weight * total / max(wanted.numel(), 1)
