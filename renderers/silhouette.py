"""Silhouette losses for the rendering of any renderer, so that all renderers can use the same loss.

`Own` is the renderer's own loss. `Hinge` and `CrossEntropy` use `closest`, whose gradient the renderer gives; the hinge
uses it only on wrong rays. `Occupancy` evaluates the field at new points. `Area` needs opacities.
On a hit, the `closest` of `naive` follows the surface, so that its spurious hits are hardly pushed away.
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
from renderers.rendering import (
    DISTANCE_CAPABILITIES,
    Capabilities,
    RayObservation,
    Renderer,
    Rendering,
    Unsupported,
    closest_values,
)

RANDOM, DEPTH = "random", "depth"
OCCUPANCY_POINTS = (RANDOM, DEPTH)  # choices of `occupied_at`; see `Occupancy`
AVERAGES = ("all", "violating", "missed_plus_spurious")  # see `Hinge`
CLOSEST_VALUES_CARRY = "its closest field values carry"  # begins a message: "... no gradient"


@runtime_checkable
class SilhouetteLoss(Protocol):
    """A loss between a rendering and an observation: a binary mask, perhaps with distances."""

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        """The loss.

        Args:
            renderer, field, rays: `rendering` is the renderer's, of this field along these rays.
            observed: the mask and the observed distances.
        """
        ...


@dataclass(frozen=True)
class Own:
    """The renderer's own silhouette loss, checked by `boundary.silhouette_loss`."""

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        return boundary.silhouette_loss(renderer, field, rays, rendering, observed)


@dataclass(frozen=True)
class Hinge:
    """DIST, Eq. 11: the soft silhouette should be at most 0 on the foreground and at least 0 on the background.

    Args:
        epsilon: the threshold between them, in scene units.
        signed: False takes the magnitude of `closest`, as the paper does. A background ray that stops just inside the
            shape is then pushed deeper. True keeps the sign, which avoids that.
        average: the mean over "all" rays, or over "violating" rays. "missed_plus_spurious" is the mean over violating
            foreground rays plus the mean over violating background rays. The official code has this sum, but also
            counts missed pixels with a violation of 0. With "all", a missed pixel has almost no weight, and an
            optimiser can lower the depth loss by losing hits.
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
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        loss = self.of_rendering(field, rays, rendering, observed.mask)
        boundary.check_loss_gradient(renderer, field, rays, loss, CLOSEST_VALUES_CARRY)
        return loss

    def of_rendering(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """The loss of a rendering. A hit has no loss on the foreground, and a positive loss on the background.

        Hits of volume renderers and meshes may have a `closest` value above `epsilon`. On the background such a hit
        counts as a value of 0: its violation is `epsilon`.
        """
        violates = self.violation(rendering.closest, mask) > 0
        zero_loss_hits = rendering.hit & ~mask & ~violates
        wrong = zero_loss_hits | (violates & ~(rendering.hit & mask))
        excess = self._excess(closest_values(field, rays, rendering, wrong), mask)
        excess = torch.where(zero_loss_hits, excess - excess.detach() + self.epsilon, excess)
        return self._mean(torch.where(wrong, excess, 0.0), mask)

    def of(self, closest: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        """The loss for the field's value of smallest magnitude on each ray, with its sign."""
        return self._mean(self.violation(closest, mask), mask)

    def violation(self, closest: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
        """By how much the soft silhouette is on the wrong side of 0; 0 on the right side."""
        return self._excess(closest, mask).clamp_min(0)

    def _excess(self, closest: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
        """The violation before clamping: negative on the right side."""
        soft = (closest if self.signed else closest.abs()) - self.epsilon
        return torch.where(mask, soft, -soft)

    def _mean(self, violation: Float[Tensor, "*rays"], mask: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        if self.average == "missed_plus_spurious":
            return self._mean_over(violation, mask) + self._mean_over(violation, ~mask)
        if self.average == "violating":
            return self._mean_over(violation, torch.ones_like(mask))
        return self.weight * violation.sum() / max(violation.numel(), 1)

    def _mean_over(self, violation: Float[Tensor, "*rays"], rays: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        """The weighted mean over the violating ones of the rays."""
        return self.weight * (violation * rays).sum() / ((violation > 0) & rays).sum().clamp_min(1)


@dataclass(frozen=True)
class CrossEntropy:
    """IDR, Sec. 3.3: cross entropy of a sigmoid of the smallest field value, over all rays except correct hits.

    Args:
        sharpness: of the sigmoid, per scene unit; the paper begins at 50 and doubles it.
        weight: rho in the paper, which uses 100.
    """

    sharpness: float
    weight: float

    def __post_init__(self) -> None:
        check_positive("sharpness", self.sharpness, "the paper begins at 50")
        check_at_least("weight", self.weight, 0, "the paper uses 100")

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        wanted = ~(observed.mask & rendering.hit)
        loss = self.of(replace(rendering, closest=closest_values(field, rays, rendering, wanted)), observed.mask)
        boundary.check_loss_gradient(renderer, field, rays, loss, CLOSEST_VALUES_CARRY)
        return loss

    def of(self, rendering: Rendering, mask: Bool[Tensor, "*rays"]) -> Float[Tensor, ""]:
        """The loss of a rendering."""
        logits = -self.sharpness * rendering.closest
        entropy = softplus(torch.where(mask, -logits, logits))
        total = (entropy * ~(mask & rendering.hit)).sum()
        return self.weight * total / (self.sharpness * max(mask.numel(), 1))


@dataclass(frozen=True)
class Area:
    """The mean squared difference between a pixel's opacity and the fraction of it on the foreground.

    The opacity is the mean over the pixel's rays (Wang et al. 2024, Sec. 3). With one ray per pixel, the fraction is 0
    or 1, and a renderer of surfaces has no gradient on rays inside of the outline.

    Args:
        weight: of the loss.
    """

    weight: float

    def __post_init__(self) -> None:
        check_at_least("weight", self.weight, 0, "0 switches the loss off")

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        if rendering.volume is None:
            name = type(renderer).__name__
            raise Unsupported(
                f"{name} has no opacity with a gradient, which silhouette=area needs: take silhouette=own, or "
                "renderer=edge_sampling, relaxed_boundary, neus, opaque, volsdf or unisurf"
            )
        if observed.covered is None:
            return self.weight * (rendering.opacity - observed.mask.to(rays.origins.dtype)).square().mean()
        return self.weight * (rendering.opacity.mean(-1) - observed.covered).square().mean()


@dataclass(frozen=True)
class AreaOrOther:
    """`Area` for a rendering with opacities that have a gradient, another loss for any other rendering."""

    area: Area
    other: SilhouetteLoss

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        loss = self.other if rendering.volume is None else self.area
        return loss(renderer, field, rays, rendering, observed)


@dataclass(frozen=True, kw_only=True)
class SurfaceRenderer(ABC):
    """The base of renderers whose hits have the exact gradient, and whose mask loss is IDR's.

    Args:
        least_slope: see `gradients.attach_implicit_gradient`.
        mask_sharpness, mask_weight: of the mask loss; see `CrossEntropy`.
        sphere_radius: of the sphere about the origin that contains the shape.
    """

    least_slope: float = 1e-3
    mask_sharpness: float = 50.0
    mask_weight: float = 100.0
    sphere_radius: float = 1.0

    capabilities: ClassVar[Capabilities] = DISTANCE_CAPABILITIES

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
        """IDR's cross entropy; see `CrossEntropy`."""
        return CrossEntropy(self.mask_sharpness, self.mask_weight).of(rendering, mask)


@dataclass(frozen=True)
class Occupancy:
    """DVR, Eqs. 14 and 15, summed and divided by the number of rays.

    On a background ray, the hit, or a random point if there is no hit, should be free (L_freespace). On a foreground
    ray without a hit, one point should be occupied (L_occupancy). Random points are uniform, from PyTorch's default
    generator. Points where the field is not finite do not count.

    Args:
        width: length in scene units over which a distance turns from occupied to free; see `field.occupancy_logits`.
            Occupancy networks do not use it.
        weight: of both terms; 1 as in the paper's equations.
        sphere_radius: of the sphere about the origin on whose chords random points lie.
        occupied_at: the point of L_occupancy. "random": a random point, as in Eq. 15. "depth": at the observed
            distance, if the ray has one within the sphere, as in the paper's depth supervision; random on other rays.
            For the paper's third choice, the depth of the visual hull, a task passes that as the observed distance.
    """

    width: float
    weight: float
    sphere_radius: float
    occupied_at: str

    def __post_init__(self) -> None:
        check_positive("width", self.width, "0.02 suits distances in the unit sphere")
        check_at_least("weight", self.weight, 0, "1 keeps the paper's equations")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")
        check_choice("occupied_at", self.occupied_at, OCCUPANCY_POINTS)

    def __call__(
        self, renderer: Renderer, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        flat, hit, foreground = rays.flat(), rendering.hit.flatten(), observed.mask.flatten()
        entry, leave, intersects = (tensor.detach() for tensor in sphere_span(flat, self.sphere_radius))
        distance = entry + torch.rand_like(entry) * (leave - entry)
        if self.occupied_at == DEPTH and observed.distance is not None:
            depth = observed.distance.detach().flatten()
            distance = torch.where(foreground & (depth >= entry) & (depth <= leave), depth, distance)
        distance = torch.where(hit, rendering.distance.detach().flatten(), distance)
        compared = intersects & ~(foreground & hit)
        values = field(flat[compared].at(distance[compared]))
        finite = values.isfinite()
        logits = occupancy_logits(field, values[finite], width=self.width)
        total = softplus(torch.where(foreground[compared][finite], -logits, logits)).sum()
        return self.weight * total / max(foreground.numel(), 1)
