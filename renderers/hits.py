"""What the hits of a rendering must be: at a finite distance, in front of the camera, on the surface.

Within `kept_hits`, `boundary.rendered` keeps the hits of each rendering. Keeping them costs nothing.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int8
from torch import Tensor

from renderers.bracket import evenly
from renderers.camera import Rays, sphere_span
from renderers.checks import BrokenContract
from renderers.field import Field, Meter, values_and_gradients
from renderers.rendering import Renderer, Rendering, Status

# Scene units by which a hit may lie further off the surface than its residual says. Distances that are 5 % too short
# from 2.5 away are 0.05 to 0.1 off; hits of shipped renderers are at most 0.01 off.
NEAR = 0.02
STATED = 0.05  # scene units that a residual may account for, unless there is a volume: the largest shipped epsilon
MANY = 0.1  # share of the hits that may lie further off, as at thin parts and sharp edges
MOST = 1024  # hits at which the field is evaluated, evenly spaced among all
ALONG = 16  # places on a ray at which the field is evaluated where a hit has no distance


@dataclass(frozen=True)
class Hits:
    """The hits of one rendering, without a graph.

    Args:
        name: of the method that gave them.
        field: that was rendered, without a Meter, so that a check is not counted.
        rays: that were rendered.
        status, distance, residual: of each ray; see `rendering.Rendering`.
        volume: whether the rendering has one. Then `distance` is a mean over samples, and `residual` says how far off.
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
    def endless(self) -> Bool[Tensor, "*rays"]:
        """True where a ray has a hit without a finite distance."""
        return self.hit & ~self.distance.isfinite()

    def check(self) -> None:
        """Raises BrokenContract where the distance of a hit is not finite, or negative."""
        if bool(self.endless.any()):
            raise BrokenContract(
                f"{self.name}: {without_distance([self])}: return a finite distance for each hit, or another Status"
            )
        behind = self.distance[self.hit & (self.distance < 0)]
        if len(behind):
            raise BrokenContract(
                f"{self.name}: {len(behind):,} of {int(self.hit.sum()):,} hits have a negative distance, down to "
                f"{float(behind.min()):.3g}, so they lie behind the camera: return the distance from the origin along "
                "the direction, or another Status"
            )

    def off_surface(self) -> str:
        """A note where more than `MANY` of the hits lie off the surface; empty where they do not.

        How far a hit lies off is the field's value over the length of its gradient there, in scene units for every
        kind of field. `NEAR` beyond the residual is allowed. A residual accounts for any error of a volume's mean
        distance, and for no more than `STATED` of a single surface.
        """
        index = self.hit.flatten().nonzero().squeeze(-1)
        index = index[:: max(-(-len(index) // MOST), 1)]
        value, gradient = values_and_gradients(self.field, self.rays.flat()[index].at(self.distance.flatten()[index]))
        value, slope = value.abs(), torch.linalg.vector_norm(gradient, dim=-1)
        residual = self.residual.flatten()[index].abs().nan_to_num(0.0)
        stated = residual if self.volume else torch.minimum(residual, STATED * slope)
        off = ~(value <= NEAR * slope + stated)  # as is a value that is not a number
        count = int(off.sum())
        if count <= MANY * len(index):
            return ""
        middle = float((value / slope)[off].nanmedian())
        return (
            f"{self.name}: {count:,} of {len(index):,} hits are not on the surface at origin + distance * direction. "
            f"Their median distance from it is {middle:.2g} scene units, and {NEAR:g} beyond the residual is allowed. "
            "Return the distance along the unit direction, in scene units"
        )


_kept: ContextVar[list[Hits] | None] = ContextVar("kept", default=None)


@contextmanager
def kept_hits() -> Iterator[list[Hits]]:
    """Within it, the hits of all renderings are kept, in the list that it gives."""
    kept: list[Hits] = []
    token = _kept.set(kept)
    try:
        yield kept
    finally:
        _kept.reset(token)


def keep(renderer: Renderer, field: Field, rays: Rays, rendering: Rendering) -> None:
    """Keeps the hits of a rendering, where they are wanted."""
    if (kept := _kept.get()) is not None:
        name = f"{type(renderer).__name__}.render"
        shape = field.inner if isinstance(field, Meter) else field
        parts = (rendering.status, rendering.distance.detach(), rendering.residual.detach())
        kept.append(Hits(name, shape, rays, *parts, rendering.volume is not None))


@torch.no_grad()
def without_distance(kept: Sequence[Hits]) -> str:
    """How many rays have a hit without a finite distance, and whether renderer or field is at fault; empty for none."""
    endless = sum(int(hits.endless.sum()) for hits in kept)
    if not endless:
        return ""
    rays = sum(hits.status.numel() for hits in kept)
    blind = sum(int(_not_finite_along(hits.field, hits.rays[hits.endless]).sum()) for hits in kept)
    fault = f"the field has values that are not finite on {blind:,} of them" if blind else "the field is finite on them"
    fault += "" if blind else ", so the renderer is at fault"
    return f"{endless:,} of {rays:,} rays have a hit without a finite distance ({fault})"


def _not_finite_along(field: Field, rays: Rays) -> Bool[Tensor, " n"]:
    """The rays along which some value of the field in the unit sphere is not finite."""
    entry, leave, _ = sphere_span(rays)
    return ~field(rays.at_each(evenly(entry, leave, ALONG))).isfinite().all(dim=-1)
