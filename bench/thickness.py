"""A renderer whose number of samples follows the thinnest part of the shape: `renderer.samples=auto`."""

from dataclasses import dataclass, field, replace
from math import inf, log2
from typing import cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.auto import MOST, samples
from renderers.bracket import first_crossing, refine
from renderers.camera import Rays
from renderers.field import Field, autograd_normals
from renderers.rendering import Capabilities, Renderer, Rendering, Spaced, at_iteration

HITS = 128  # of a rendering, at most, behind which the shape is measured
SHARE = 0.05  # of these that may be thinner: at a sharp edge the thickness falls to zero


@dataclass
class Seen:
    """The thinnest part that was seen so far, in scene units; infinite before the first."""

    thinnest: float = inf


@dataclass(frozen=True)
class Following:
    """A renderer with as many samples as put two into the thinnest part seen so far; see `bench.auto.samples`.

    It looks at the shape after each rendering of an optimisation, that is as `at_iteration` gives it. Renderings that
    judge and draw use the number as it stands and change nothing, so that a run with pictures is the same run. A part
    that no ray has hit cannot be measured: what all 16 samples of all rays miss stays missed.

    Args:
        inner: what renders.
        seen: is shared with the renderer of every iteration.
        looks: whether renderings are looked at.
    """

    inner: Spaced
    seen: Seen = field(default_factory=Seen)
    looks: bool = False

    @property
    def capabilities(self) -> Capabilities:
        """Those of the inner renderer."""
        return self.inner.capabilities

    @property
    def samples(self) -> int:
        """Their number as it stands."""
        return samples(self.seen.thinnest, self.inner.sphere_radius)

    def current(self) -> Spaced:
        """The inner renderer with the number of samples as it stands."""
        return self.inner.with_samples(self.samples)

    def at_iteration(self, iteration: int) -> "Following":
        """Looks at its renderings, through the inner renderer as it is at that iteration.

        An optimisation begins at 0, with nothing seen: one run may have several.
        """
        if iteration == 0:
            self.seen.thinnest = inf
        return replace(self, inner=cast(Spaced, at_iteration(self.inner, iteration)), looks=True)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Renders with the number as it stands, then looks how thick the shape is, through the same field."""
        rendering = self.current().render(field, rays)
        if self.looks:
            found = thinnest(field, rendering, radius=self.inner.sphere_radius)
            self.seen.thinnest = min(self.seen.thinnest, found)
        return rendering

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """That of the inner renderer."""
        return self.current().silhouette_loss(field, rays, rendering, mask)

    def finest(self) -> Spaced:
        """The inner renderer with as many samples as there may be."""
        return self.inner.with_samples(MOST)


def follow(renderer: Renderer) -> Following:
    """The renderer with samples that follow the shape.

    Raises:
        ValueError: where its samples are not spaced along the ray.
    """
    if isinstance(renderer, Spaced):
        return Following(renderer)
    raise ValueError(
        f"renderer.samples=auto is for samples spaced along the ray (DVR, Eq. 9), which {type(renderer).__name__} has "
        "not, whatever it calls samples: give a number"
    )


def own(renderer: Renderer) -> Renderer:
    """The renderer for one of several optimisations: with what is seen in that one, where it follows a shape."""
    return replace(renderer, seen=Seen()) if isinstance(renderer, Following) else renderer


def finest(renderer: Renderer) -> Renderer:
    """The renderer for judging fields by the same measure, whatever was seen of each."""
    return renderer.finest() if isinstance(renderer, Following) else renderer


def ending(renderer: Renderer) -> list[str]:
    """What `renderer.samples=auto` has come to, in words; nothing before a shape was seen, and for other renderers."""
    if not isinstance(renderer, Following) or renderer.seen.thinnest == inf:
        return []
    part = f"a part {renderer.seen.thinnest:.3g} scene units thick"
    return [f"renderer.samples=auto came to {renderer.samples}, for {part}"]


def thinnest(field: Field, rendering: Rendering, *, radius: float) -> float:
    """The thickness that all but the thinnest `SHARE` of the hits have, in scene units; infinite without a hit.

    Looked at are at most `HITS` hits, evenly spread over the rays, the same ones each time.
    """
    hits = rendering.points.detach()[rendering.hit]
    if not len(hits):
        return inf
    chosen = torch.linspace(0, len(hits) - 1, min(len(hits), HITS)).round().long().to(hits.device)
    found = thickness(field, hits[chosen], radius=radius).sort().values
    return float(found[int(SHARE * len(found))])


@torch.no_grad()
def thickness(field: Field, hits: Float[Tensor, "n 3"], *, radius: float) -> Float[Tensor, "n"]:
    """How thick the shape is behind points of its surface, in scene units: the chord along the inward normal.

    That is what a ray at normal incidence crosses, and bounded away from zero on a smooth shape: 2 r on a sphere of
    radius r. The chord along the ray falls to zero at every outline, where any n misses some; at a plate it is the
    longer the flatter the ray, and multiplied by the cosine it falls to zero at every sphere's outline still faster.

    Args:
        field: negative inside. A hit costs a value and a gradient for its normal, and the 15 values of `first_exit`.
        hits: n points.
        radius: of the sphere that holds the shape, in scene units.

    Returns:
        the thicknesses; infinite where the shape does not end within the diameter, or the field is flat at the hit.
    """
    normal = autograd_normals(field, hits)
    steep = torch.linalg.vector_norm(normal, dim=-1) > 0.5
    exits = first_exit(field, Rays(hits[steep], -normal[steep]), radius=radius)
    return torch.full_like(hits[:, 0], inf).masked_scatter(steep, exits)


def first_exit(field: Field, rays: Rays, *, radius: float) -> Float[Tensor, "n"]:
    """Where n rays that begin on the surface, inward, first leave the shape, in scene units; infinite where nowhere.

    The field is asked at distances that rise by sqrt(2), from the finest spacing, 2 R / (n - 1) at the largest n, to
    the diameter; between the last inside and the first outside the line through both values meets zero.
    A gap that lies between two of these distances is not seen. What ends before the first counts as that long, since
    it takes the largest n in any case.
    """
    finest, diameter = 2 * radius / (MOST - 1), 2 * radius
    shares = torch.linspace(0, 1, round(2 * log2(MOST - 1)) + 1, dtype=rays.origins.dtype, device=rays.origins.device)
    distance = finest * (diameter / finest) ** shares
    value = field(rays.origins[:, None] + distance[:, None] * rays.directions[:, None])
    leaves, bracket = first_crossing(distance.expand_as(value), -value)
    found, _ = refine(field, rays[leaves], bracket, method="secant", steps=0)
    exits = torch.full_like(value[:, 0], inf).masked_scatter(leaves, found)
    return torch.where(value[:, 0] > 0, distance[0], exits)
