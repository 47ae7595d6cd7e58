"""Newton: a march across the surface, and a Newton step on the value and slope that its gradient needs."""

from dataclasses import dataclass, field, replace
from typing import ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_choice, check_positive
from renderers.field import Field
from renderers.newton.tracer import Tracer
from renderers.newton.warm import Memory, render_warm
from renderers.rendering import DISTANCE_CAPABILITIES, Capabilities, Rendering, check_kind
from renderers.silhouette import AVERAGES, Hinge


@dataclass(frozen=True)
class Newton(Tracer):
    """Coarse-to-fine marching until the sign changes, a dense search for the unfinished rays, and a Newton step.

    The implicit gradient needs the value and the slope at every hit. A Newton step on them gives the distance to second
    order, so that the march may step behind the surface.

    Source: ours. The march follows DIST, Sec. 3.2; the search DVR, Sec. 3.3; the gradient DVR, Eqs. 8 and 11.
    Differentiable in: field parameters and rays, by the implicit rule at the point before the last Newton step. The
        error is that step times the surface's curvature. The step is at most `tracer.MAX_NEWTON_STEP` times the cosine
        of incidence, except on surfaces flatter than `least_slope` along the ray.
        The gradient of `distance` lacks the visibility gradient. The gradient of `closest` is exact at a fixed sample;
        the loss attaches it (`rendering.closest_values`). On a hit, `closest` is 0.
    Needs: a distance or a bound inside the sphere; a trained network is close enough to one. If a distance is steeper,
        its values are divided by its typical slope (`tracer.SlopeNormalised`); the values of a bound never are. The
        field's gradient towards points by automatic differentiation, even if no gradient is needed.
    Deviates from the paper: it has no paper. It may miss: parts at most 1.5 `unseen` long on a ray, if the field is a
        distance; on rays of the dense search, parts thinner than the spacing of its samples, unless next to the
        smallest one; in an image, parts at the edge of the sphere, in front of where the coarse ray enters it. A ray
        that passes an edge closer than `march_epsilon` may hit it. `residual` is the value before the last step. With
        coarse values, missed parts may be longer by twice their error, and a miss's `closest` is off by the error. Rays
        that came within the error of the surface are marched again, on the field itself.

    Args:
        steps, march_epsilon, unseen, newton_steps, search_samples, search_steps, least_slope, sphere_radius,
            coarse: see `tracer.Tracer`.
        silhouette_epsilon, silhouette_signed, silhouette_average: see `silhouette.Hinge`.
        warm: whether renderings in an optimisation start where the last one of the same rays ended; see `warm`.
        memory: of the optimisation.
        remembers: whether renderings are stored in the memory; set by `at_iteration`.
    """

    silhouette_epsilon: float
    silhouette_signed: bool
    silhouette_average: str
    warm: bool
    memory: Memory = field(default_factory=Memory, repr=False, compare=False)
    remembers: bool = False

    capabilities: ClassVar[Capabilities] = DISTANCE_CAPABILITIES

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("silhouette_epsilon", self.silhouette_epsilon, "DIST uses 5e-5")
        check_choice("silhouette_average", self.silhouette_average, AVERAGES)

    def at_iteration(self, iteration: int) -> "Newton":
        """With `warm`, a renderer that starts where the same rays ended before; iteration 0 clears the memory."""
        if iteration == 0:
            self.memory.forget()
        return replace(self, remembers=self.warm)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches and searches without a graph; the Newton steps carry the gradient."""
        check_kind(self, field)
        if self.remembers:
            return render_warm(self, self.memory, field, rays)
        return self.render_cold(field, rays)

    def with_empty_memory(self) -> "Newton":
        """The same renderer, for another optimisation."""
        return replace(self, memory=Memory())

    def final_notes(self) -> list[str]:
        """The result of the warm start's audit."""
        return self.memory.notes()

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """DIST, Eq. 11; see `silhouette.Hinge`."""
        hinge = Hinge(self.silhouette_epsilon, self.silhouette_signed, self.silhouette_average)
        return hinge.of_rendering(field, rays, rendering, mask)
