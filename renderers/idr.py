"""IDR's differentiable intersection: sphere tracing, with the implicit gradient (Yariv et al., NeurIPS 2020)."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field, Kind
from renderers.gradients import fixed_samples, implicit
from renderers.march import Front, Stepping, march
from renderers.rendering import Capabilities, Rendering, Status, assemble
from renderers.silhouette import CrossEntropy


@dataclass(frozen=True)
class IDR:
    """Sphere tracing whose hits have the exact gradient.

    Source: IDR (Yariv et al. 2020, arXiv 2003.09852), Sec. 3.1 (intersection) and 3.3 (masked rendering).
    Differentiable in: field parameters and rays, by the implicit rule of DVR, Eq. 8, and exactly, up to `epsilon`.
        What comes into view or leaves it has no part in the gradient of `distance`, only in that of the mask loss.
    Needs: a distance or a bound inside the sphere.
    Deviates from the paper: marches from the camera's side only, and does not sample rays that have not converged; the
        least field value on a ray is that of the marched samples. A ray that begins at negative values stops at once.

    Args:
        steps: most marching steps per ray.
        epsilon: a ray has converged where the field's magnitude is below this, in scene units.
        least_slope: see `gradients.implicit`.
        mask_sharpness, mask_weight: of the mask loss; see `silhouette.CrossEntropy`.
        sphere_radius: of the sphere about the origin that holds the shape.
    """

    steps: int
    epsilon: float
    least_slope: float
    mask_sharpness: float
    mask_weight: float
    sphere_radius: float

    capabilities: ClassVar[Capabilities] = Capabilities(
        needs=(Kind.DISTANCE, Kind.BOUND), field_gradient=True, ray_gradient=True
    )

    def __post_init__(self) -> None:
        check_at_least("steps", self.steps, 1, "50 converges")
        check_positive("epsilon", self.epsilon, "the paper uses 5e-5")
        check_positive("least_slope", self.least_slope, "1e-3 leaves all but the most grazing rays as they are")
        check_positive("mask_sharpness", self.mask_sharpness, "the paper begins at 50")
        check_at_least("mask_weight", self.mask_weight, 0, "the paper uses 100")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches without a graph, then attaches the implicit gradient to the hits."""
        flat = rays.flat()
        with torch.no_grad():
            front = Front.on_sphere(flat, radius=self.sphere_radius, samples=1)
            stepping = Stepping(self.epsilon, 1.0, None, None, active_only=True, careful_split=False)
            march(field, flat, front, stepping, self.steps)
        hit = (front.status == Status.HIT).nonzero().squeeze(-1)
        queried = front.sample_value[:, 0].isfinite().nonzero().squeeze(-1)
        found = implicit(field, flat[hit], front.distance[hit], least_slope=self.least_slope)
        least = fixed_samples(field, flat[queried], front.sample_distance[queried, 0], front.sample_value[queried, 0])
        return assemble(
            rays,
            self.sphere_radius,
            distance=front.distance.index_put((hit,), found),
            status=front.status,
            residual=front.value,
            closest=(queried, least),
        )

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """Cross entropy of a sigmoid of the least field value (Sec. 3.3); see `silhouette.CrossEntropy`."""
        return CrossEntropy(self.mask_sharpness, self.mask_weight).of(rendering, mask)
