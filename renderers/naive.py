"""Sphere tracing as first written, with every step in the graph: the baseline that the others are measured against."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays, distance_to_origin, sphere_span
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Field, Kind
from renderers.rendering import Capabilities, Rendering, Status
from renderers.silhouette import hinge_silhouette_loss


@dataclass(frozen=True)
class Naive:
    """Fully unrolled sphere tracing. Honest and slow: not for real use.

    Every ray that meets the sphere is asked at every step, whether it has finished or not, and all steps stay in the
    graph: time and memory grow with rays times steps.

    Source: DIST, Algorithm 1, begun on the bounding sphere (Sec. 3.2), since a network means nothing outside it.
    Differentiable in: field parameters and rays, by unrolling. Exact in the limit of many steps; short of it by a
        factor 1 - (1 - cos(angle of incidence))^steps, which shows near grazing.
    Needs: a distance or a bound inside the sphere.
    Deviates from the paper: a ray that begins at negative values stops at once and says so.

    Args:
        steps: marching steps, all of them taken.
        epsilon: a ray has converged where the field's magnitude is below this, in scene units.
        sphere_radius: of the sphere about the origin that holds the shape.
        silhouette_signed, silhouette_average: see `silhouette.hinge_silhouette_loss`.
    """

    steps: int
    epsilon: float
    sphere_radius: float
    silhouette_signed: bool
    silhouette_average: str

    capabilities: ClassVar[Capabilities] = Capabilities(
        needs=(Kind.DISTANCE, Kind.BOUND), field_gradient=True, ray_gradient=True
    )

    def __post_init__(self) -> None:
        check_at_least("steps", self.steps, 1, "the paper uses 50 to 100")
        check_positive("epsilon", self.epsilon, "the paper uses 5e-5")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")
        check_choice("silhouette_average", self.silhouette_average, ("all", "violating"))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches all rays through all steps with the graph kept."""
        flat = rays.flat()
        entry, leave, meets = sphere_span(flat, self.sphere_radius)
        inside = flat[meets]
        distance, status, value, closest = self._march(field, inside, entry[meets], leave[meets])

        def scatter(into: Tensor, what: Tensor) -> Tensor:
            return into.masked_scatter(meets, what).view(rays.shape)

        ended = scatter(entry, distance)
        return Rendering(
            distance=ended,
            status=scatter(torch.full_like(meets, Status.MISS, dtype=torch.int8), status),
            points=rays.at(ended),
            residual=scatter(torch.zeros_like(entry), value.detach()),
            closest=scatter(distance_to_origin(flat) - self.sphere_radius, closest),
        )

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """DIST, Eq. 11."""
        return hinge_silhouette_loss(
            rendering.closest,
            mask,
            epsilon=self.epsilon,
            signed=self.silhouette_signed,
            average=self.silhouette_average,
        )

    def _march(
        self, field: Field, rays: Rays, distance: Tensor, leave: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        status = torch.full_like(distance, Status.OUT_OF_STEPS, dtype=torch.int8)
        active = torch.ones_like(distance, dtype=torch.bool)
        last, closest = torch.zeros_like(distance), torch.full_like(distance, torch.inf)
        for step in range(self.steps):
            value = field(rays.at(distance))
            finite = value.isfinite()
            converged = active & (value.abs() < self.epsilon)
            last = torch.where(active & finite, value, last)
            closest = torch.where(active & finite & (value.abs() < closest.abs()), value, closest)
            if step == 0:
                began_inside = finite & (value < 0) & ~converged
                status[began_inside] = Status.STARTED_INSIDE
                active = active & ~began_inside
            active = active & finite
            moved = torch.where(active, distance + value, distance)
            left = active & ~converged & (moved > leave)
            status[left], status[converged] = Status.MISS, Status.HIT
            distance = torch.where(left, leave, moved)
            active = active & ~left & ~converged
        closest = torch.where(closest.isfinite(), closest, 1.0)
        return distance, status, last, closest
