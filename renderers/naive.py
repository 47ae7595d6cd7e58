"""Plain sphere tracing: the baseline of all comparisons."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Field
from renderers.gradients import approximate_rendering
from renderers.rendering import DISTANCE_CAPABILITIES, Capabilities, Rendering, Status, assemble, check_kind
from renderers.silhouette import AVERAGES, Hinge
from renderers.tracing.march import RayFront, Stepping, march_front


@dataclass(frozen=True)
class Naive:
    """Sphere tracing that evaluates every ray that meets the sphere at every step. A slow baseline, not for real use.

    With the unrolled gradient all steps stay in the graph, so that runtime and memory grow with rays times steps. Other
    settings give the first rows of DIST's Table 1: rays one by one or all at once, and the approximate gradient.

    Source: DIST, Algorithm 1, started on the bounding sphere (Sec. 3.2), since a network is undefined outside it.
    Differentiable in: field parameters and rays. Unrolled: exact in the limit of many steps. Its length is 1 - (1 -
        cos(angle of incidence))^steps times the true one, which matters near grazing. Its `closest` has almost no
        gradient at a hit, since the sample follows the surface. Approximate ("practical"): as DIST with alpha = 1.
    Needs: a distance or a bound inside the sphere.
    Deviates from the paper: a ray that starts at negative values stops at once with STARTED_INSIDE.

    Args:
        steps: exact number of marching steps.
        epsilon: a ray has converged if the field's magnitude is below this, in scene units.
        gradient: "unrolled" through all steps, or "practical", DIST's approximate rule (Eq. 4) at the closest samples.
        n_gradient_samples: K of the approximate gradient; None for the unrolled gradient.
        serial: march the rays one after the other.
        sphere_radius: of the sphere about the origin that contains the shape.
        silhouette_signed, silhouette_average: see `silhouette.Hinge`.
    """

    steps: int
    epsilon: float
    gradient: str
    n_gradient_samples: int | None
    serial: bool
    sphere_radius: float
    silhouette_signed: bool
    silhouette_average: str

    capabilities: ClassVar[Capabilities] = DISTANCE_CAPABILITIES

    def __post_init__(self) -> None:
        check_at_least("steps", self.steps, 1, "the paper uses 50 to 100")
        check_positive("epsilon", self.epsilon, "the paper uses 5e-5")
        check_choice("gradient", self.gradient, ("unrolled", "practical"))
        if self.gradient == "practical" and self.n_gradient_samples is None:
            raise ValueError("n_gradient_samples must be given for gradient=practical: n_gradient_samples=1")
        if self.n_gradient_samples is not None:
            check_at_least("n_gradient_samples", self.n_gradient_samples, 1, "the paper uses 1 to 3")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")
        check_choice("silhouette_average", self.silhouette_average, AVERAGES)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches all rays through all steps."""
        check_kind(self, field)
        flat = rays.flat()
        render = self._unrolled if self.gradient == "unrolled" else self._approximate
        if not self.serial or flat.shape.numel() == 0:
            renderings = [render(field, flat)]
        else:
            indices = torch.arange(len(flat.origins), device=flat.origins.device).split(1)
            renderings = [render(field, flat[index]) for index in indices]
        distance, status, residual, closest = (
            torch.cat([getattr(rendering, name) for rendering in renderings]).view(rays.shape)
            for name in ("distance", "status", "residual", "closest")
        )
        return Rendering(distance, status, rays.at(distance), residual, closest)

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """DIST, Eq. 11."""
        return Hinge(self.epsilon, self.silhouette_signed, self.silhouette_average).of(rendering.closest, mask)

    def _approximate(self, field: Field, rays: Rays) -> Rendering:
        with torch.no_grad():
            assert self.n_gradient_samples is not None  # checked above
            front = RayFront.on_sphere(rays, radius=self.sphere_radius, samples=self.n_gradient_samples)
            march_front(field, rays, front, Stepping(self.epsilon, active_only=False), self.steps)
        return approximate_rendering(field, rays, front, alpha=1.0, radius=self.sphere_radius)

    def _unrolled(self, field: Field, rays: Rays) -> Rendering:
        entry, leave, intersects = sphere_span(rays, self.sphere_radius)
        distance, status, value, closest = self._march(field, rays[intersects], entry[intersects], leave[intersects])
        missed = torch.full_like(intersects, Status.MISS, dtype=torch.int8)
        return assemble(
            rays,
            self.sphere_radius,
            distance=entry.masked_scatter(intersects, distance),
            status=missed.masked_scatter(intersects, status),
            residual=torch.zeros_like(entry).masked_scatter(intersects, value.detach()),
            closest=(intersects.nonzero().squeeze(-1), closest),
        )

    def _march(
        self, field: Field, rays: Rays, distance: Tensor, leave: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        status = torch.full_like(distance, Status.OUT_OF_STEPS, dtype=torch.int8)
        active = torch.ones_like(distance, dtype=torch.bool)
        last_value, closest = torch.zeros_like(distance), torch.full_like(distance, torch.inf)
        for step in range(self.steps):
            value = field(rays.at(distance))
            finite = value.isfinite()
            converged = active & (value.abs() < self.epsilon)
            last_value = torch.where(active & finite, value, last_value)
            closest = torch.where(active & finite & (value.abs() < closest.abs()), value, closest)
            if step == 0:
                started_inside = finite & (value < 0) & ~converged
                status[started_inside] = Status.STARTED_INSIDE
                active = active & ~started_inside
            active = active & finite
            moved = torch.where(active, distance + value, distance)
            left = active & ~converged & (moved > leave)
            status[left], status[converged] = Status.MISS, Status.HIT
            distance = torch.where(left, leave, moved)
            active = active & ~left & ~converged
        closest = torch.where(closest.isfinite(), closest, 1.0)
        return distance, status, last_value, closest
