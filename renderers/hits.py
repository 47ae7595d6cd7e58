"""Checks of hits: they must have a finite distance, and lie in front of the camera and on the surface.

Within `collect_hits`, `boundary.render_checked` records the hits of each rendering, at no cost.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.checks import BrokenContract
from renderers.field import Field, Meter, values_and_gradients
from renderers.rendering import Renderer, Rendering, Status
from renderers.tracing.bracket import equally_spaced

# Scene units by which a hit may lie further off the surface than its residual. Distances that are 5 % too short from
# 2.5 away are 0.05 to 0.1 off; hits of shipped renderers are at most 0.01 off.
SURFACE_TOLERANCE = 0.02
MAX_RESIDUAL_DISTANCE = 0.05  # scene units that a residual of a single surface may explain: the largest shipped epsilon
MAX_OFF_SURFACE_FRACTION = 0.1  # more than at thin parts and sharp edges
MAX_CHECKED_HITS = 1024  # hits at which the field is evaluated, equally spaced among all
SAMPLES_PER_RAY = 16  # evaluated if a hit has no distance


@dataclass(frozen=True)
class Hits:
    """The hits of one rendering, without a graph.

    Args:
        name: of the method that returned them.
        field: the rendered field, without a Meter, so that a check is not counted.
        rays: the rendered rays.
        status, distance, residual: of each ray; see `rendering.Rendering`.
        volume: whether the rendering has one. Then `distance` is a mean over samples, and `residual` is its error.
    """

    name: str
    field: Field
    rays: Rays
    status: Int8[Tensor, "*rays"]
    distance: Float[Tensor, "*rays"]
    residual: Float[Tensor, "*rays"]
    volume: bool

    @property
    def hit(self) -> Bool[Tensor, "*rays"]:
        """True where a ray has a hit."""
        return self.status == Status.HIT

    @property
    def lacks_distance(self) -> Bool[Tensor, "*rays"]:
        """True where a ray has a hit without a finite distance."""
        return self.hit & ~self.distance.isfinite()

    def check(self) -> None:
        """Raises BrokenContract if the distance of a hit is not finite, or negative."""
        if bool(self.lacks_distance.any()):
            remedy = "return a finite distance for each hit, or another Status"
            raise BrokenContract(f"{self.name}: {missing_distance_message([self])}: {remedy}")
        behind = self.distance[self.hit & (self.distance < 0)]
        if len(behind):
            raise BrokenContract(
                f"{self.name}: {len(behind):,} of {int(self.hit.sum()):,} hits have a negative distance, down to "
                f"{float(behind.min()):.3g}, so they lie behind the camera: return the distance from the origin along "
                "the direction, or another Status"
            )

    def off_surface(self) -> str:
        """A note if more than `MAX_OFF_SURFACE_FRACTION` of the hits lie off the surface; else empty.

        A hit's distance from the surface is the field's value over the length of its gradient, in scene units for every
        kind of field. It may exceed the residual by `SURFACE_TOLERANCE`. The residual explains any error of a volume's
        mean distance, but at most `MAX_RESIDUAL_DISTANCE` for a single surface.
        """
        index = self.hit.flatten().nonzero().squeeze(-1)
        index = index[:: max(-(-len(index) // MAX_CHECKED_HITS), 1)]
        value, gradient = values_and_gradients(self.field, self.rays.flat()[index].at(self.distance.flatten()[index]))
        value, slope = value.abs(), torch.linalg.vector_norm(gradient, dim=-1)
        residual = self.residual.flatten()[index].abs().nan_to_num(0.0)
        explained = residual if self.volume else torch.minimum(residual, MAX_RESIDUAL_DISTANCE * slope)
        off = ~(value <= SURFACE_TOLERANCE * slope + explained)  # NaN is off the surface too
        count = int(off.sum())
        if count <= MAX_OFF_SURFACE_FRACTION * len(index):
            return ""
        median = float((value / slope)[off].nanmedian())
        return (
            f"{self.name}: {count:,} of {len(index):,} hits are not on the surface at origin + distance * direction. "
            f"Their median distance from it is {median:.2g} scene units, and {SURFACE_TOLERANCE:g} beyond the residual "
            "is allowed. Return the distance along the unit direction, in scene units"
        )


_collected: ContextVar[list[Hits] | None] = ContextVar("collected", default=None)


@contextmanager
def collect_hits() -> Iterator[list[Hits]]:
    """Collects the hits of all renderings within the context, in the list that it yields."""
    collected: list[Hits] = []
    token = _collected.set(collected)
    try:
        yield collected
    finally:
        _collected.reset(token)


def record_hits(renderer: Renderer, field: Field, rays: Rays, rendering: Rendering) -> None:
    """Records the hits of a rendering, within `collect_hits`."""
    if (collected := _collected.get()) is not None:
        name = f"{type(renderer).__name__}.render"
        field = field.inner if isinstance(field, Meter) else field
        tensors = (rendering.status, rendering.distance.detach(), rendering.residual.detach())
        collected.append(Hits(name, field, rays, *tensors, rendering.volume is not None))


@torch.no_grad()
def missing_distance_message(renderings: Sequence[Hits]) -> str:
    """How many rays have a hit without a finite distance, and whether renderer or field is at fault; empty for none."""
    lacking = sum(int(hits.lacks_distance.sum()) for hits in renderings)
    if not lacking:
        return ""
    rays = sum(hits.status.numel() for hits in renderings)
    blind = sum(int(_not_finite_along(hits.field, hits.rays[hits.lacks_distance]).sum()) for hits in renderings)
    fault = f"the field has values that are not finite on {blind:,} of them" if blind else "the field is finite on them"
    fault += "" if blind else ", so the renderer is at fault"
    return f"{lacking:,} of {rays:,} rays have a hit without a finite distance ({fault})"


def _not_finite_along(field: Field, rays: Rays) -> Bool[Tensor, " n"]:
    """The rays along which a value of the field in the unit sphere is not finite."""
    entry, leave, _ = sphere_span(rays)
    return ~field(rays.at_each(equally_spaced(entry, leave, SAMPLES_PER_RAY))).isfinite().all(dim=-1)
