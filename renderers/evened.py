"""Fields that are steeper than a distance, made as steep as one, so that a march may take their values for lengths."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from renderers.field import Coarse, Field, Values, Wrapper, coarse_of, points_in_ball

PAIRS, SPAN = 64, 0.1  # of points between which the steepness is measured; how far apart they are, in radii
MOST = 0.95  # quantile of the slopes between them: a few places do not decide the steps everywhere
STEEP = 1.2  # up to which values are taken for distances


@dataclass(frozen=True)
class Evened(Wrapper):
    """A field whose values are divided by how steep it is; the zero set is the same."""

    inner: Field
    steepness: float

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.inner(points) / self.steepness

    @property
    def coarse(self) -> Coarse | None:
        """The coarse values of the field, divided as well."""
        offered, by = coarse_of(self.inner), self.steepness
        return offered and Coarse(lambda points: offered.values(points) / by, offered.error / by)


def evened(field: Field, steepness: float) -> Field:
    """The field divided by its steepness; itself where that is 1."""
    if steepness == 1:
        return field
    return Evened(field, steepness)  # pyright: ignore[reportReturnType] (it is frozen)


@torch.no_grad()
def measured_steepness(values: Values, like: Float[Tensor, "*batch 3"], *, radius: float) -> float:
    """How steep values are between pairs of points in the sphere; 1 where that is at most `STEEP`.

    Values that are not finite do not count. Those behind the surface do: in front of it most fields are as steep.

    Args:
        like: points of the dtype and device at which values are asked.
        radius: of the sphere about the origin in which the points lie.
    """
    points = radius * points_in_ball(PAIRS).to(like)
    towards = torch.nn.functional.normalize(points.roll(1, dims=0) - points, dim=-1)
    here, there = values(torch.cat([points, points + SPAN * radius * towards])).chunk(2)
    slopes = (here - there)[here.isfinite() & there.isfinite()].abs() / (SPAN * radius)
    steepness = float(slopes.quantile(MOST)) if len(slopes) else 1.0
    return steepness if steepness > STEEP else 1.0
