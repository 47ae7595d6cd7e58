"""Ray casting by range analysis: segments that are not certified to be empty are halved (Sharp and Jacobson, 2022)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int8
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.gradients import attach_implicit_gradient, reevaluate_with_graph
from renderers.later.affine import Bounds, field_bounds
from renderers.rendering import Rendering, Status, assemble, check_kind
from renderers.silhouette import SurfaceRenderer
from renderers.tracing.bracket import Bracket, refine

SEGMENT_GROWTH = 2.0  # factor after an empty segment
SECANT_STEPS = 6  # to the root, within the last segment


@dataclass(frozen=True)
class RangeAnalysis(SurfaceRenderer):
    """Moves along a ray by the longest segments on which bounds certify that the field is positive.

    Source: "Spelunking the Deep" (Sharp and Jacobson 2022, arXiv 2202.02444), Secs. 3, 4.1: ray casting by affine
        arithmetic through the network.
    Differentiable in: field parameters and rays, by the implicit rule of DVR, Eq. 8, exactly. The gradient of
        `distance` lacks the visibility gradient; the mask loss (IDR's) has it.
    Needs: a distance or a bound. If the field has bounds on segments, as decoders do, these decide, and values need not
        be distances. Otherwise its stated Lipschitz constant, or 1, gives the bounds. If the bounds hold and segments
        do not run out, no surface that is longer on a ray than `least_segment` is missed. The bounds of a deep, wide
        network are loose: rays are then cut to the shortest segments everywhere.
    Deviates from the paper: segments double after an empty one, instead of 1.5 times. A segment of the shortest length
        that is not certified is a hit only if the sign changes. So is a certified segment, if the value at its end is
        not positive.

    Args:
        least_segment: in scene units; shorter segments are not cut.
        most_segments: maximum per ray; an unfinished ray is then OUT_OF_STEPS.
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
            bracket = Bracket(cast.distance[hit], cast.far[hit], cast.value[hit], cast.far_value[hit])
            root, _ = refine(field, flat[hit], bracket, method="secant", steps=SECANT_STEPS)
            remaining = field(flat[hit].at(root))
        distance = attach_implicit_gradient(field, flat[hit], root, least_slope=self.least_slope)
        least, least_distance = cast.least.index_put((hit,), remaining), cast.least_distance.index_put((hit,), root)
        queried = least.isfinite().nonzero().squeeze(-1)
        return assemble(
            rays,
            self.sphere_radius,
            distance=cast.distance.index_put((hit,), distance),
            status=cast.status,
            residual=torch.where(least.isfinite(), least, 0.0),
            closest=(queried, reevaluate_with_graph(field, flat[queried], least_distance[queried], least[queried])),
        )

    def _cast(self, field: Field, rays: Rays) -> "_CastState":
        bounds = field_bounds(field) or _lipschitz_bounds(field)
        cast = _CastState.at_sphere_entry(field, rays, self.sphere_radius)
        for _ in range(self.most_segments):
            active = (cast.status == Status.OUT_OF_STEPS).nonzero().squeeze(-1)
            if active.numel() == 0:
                break
            active_rays, near, leave = rays[active], cast.distance[active], cast.leave[active]
            length = torch.minimum(cast.length[active], leave - near)
            middle = near + length / 2
            low, _ = bounds(active_rays.at(middle), length[:, None] / 2 * active_rays.directions)
            empty, shortest = low > 0, length <= self.least_segment
            accepted = empty | shortest
            evaluated = accepted.nonzero().squeeze(-1)
            far = near + length
            values = field(active_rays[evaluated].at(far[evaluated]))
            value = torch.full_like(near, torch.nan).index_put((evaluated,), values)
            cast.update_smallest_sample(active[evaluated], far[evaluated], values)
            crossed = value <= 0  # also at the end of an empty segment, if values are less precise than its bounds
            onward = accepted & ~crossed
            left_sphere = onward & (far >= leave)
            cast.far[active], cast.far_value[active] = far, torch.where(crossed, value, cast.far_value[active])
            status = torch.where(crossed, Status.HIT, torch.where(left_sphere, Status.MISS, Status.OUT_OF_STEPS))
            cast.status[active] = status.to(torch.int8)
            cast.distance[active] = torch.where(onward, far, near)
            cast.value[active] = torch.where(onward, value, cast.value[active])
            cast.length[active] = torch.where(empty, SEGMENT_GROWTH * length, length / 2).clamp_min(self.least_segment)
        return cast


@dataclass(frozen=True)
class _CastState:
    """The state of n rays, certified up to `distance`, where the field has `value`; the tensors change in place."""

    status: Int8[Tensor, " n"]
    distance: Float[Tensor, " n"]
    value: Float[Tensor, " n"]
    leave: Float[Tensor, " n"]
    length: Float[Tensor, " n"]  # of the next segment
    far: Float[Tensor, " n"]  # the end of the last one
    far_value: Float[Tensor, " n"]
    least: Float[Tensor, " n"]  # the value of smallest magnitude, infinite before the first
    least_distance: Float[Tensor, " n"]

    @staticmethod
    def at_sphere_entry(field: Field, rays: Rays, radius: float) -> "_CastState":
        """Rays where they enter the sphere, with the field's value there."""
        entry, leave, intersects = sphere_span(rays, radius)
        index = intersects.nonzero().squeeze(-1)
        value = torch.ones_like(entry).index_put((index,), field(rays[index].at(entry[index])))
        status = torch.where(intersects, Status.OUT_OF_STEPS, Status.MISS).to(torch.int8)
        status[intersects & (value <= 0)] = Status.STARTED_INSIDE
        least, start = torch.where(intersects & value.isfinite(), value, torch.inf), entry.clone()
        return _CastState(
            status, start, value, leave, leave - entry, leave.clone(), value.clone(), least, entry.clone()
        )

    def update_smallest_sample(self, index: Tensor, distance: Tensor, value: Tensor) -> None:
        """Keeps a sample of each ray in `index` if its magnitude is the smallest so far."""
        closer = value.abs() < self.least[index].abs()
        self.least[index] = torch.where(closer, value, self.least[index])
        self.least_distance[index] = torch.where(closer, distance, self.least_distance[index])


def _lipschitz_bounds(field: Field) -> Bounds:
    """Bounds by the Lipschitz constant, or by 1 if the field has none; on a `BOUND`, only the lower sign holds."""
    lipschitz = 1.0 if field.lipschitz is None else field.lipschitz

    def bounds(middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        value, radius = field(middle), lipschitz * torch.linalg.vector_norm(half, dim=-1)
        return value - radius, value + radius

    return bounds
