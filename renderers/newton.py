"""Newton: a march across the surface, and a Newton step on the value and slope that its gradient needs."""

from dataclasses import dataclass, field, fields, replace
from typing import ClassVar

from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_choice, check_positive
from renderers.field import Field
from renderers.rendering import OF_LENGTHS, Capabilities, Rendering, check_kind
from renderers.silhouette import AVERAGES, Hinge
from renderers.tracer import Tracer
from renderers.warm import Memory, warm_trace


@dataclass(frozen=True)
class Newton:
    """Coarse-to-fine marching until the sign changes, a dense search for the rays that are left, and a Newton step.

    The implicit gradient asks for the value and the slope at every hit. They also give the distance to second order, so
    that the march may step behind the surface.

    Source: ours. The march follows DIST, Sec. 3.2; the search DVR, Sec. 3.3; the gradient DVR, Eqs. 8 and 11.
    Differentiable in: field parameters and rays, by the implicit rule at the point before the last Newton step: off by
        that step times the surface's curvature; the step is at most `tracer.LONGEST` times the cosine of incidence, but
        for hits on surfaces flatter than `least_slope` along the ray.
        What comes into view or leaves it has no part in the gradient of `distance`. That of `closest` is exact at a
        fixed sample, and left to the loss (`rendering.closest_values`); on a hit, `closest` is 0.
    Needs: a distance or a bound inside the sphere; a trained network is close enough to one. Where a field is steeper,
        its values are divided by how steep it is nearly everywhere, see `tracer.Evened`; those of a bound never are.
        Its gradient towards points by automatic differentiation, also where no gradient is wanted.
    Deviates from the paper: there is none. What may be missed: what is at most 1.5 `unseen` long on a ray, of a field
        that is a distance; on the rays of the dense search, what is thinner than the spacing of its samples, unless it
        is next to the least one; in an image, what rays meet at the rim of the sphere in front of where their coarse
        ray enters it. A ray that passes an edge closer than `march_epsilon` may hit it. `residual` is the value before
        the last step. Where the field offers coarse values, twice their error more of a ray may be unseen, and a miss's
        `closest` is off by the error: rays that came within it of the surface are marched again, on the field itself.

    Args:
        steps, march_epsilon, unseen, newton_steps, search_samples, search_steps, least_slope, sphere_radius,
            coarse: see `tracer.Tracer`.
        silhouette_epsilon, silhouette_signed, silhouette_average: see `silhouette.Hinge`.
        warm: whether a rendering in an optimisation begins where that of the same rays ended before; see `warm`.
        memory: of the optimisation.
        remembers: whether renderings are remembered; set by `at_iteration`.
    """

    steps: int
    march_epsilon: float
    unseen: float
    newton_steps: int
    search_samples: int
    search_steps: int
    least_slope: float
    sphere_radius: float
    coarse: bool
    silhouette_epsilon: float
    silhouette_signed: bool
    silhouette_average: str
    warm: bool
    memory: Memory = field(default_factory=Memory, repr=False, compare=False)
    remembers: bool = False

    capabilities: ClassVar[Capabilities] = OF_LENGTHS

    def __post_init__(self) -> None:
        _ = self.tracer  # which checks its settings
        check_positive("silhouette_epsilon", self.silhouette_epsilon, "DIST uses 5e-5")
        check_choice("silhouette_average", self.silhouette_average, AVERAGES)

    @property
    def tracer(self) -> Tracer:
        """What finds the surface."""
        return Tracer(**{setting.name: getattr(self, setting.name) for setting in fields(Tracer)})

    def at_iteration(self, iteration: int) -> "Newton":
        """With `warm`, a renderer that begins where the same rays ended before; iteration 0 forgets them."""
        if iteration == 0:
            self.memory.forget()
        return replace(self, remembers=self.warm)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches and searches without a graph; the Newton steps carry the gradient."""
        check_kind(self, field)
        if self.remembers:
            return warm_trace(self.tracer, self.memory, field, rays)
        return self.tracer.render_anew(field, rays)

    def fresh(self) -> "Newton":
        """The same renderer with an empty memory, for another optimisation."""
        return replace(self, memory=Memory())

    def final_notes(self) -> list[str]:
        """What the audit of the warm start found."""
        return self.memory.notes()

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """DIST, Eq. 11; see `silhouette.Hinge`."""
        hinge = Hinge(self.silhouette_epsilon, self.silhouette_signed, self.silhouette_average)
        return hinge.of_rendering(field, rays, rendering, mask)
