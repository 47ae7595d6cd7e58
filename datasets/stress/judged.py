"""First hits of a field that no closed form intersects, by the slow float64 reference, sure down to a thickness."""

from dataclasses import dataclass

from datasets.stress.solids import FirstHit
from renderers import reference
from renderers.camera import Rays
from renderers.field import Field
from renderers.rendering import Status


@dataclass(frozen=True)
class Judged:
    """A field whose first hits the reference finds.

    Args:
        field: to be asked in float64.
        lipschitz: a bound on the length of its gradient.
        thinnest: what is thinner along a ray than this may be missed, in scene units.
    """

    field: Field
    lipschitz: float
    thinnest: float

    def trace(self, rays: Rays) -> FirstHit:
        """The first hits of flat rays [n]; without gradient."""
        found = reference.trace(self.field, rays, lipschitz=self.lipschitz, least_step=self.thinnest, radius=1.0)
        return FirstHit(found.distance, found.hit, found.status == Status.STARTED_INSIDE)
