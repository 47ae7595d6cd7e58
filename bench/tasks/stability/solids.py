"""Solids with a field and closed-form ray intersections: the truth that renderings are compared with.

A solid returns the spans of a ray inside it. Union and difference of solids are computed on the spans.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.field import Field, autograd_normals
from renderers.fields import analytic
from renderers.fields.analytic import Shape
from renderers.rendering import Status
from renderers.tracing import reference

Spans = Float[Tensor, "n _ 2"]  # entry and exit along each ray; for a missing span the exit comes first


@dataclass(frozen=True)
class FirstHit:
    """The true first hits of n rays within the unit sphere; distances are valid only where `hit`."""

    distance: Float[Tensor, " n"]
    hit: Bool[Tensor, " n"]
    inside: Bool[Tensor, " n"]  # the ray begins inside the solid, so that it has no first hit


@dataclass(frozen=True)
class Solid:
    """A shape, and the spans of each ray [n] inside it. `|` is the union, `-` the difference, as for shapes."""

    field: Shape
    spans: Callable[[Rays], Spans]

    def __or__(self, other: "Solid") -> "Solid":
        return Solid(self.field | other.field, lambda rays: torch.cat([self.spans(rays), other.spans(rays)], dim=1))

    def __sub__(self, other: "Solid") -> "Solid":
        return Solid(self.field - other.field, lambda rays: _subtract_spans(self.spans(rays), other.spans(rays)))

    def turned(self, rotation: Float[Tensor, "3 3"]) -> "Solid":
        """The solid turned about the origin: a point x goes to `rotation @ x`."""

        def back(rays: Rays) -> Rays:
            turn = rotation.to(rays.origins)
            return Rays(rays.origins @ turn, rays.directions @ turn)

        return Solid(self.field.rotate(rotation), lambda rays: self.spans(back(rays)))

    def moved(self, offset: analytic.Numbers) -> "Solid":
        def back(rays: Rays) -> Rays:
            return Rays(rays.origins - torch.as_tensor(offset).to(rays.origins), rays.directions)

        return Solid(self.field.translate(offset), lambda rays: self.spans(back(rays)))

    def trace(self, rays: Rays) -> FirstHit:
        """The first hits of flat rays [n] within the unit sphere; differentiable in rays and parameters."""
        entry, leave, meets = sphere_span(rays)
        spans = self.spans(rays)
        near, far = spans.unbind(-1)
        exists = far > near
        start = entry[:, None]
        inside = (exists & (near <= start) & (far > start)).any(dim=1) & meets
        in_front = exists & (near > start) & (near <= leave[:, None])
        distance = torch.where(in_front, near, torch.inf).amin(dim=1)
        hit = meets & ~inside & distance.isfinite()
        return FirstHit(torch.where(hit, distance, leave), hit, inside)


def incidence_cosines(field: Field, rays: Rays, first: FirstHit) -> Float[Tensor, " n"]:
    """The cosine of each hit's angle of incidence, 0 for grazing rays; 1 for misses."""
    normals = autograd_normals(field, rays.at(first.distance.detach()))
    return torch.where(first.hit, (normals * rays.directions).sum(-1).abs(), 1.0)


def sphere_solid(radius: analytic.Numbers) -> Solid:
    def spans(rays: Rays) -> Spans:
        approach = -(rays.origins * rays.directions).sum(-1)
        closest = rays.origins + approach[:, None] * rays.directions
        half_squared = torch.as_tensor(radius).to(closest) ** 2 - closest.square().sum(-1)
        meets = half_squared > 0
        half_chord = torch.where(meets, half_squared, 1.0).sqrt()
        return _span(approach - half_chord, approach + half_chord, meets)

    return Solid(analytic.sphere(radius), spans)


def box(half_sizes: analytic.Numbers) -> Solid:
    """An axis-aligned box about the origin, of half the side lengths [3]."""

    def spans(rays: Rays) -> Spans:
        half = torch.as_tensor(half_sizes).to(rays.origins)
        tiny = torch.finfo(half.dtype).tiny
        along = torch.where(rays.directions.abs() < tiny, tiny, rays.directions)
        ends = torch.stack([(-half - rays.origins) / along, (half - rays.origins) / along])
        near, far = ends.amin(dim=0).amax(dim=-1), ends.amax(dim=0).amin(dim=-1)
        return _span(near, far, far > near)

    return Solid(analytic.box(half_sizes), spans)


def half_space(normal: analytic.Numbers, offset: analytic.Numbers) -> Solid:
    """All points x with normal . x below `offset`; the normal [3], of any length, points outward."""

    def spans(rays: Rays) -> Spans:
        n = torch.as_tensor(normal).to(rays.origins)
        slope = rays.directions @ n
        above = rays.origins @ n - torch.as_tensor(offset).to(n)
        crossing = -above / torch.where(slope == 0, torch.finfo(n.dtype).tiny, slope)
        far = torch.full_like(crossing, torch.inf)
        near = torch.where(slope < 0, crossing, -far)
        return _span(near, torch.where(slope < 0, far, crossing), torch.ones_like(slope, dtype=torch.bool))

    return Solid(analytic.plane(normal, offset), spans)


def rod(radius: analytic.Numbers, half_height: analytic.Numbers) -> Solid:
    """A cylinder about the y axis with flat ends."""

    def spans(rays: Rays) -> Spans:
        o, d = rays.origins, rays.directions
        across, start = d[:, [0, 2]], o[:, [0, 2]]
        tiny = torch.finfo(o.dtype).tiny
        a = across.square().sum(-1).clamp_min(tiny)
        b, c = (across * start).sum(-1), start.square().sum(-1) - torch.as_tensor(radius).to(o) ** 2
        inner = b.square() - a * c
        crosses = inner > 0
        root = torch.where(crosses, inner, 1.0).sqrt()
        rise = torch.where(d[:, 1].abs() < tiny, tiny, d[:, 1])
        height = torch.as_tensor(half_height).to(o)
        ends = torch.stack([(-height - o[:, 1]) / rise, (height - o[:, 1]) / rise])
        near = torch.maximum((-b - root) / a, ends.amin(dim=0))
        far = torch.minimum((-b + root) / a, ends.amax(dim=0))
        return _span(near, far, crosses & (far > near))

    return Solid(analytic.cylinder(radius, half_height), spans)


def _span(near: Tensor, far: Tensor, exists: Tensor) -> Spans:
    """One span per ray; a missing span has its exit first and no gradient."""
    nowhere = torch.full_like(near, torch.inf)
    return torch.stack([torch.where(exists, near, nowhere), torch.where(exists, far, -nowhere)], dim=-1)[:, None]


def _subtract_spans(first: Spans, second: Spans) -> Spans:
    """The first spans without the second spans."""
    rest = first
    for near, far in (span.unbind(-1) for span in second.unbind(1)):
        exists = (far > near)[:, None]
        before = torch.where(exists, torch.minimum(rest[..., 1], near[:, None]), rest[..., 1])
        after = torch.where(exists, torch.maximum(rest[..., 0], far[:, None]), torch.inf)
        rest = torch.cat([torch.stack([rest[..., 0], before], -1), torch.stack([after, rest[..., 1]], -1)], dim=1)
    return rest


@dataclass(frozen=True)
class ReferenceTruth:
    """A field whose first hits are computed by the reference tracer.

    Args:
        field: evaluated in float64.
        lipschitz: an upper bound of the norm of its gradient.
        rounded: the same field in float32, traced in place of it; for networks, of which float64 values are slow.
        thinnest: parts thinner than this along a ray may be missed, in scene units.
    """

    field: Field
    lipschitz: float
    thinnest: float
    rounded: Field | None = None

    def trace(self, rays: Rays) -> FirstHit:
        """The first hits of flat rays [n]; without gradient."""
        field = self.field if self.rounded is None else lambda points: self.rounded(points.float()).double()
        rendering = reference.trace(field, rays, lipschitz=self.lipschitz, least_step=self.thinnest, radius=1.0)
        return FirstHit(rendering.distance, rendering.hit, rendering.status == Status.STARTED_INSIDE)


Truth = Solid | ReferenceTruth  # a field whose first hits are known
