"""Ray casting by range analysis: what is not certified to be empty is cut in half (Sharp and Jacobson, 2022)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from renderers.bracket import Bracket, refine
from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Bounds, Field, bounds_of
from renderers.gradients import fixed_samples, implicit
from renderers.rendering import Rendering, Status, assemble, check_kind
from renderers.silhouette import SurfaceRenderer

GROWTH = 2.0  # of the next segment after an empty one
ROOT_STEPS = 6  # of the secant method in the last segment


@dataclass(frozen=True)
class RangeAnalysis(SurfaceRenderer):
    """Goes along a ray by segments on which the field is certified to be positive, as long as they can be.

    Source: "Spelunking the Deep" (Sharp and Jacobson 2022, arXiv 2202.02444), Secs. 3, 4.1: ray casting by affine
        arithmetic through the network.
    Differentiable in: field parameters and rays, by the implicit rule of DVR, Eq. 8, exactly. What comes into view or
        leaves it has no part in the gradient of `distance`, only in that of the mask loss (IDR's).
    Needs: a distance or a bound. Where it offers bounds, as decoders do, these decide, and values need be no lengths;
        else its own promise is taken: its stated Lipschitz bound, or 1. Where the bounds hold and segments do not run
        out, no surface that is longer on a ray than `least_segment` is missed. Those of a deep, wide network are
        loose: rays are then cut to the least segments everywhere.
    Deviates from the paper: segments double after an empty one, in place of 1.5 times; a segment of the least length
        that is not certified is a hit only where the sign changes. A certified one at whose end the value is not
        positive is a hit too.

    Args:
        least_segment: in scene units; a shorter one is not cut any more.
        most_segments: per ray; a ray that is left is out of steps.
        least_slope, mask_sharpness, mask_weight, sphere_radius: see `silhouette.SurfaceRenderer`.
    """

    least_segment: float
    most_segments: int

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("least_segment", self.least_segment, "1e-3 finds all that a pixel shows")
        check_at_least("most_segments", self.most_segments, 1, "2500 cross the unit sphere by segments of 1e-3")

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Finds the first crossings without a graph, then attaches the implicit gradient to the hits."""
        check_kind(self, field)
        flat = rays.flat()
        with torch.no_grad():
            cast = self._cast(field, flat)
            hit = (cast.status == Status.HIT).nonzero().squeeze(-1)
            root, _ = refine(field, flat[hit], cast.bracket(hit), method="secant", steps=ROOT_STEPS)
            remaining = field(flat[hit].at(root))
        found = implicit(field, flat[hit], root, least_slope=self.least_slope)
        least, least_at = cast.least.index_put((hit,), remaining), cast.least_at.index_put((hit,), root)
        queried = least.isfinite().nonzero().squeeze(-1)
        return assemble(
            rays,
            self.sphere_radius,
            distance=cast.distance.index_put((hit,), found),
            status=cast.status,
            residual=torch.where(least.isfinite(), least, 0.0),
            closest=(queried, fixed_samples(field, flat[queried], least_at[queried], least[queried])),
        )

    def _cast(self, field: Field, rays: Rays) -> "_Cast":
        bounds = bounds_of(field) or _promised(field)
        cast = _Cast.begun(field, rays, self.sphere_radius)
        for _ in range(self.most_segments):
            active = (cast.status == Status.OUT_OF_STEPS).nonzero().squeeze(-1)
            if active.numel() == 0:
                break
            some, near, leave = rays[active], cast.distance[active], cast.leave[active]
            length = torch.minimum(cast.length[active], leave - near)
            middle = near + length / 2
            low, _ = bounds(some.at(middle), length[:, None] / 2 * some.directions)
            empty, shortest = low > 0, length <= self.least_segment
            uncut = empty | shortest
            asked = uncut.nonzero().squeeze(-1)  # where the ray goes on, or ends; no value elsewhere
            far = near + length
            value = torch.full_like(near, torch.nan).index_put((asked,), field(some[asked].at(far[asked])))
            cast.note(active[asked], far[asked], value[asked])
            crossed = value <= 0  # at the end of an empty one too, where values are coarser than its bounds
            onward = uncut & ~crossed
            done = onward & (far >= leave)
            cast.far[active], cast.far_value[active] = far, torch.where(crossed, value, cast.far_value[active])
            status = torch.where(crossed, Status.HIT, torch.where(done, Status.MISS, Status.OUT_OF_STEPS))
            cast.status[active] = status.to(torch.int8)
            cast.distance[active] = torch.where(onward, far, near)
            cast.value[active] = torch.where(onward, value, cast.value[active])
            cast.length[active] = torch.where(empty, GROWTH * length, length / 2).clamp_min(self.least_segment)
        return cast


@dataclass(frozen=True)
class _Cast:
    """Where n rays are: certified up to `distance`, where the field has `value`; all are changed in place."""

    status: Int8[Tensor, " n"]
    distance: Float[Tensor, " n"]
    value: Float[Tensor, " n"]
    leave: Float[Tensor, " n"]
    length: Float[Tensor, " n"]  # of the next segment
    far: Float[Tensor, " n"]  # the end of the last one
    far_value: Float[Tensor, " n"]
    least: Float[Tensor, " n"]  # the value of least magnitude, infinite before there is one
    least_at: Float[Tensor, " n"]

    @staticmethod
    def begun(field: Field, rays: Rays, radius: float) -> "_Cast":
        """Rays where they enter the sphere, with the field's value there."""
        entry, leave, meets = sphere_span(rays, radius)
        index = meets.nonzero().squeeze(-1)
        value = torch.ones_like(entry).index_put((index,), field(rays[index].at(entry[index])))
        status = torch.where(meets, Status.OUT_OF_STEPS, Status.MISS).to(torch.int8)
        status[meets & (value <= 0)] = Status.STARTED_INSIDE
        least = torch.where(meets & value.isfinite(), value, torch.inf)
        length = leave - entry
        return _Cast(status, entry.clone(), value, leave, length, leave.clone(), value.clone(), least, entry.clone())

    def note(self, index: Tensor, distance: Tensor, value: Tensor) -> None:
        """Keeps the samples of least magnitude."""
        less = value.abs() < self.least[index].abs()
        self.least[index] = torch.where(less, value, self.least[index])
        self.least_at[index] = torch.where(less, distance, self.least_at[index])

    def bracket(self, index: Tensor) -> Bracket:
        """The last segments of some rays."""
        return Bracket(self.distance[index], self.far[index], self.value[index], self.far_value[index])


def _promised(field: Field) -> Bounds:
    """Bounds by the field's Lipschitz bound, or by 1 where it states none; of a `BOUND` the lower one's sign holds."""
    steepest = 1.0 if field.lipschitz is None else field.lipschitz

    def bounds(middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        value, reach = field(middle), steepest * torch.linalg.vector_norm(half, dim=-1)
        return value - reach, value + reach

    return bounds
