"""DIST: fast differentiable sphere tracing of a network (Liu et al., CVPR 2020)."""

from dataclasses import dataclass, fields
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Field, estimate_lipschitz, marching_values
from renderers.gradients import approximate_rendering
from renderers.rendering import DISTANCE_CAPABILITIES, Capabilities, Rendering, check_kind
from renderers.silhouette import AVERAGES, Hinge
from renderers.tracing.march import RayFront, Stepping, march_coarse_to_fine, march_front


@dataclass(frozen=True)
class DIST:
    """Differentiable sphere tracing with every strategy of the paper as a switch.

    Source: DIST, Secs. 3.1 to 3.4, A.1 to A.3, B.2.
    Differentiable in: field parameters and rays, by the approximate rule of Eq. 4. The gradient of `distance` has the
        right direction at each pixel and a wrong scale, alpha * K times the field's slope along the ray; see
        `gradients.attach_approximate_gradient`. The gradient of `closest` is exact at a fixed sample.
    Needs: a distance or a bound inside the sphere. A trained decoder is used as a distance.
    Deviates from the paper: `extra_step_cap`, `careful_split`, `step_back`, `least_step`, `slope_samples` and `coarse`
        are ours. `silhouette_signed` and the `silhouette_average` "missed_plus_spurious" are as in the official code;
        Eq. 11 states neither sign nor average. `step_clamp` is as in the official code, for networks that were trained
        on distances truncated at 0.1. A ray that starts at negative values stops at once with STARTED_INSIDE. Coarse to
        fine applies to rays of an image (`Rays.image`); others march at full resolution.

    Args:
        steps: maximum marching steps per ray.
        epsilon, alpha, extra_step_cap, step_clamp, active_only, careful_split, step_back, least_step, relaxation: see
            `tracing.march.Stepping`.
        slope_samples: points at which the Lipschitz constant is estimated before the march
            (`field.estimate_lipschitz`); values are divided by it. 0 trusts the field.
        coarse_to_fine: start with one ray per 4 x 4 pixels; unrelated to `coarse`.
        n_gradient_samples: K, the number of samples of smallest magnitude that carry the gradient of a hit.
        sphere_radius: of the sphere about the origin that contains the shape.
        silhouette_signed, silhouette_average: see `silhouette.Hinge`.
        coarse: march on the field's coarse values away from the surface, if it has any; see `field.marching_values`.
            Their error shortens steps and never lengthens them, since values are reduced by it. Without a gradient,
            `closest` of a missed ray is such an approximate value.
    """

    steps: int
    epsilon: float
    alpha: float
    extra_step_cap: float | None
    step_clamp: float | None
    active_only: bool
    coarse_to_fine: bool
    careful_split: bool
    step_back: bool
    least_step: float
    relaxation: float
    slope_samples: int
    n_gradient_samples: int
    sphere_radius: float
    silhouette_signed: bool
    silhouette_average: str
    coarse: bool = False

    capabilities: ClassVar[Capabilities] = DISTANCE_CAPABILITIES

    def __post_init__(self) -> None:
        check_at_least("steps", self.steps, 1, "the paper uses 50 to 100")
        check_positive("epsilon", self.epsilon, "the paper uses 5e-5")
        check_at_least("alpha", self.alpha, 1, "1 is plain sphere tracing, the paper uses 1.5")
        check_at_least("n_gradient_samples", self.n_gradient_samples, 1, "the paper uses 1 to 3")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")
        check_choice("silhouette_average", self.silhouette_average, AVERAGES)
        if not 0 <= self.relaxation <= 1:
            raise ValueError(f"relaxation must lie between 0 (none) and 1, not {self.relaxation:g}: 0.3 works")
        if self.relaxation and not self.step_back:
            raise ValueError("relaxation needs step_back=true: its steps may pass a surface")
        check_at_least("least_step", self.least_step, 0, "0 switches it off")
        check_at_least("slope_samples", self.slope_samples, 0, "0 switches it off; 4096 cost as much as 64 x 64 pixels")
        for name in ("extra_step_cap", "step_clamp"):
            if getattr(self, name) is not None:
                check_positive(name, getattr(self, name), f"{name}=null switches it off")

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches without a graph, then evaluates again the samples that carry the gradient."""
        check_kind(self, field)
        with torch.no_grad():
            front = self._trace(field, rays)
        return approximate_rendering(field, rays, front, alpha=self.alpha, radius=self.sphere_radius)

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """DIST, Eq. 11."""
        return Hinge(self.epsilon, self.silhouette_signed, self.silhouette_average).of(rendering.closest, mask)

    def _trace(self, field: Field, rays: Rays) -> RayFront:
        settings = {key.name: getattr(self, key.name) for key in fields(Stepping) if key.name != "slope"}
        slope, samples = 1.0, self.slope_samples
        if samples:
            slope = estimate_lipschitz(field, like=rays.origins, radius=self.sphere_radius, samples=samples)
        stepping = Stepping(**settings, slope=slope)
        values, steps = marching_values(field, self.steps, epsilon=self.epsilon, coarse=self.coarse)
        if self.coarse_to_fine and rays.image:
            return march_coarse_to_fine(
                values, rays, stepping, steps=steps, radius=self.sphere_radius, samples=self.n_gradient_samples
            )
        flat = rays.flat()
        front = RayFront.on_sphere(flat, radius=self.sphere_radius, samples=self.n_gradient_samples)
        march_front(values, flat, front, stepping, steps)
        return front
