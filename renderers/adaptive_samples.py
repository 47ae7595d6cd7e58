"""A renderer whose number of samples follows the thinnest part of the shape: `renderer.n_ray_samples=auto`."""

from dataclasses import dataclass, field, replace
from math import ceil, inf, log2
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.boundary import rendered, silhouette_loss
from renderers.bracket import first_crossing, refine
from renderers.camera import Rays
from renderers.field import Field, autograd_normals
from renderers.rendering import Capabilities, Observed, Renderer, Rendering, Spaced, at_iteration

FEWEST, MOST = 16, 128  # samples per ray: the range of DVR, Sec. 3.5
HITS = 128  # most hits of a rendering at which the thickness is measured
SHARE = 0.05  # of these hits that may be thinner: at a sharp edge the thickness falls to zero


@dataclass
class Seen:
    """The thinnest part measured so far, in scene units; infinite before the first rendering."""

    thinnest: float = inf


@dataclass(frozen=True)
class Following:
    """A renderer with enough samples to put two into the thinnest part measured so far; see `samples`.

    During an optimisation, that is as `at_iteration` gives it, it measures the shape after each rendering. Renderings
    for evaluation and pictures use the current number and change nothing, so that pictures do not change a run. A part
    that no ray has hit cannot be measured: what all 16 samples of all rays miss stays missed.

    Args:
        inner: the renderer whose number of samples is set.
        seen: shared by the renderers of all iterations.
        measures: whether the shape is measured after each rendering.
    """

    inner: Spaced
    seen: Seen = field(default_factory=Seen)
    measures: bool = False

    @property
    def capabilities(self) -> Capabilities:
        """Those of the inner renderer."""
        return self.inner.capabilities

    @property
    def n_ray_samples(self) -> int:
        """The current number of samples."""
        return samples(self.seen.thinnest, self.inner.sphere_radius)

    def current(self) -> Spaced:
        """The inner renderer with the current number of samples."""
        return self.inner.with_samples(self.n_ray_samples)

    def at_iteration(self, iteration: int) -> "Following":
        """This renderer for an iteration of an optimisation: it measures the shape after each rendering.

        Iteration 0 begins another optimisation and forgets the thickness: one run may have several.
        """
        if iteration == 0:
            self.seen.thinnest = inf
        return replace(self, inner=cast(Spaced, at_iteration(self.inner, iteration)), measures=True)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Renders with the current number of samples, then measures the thickness with values of the same field."""
        rendering = rendered(self.current(), field, rays)
        if self.measures:
            found = thinnest(field, rendering, radius=self.inner.sphere_radius)
            self.seen.thinnest = min(self.seen.thinnest, found)
        return rendering

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """That of the inner renderer."""
        return self.observed_loss(field, rays, rendering, Observed(mask))

    def observed_loss(self, field: Field, rays: Rays, rendering: Rendering, observed: Observed) -> Float[Tensor, ""]:
        """That of the inner renderer."""
        return silhouette_loss(self.current(), field, rays, rendering, observed)

    def fresh(self) -> "Following":
        """For another optimisation: nothing is measured yet."""
        return replace(self, seen=Seen())

    def final_notes(self) -> list[str]:
        """The final number of samples; none before a shape was seen."""
        if self.seen.thinnest == inf:
            return []
        part = f"a part {self.seen.thinnest:.3g} scene units thick"
        return [f"renderer.n_ray_samples=auto ends with {self.n_ray_samples}, for {part}"]

    def at_max_samples(self) -> Spaced:
        """The inner renderer with the largest number of samples."""
        return self.inner.with_samples(MOST)


def samples(thinnest: float, radius: float) -> int:
    """The least n that puts two samples into the thinnest part: 2 R / (n - 1) <= thinnest / 2, within DVR's range.

    2 R / (n - 1) is the spacing on the longest chord of the sphere (DVR, Eq. 9), so that on no ray it is wider.

    Args:
        thinnest: thickness of the thinnest part, in scene units; infinite where none is known.
        radius: R, of the sphere that the samples lie in, in scene units.
    """
    wanted = ceil(min(4 * radius / thinnest, MOST)) + 1
    return min(max(wanted, FEWEST), MOST)


def follow(renderer: Renderer) -> Following:
    """The renderer with samples that follow the shape.

    Raises:
        ValueError: where its samples are not spaced along the ray.
    """
    if isinstance(renderer, Spaced):
        return Following(renderer)
    raise ValueError(
        "renderer.n_ray_samples=auto is for samples spaced along the ray (DVR, Eq. 9), and "
        f"{type(renderer).__name__} has no with_samples that sets them: give a number"
    )


def at_max_samples(renderer: Renderer) -> Renderer:
    """The renderer for evaluating different fields alike: with most samples, where their number follows the shape."""
    return renderer.at_max_samples() if isinstance(renderer, Following) else renderer


def thinnest(field: Field, rendering: Rendering, *, radius: float) -> float:
    """The thickness that all but the thinnest `SHARE` of the hits have, in scene units; infinite without a hit.

    It is measured at no more than `HITS` hits, evenly spread over the rays, the same ones each time.
    """
    hits = rendering.points.detach()[rendering.hit]
    if not len(hits):
        return inf
    chosen = torch.linspace(0, len(hits) - 1, min(len(hits), HITS), device=hits.device).round().long()
    found = thickness(field, hits[chosen], radius=radius).sort().values
    return float(found[int(SHARE * len(found))])


@torch.no_grad()
def thickness(field: Field, hits: Float[Tensor, "n 3"], *, radius: float) -> Float[Tensor, " n"]:
    """How thick the shape is behind points of its surface, in scene units: the chord along the inward normal.

    That is what a ray at normal incidence crosses, and bounded away from zero on a smooth shape: 2 r on a sphere of
    radius r. The chord along the ray falls to zero at every outline, where any n misses some; through a plate it grows
    as the ray gets flatter, and multiplied by the cosine it falls to zero even faster at a sphere's outline.

    Args:
        field: negative inside. A hit costs a value and a gradient for its normal, and the 15 values of `first_exit`.
        hits: n points.
        radius: of the sphere that holds the shape, in scene units.

    Returns:
        the thicknesses; infinite where the shape does not end within the diameter, or the field's gradient vanishes.
    """
    normal = autograd_normals(field, hits)
    steep = torch.linalg.vector_norm(normal, dim=-1) > 0.5
    exits = first_exit(field, Rays(hits[steep], -normal[steep]), radius=radius)
    return torch.full_like(hits[:, 0], inf).masked_scatter(steep, exits)


def first_exit(field: Field, rays: Rays, *, radius: float) -> Float[Tensor, " n"]:
    """Where n rays that begin on the surface, inward, first leave the shape, in scene units; infinite where nowhere.

    The field is evaluated at distances that rise by sqrt(2), from the spacing 2 R / (n - 1) at the largest n to
    the diameter; the exit is the zero of the line through the last value inside and the first outside.
    A gap that lies between two of these distances is not seen. What ends before the first counts as that long, since
    it takes the largest n in any case.
    """
    spacing, diameter = 2 * radius / (MOST - 1), 2 * radius
    shares = torch.linspace(0, 1, round(2 * log2(MOST - 1)) + 1, dtype=rays.origins.dtype, device=rays.origins.device)
    distance = spacing * (diameter / spacing) ** shares
    value = field(rays.at_each(distance))
    leaves, bracket = first_crossing(distance.expand_as(value), -value)
    found, _ = refine(field, rays[leaves], bracket, method="secant", steps=0)
    exits = torch.full_like(value[:, 0], inf).masked_scatter(leaves, found)
    return torch.where(value[:, 0] > 0, distance[0], exits)
