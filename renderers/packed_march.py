"""A march that stops short of the surface: where the field's magnitude is small, or its sign changes.

The rays that go on are rows of one table, so that a step costs few operations. Everything here runs without a graph;
`newton.py` finds the surface from where the rays stopped.
"""

from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.field import Field
from renderers.march import CAREFUL, PYRAMID, PYRAMID_STEPS, parents

SET_BACK = 0.5  # of the way between a ray and its coarse ray, where that stopped: less begins behind the surface


class Stop(IntEnum):
    """Where a ray stopped."""

    ON_THE_WAY = 0  # nowhere yet
    NEAR = 1  # the magnitude is small
    CROSSED = 2  # the value is negative, behind a positive one
    LEFT = 3  # at the end of the sphere, or the ray does not meet it
    INSIDE = 4  # the field is negative where the ray begins
    NOT_FINITE = 5  # the value is NaN or infinite


@dataclass(frozen=True)
class Pace:
    """How far a ray moves on a value, and where it stops.

    Args:
        near: a ray stops where the field's magnitude is at most this, in scene units.
        alpha: the step is alpha times the value (DIST, Sec. 3.2).
        extra_step_cap: bound on (alpha - 1) times the value, the part of a step that may pass a surface.
    """

    near: float
    alpha: float
    extra_step_cap: float

    def step(self, value: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The signed step along the ray for a field value."""
        return value + ((self.alpha - 1) * value).clamp(-self.extra_step_cap, self.extra_step_cap)


@dataclass(frozen=True)
class Reached:
    """Where n rays are, and what is known of them: one row each, so that rays are chosen in one operation.

    Args:
        table: the columns that the properties below name.
    """

    table: Float[Tensor, "n 9"]

    DISTANCE, VALUE, LEAST_DISTANCE, LEAST, FREE, FREE_VALUE, ENTRY, LEAVE, STOP = range(9)

    @staticmethod
    def on_sphere(rays: Rays, radius: float) -> "Reached":
        """Every ray where it enters the sphere of `radius` about the origin, or at its origin if that lies inside."""
        entry, leave, meets = sphere_span(rays, radius)
        none = torch.full_like(entry, torch.inf)
        stop = torch.where(meets, float(Stop.ON_THE_WAY), float(Stop.LEFT)).to(entry.dtype)
        columns = (entry, torch.zeros_like(entry), entry, none, entry, none, entry, leave, stop)
        return Reached(torch.stack(columns, dim=1))

    @property
    def distance(self) -> Float[Tensor, " n"]:
        """Along each ray to where it stopped, or is to be evaluated next."""
        return self.table[:, self.DISTANCE]

    @property
    def value(self) -> Float[Tensor, " n"]:
        """The last value of the field on each ray."""
        return self.table[:, self.VALUE]

    @property
    def least_distance(self) -> Float[Tensor, " n"]:
        """Along each ray to its sample of least magnitude."""
        return self.table[:, self.LEAST_DISTANCE]

    @property
    def least(self) -> Float[Tensor, " n"]:
        """The value of that sample, with its sign; infinite before the first."""
        return self.table[:, self.LEAST]

    @property
    def free(self) -> Float[Tensor, " n"]:
        """Along each ray to its last positive value; to where it begins before the first."""
        return self.table[:, self.FREE]

    @property
    def free_value(self) -> Float[Tensor, " n"]:
        """That value; infinite before the first."""
        return self.table[:, self.FREE_VALUE]

    @property
    def entry(self) -> Float[Tensor, " n"]:
        """Along each ray to where it begins."""
        return self.table[:, self.ENTRY]

    @property
    def leave(self) -> Float[Tensor, " n"]:
        """Along each ray to where it leaves the sphere."""
        return self.table[:, self.LEAVE]

    def stopped(self, *stops: Stop) -> Bool[Tensor, " n"]:
        """Which rays stopped in one of these ways."""
        stop = self.table[:, self.STOP]
        return torch.isin(stop, torch.tensor(stops, dtype=stop.dtype, device=stop.device))

    def some(self, index: Int[Tensor, " m"]) -> "Reached":
        """The same of some of the rays, as a copy."""
        return Reached(self.table[index])

    def see(self, distance: Float[Tensor, " n"], value: Float[Tensor, " n"]) -> None:
        """Keeps a sample of each ray where its magnitude is the least so far, in place."""
        closer = value.isfinite() & (value.abs() < self.least.abs())
        self.table[:, self.LEAST_DISTANCE] = torch.where(closer, distance, self.least_distance)
        self.table[:, self.LEAST] = torch.where(closer, value, self.least)

    def advance(self, value: Float[Tensor, " n"], pace: Pace) -> Bool[Tensor, " n"]:
        """Moves all rays by the field's values where they are, in place; which of them go on.

        A ray that continues from its coarse ray may begin behind the surface: it goes back until the field is positive.
        """
        at = self.distance.clone()
        self.see(at, value)
        moved = at + pace.step(value)
        behind, own = value < -pace.near, self.free_value.isfinite()
        back = behind & ~own & (at > self.entry) & (moved >= self.entry)
        left = (value > pace.near) & (moved > self.leave)
        stop = torch.where(behind, torch.where(own, Stop.CROSSED, Stop.INSIDE), torch.where(left, Stop.LEFT, Stop.NEAR))
        goes_on = back | ((value > pace.near) & ~left)
        stop = torch.where(goes_on, Stop.ON_THE_WAY, stop)
        finite = value.isfinite()
        self.table[:, self.STOP] = torch.where(finite, stop, Stop.NOT_FINITE).to(value.dtype)
        self.table[:, self.VALUE] = torch.where(finite, value, 0.0)
        self.table[:, self.DISTANCE] = torch.where(goes_on, moved, torch.where(left, self.leave, at))
        positive = value > 0
        self.table[:, self.FREE] = torch.where(positive, at, self.free)
        self.table[:, self.FREE_VALUE] = torch.where(positive, value, self.free_value)
        return goes_on & finite

    def split(self, parent: Int[Tensor, " m"], coarse: Rays, rays: Rays, *, radius: float) -> "Reached":
        """The same of finer rays, each of which continues from its coarse `parent`.

        Where that stopped at a surface, or one is about as close as the two rays are apart, a ray begins before its
        closest sample. One whose coarse ray met nothing keeps its samples.
        """
        child, known = Reached.on_sphere(rays, radius), self.some(parent)
        inherits = ~known.stopped(Stop.INSIDE, Stop.NOT_FINITE) & known.least.isfinite()
        inherits &= child.stopped(Stop.ON_THE_WAY)
        at = known.least_distance[:, None]
        apart = torch.linalg.vector_norm(
            coarse.origins[parent] + at * coarse.directions[parent] - rays.origins - at * rays.directions, dim=-1
        )
        ended = known.stopped(Stop.NEAR, Stop.CROSSED)
        close = ended | (known.least.abs() <= CAREFUL * apart)
        start = torch.where(close, known.least_distance - SET_BACK * apart, known.distance)
        start = torch.where(inherits, torch.maximum(start, child.entry), child.entry)
        child.table[:, self.DISTANCE] = start
        gone = inherits & (start >= child.leave)
        child.table[gone, self.STOP] = float(Stop.LEFT)
        keeps = inherits & ~ended
        columns = [self.VALUE, self.LEAST_DISTANCE, self.LEAST]
        child.table[:, columns] = torch.where(keeps[:, None], known.table[:, columns], child.table[:, columns])
        return child


def approach(field: Field, rays: Rays, pace: Pace, *, steps: int, radius: float) -> Reached:
    """Marches all rays; those of an image coarse to fine, as in `march.march_coarse_to_fine`.

    Args:
        rays: of any leading shape; the answer has them in one row.
        steps: most steps per ray, those of its coarse rays included.
        radius: of the sphere about the origin that holds the shape.
    """
    if not rays.image:
        reached = Reached.on_sphere(rays.flat(), radius)
        _march(field, rays.flat(), reached, pace, steps)
        return reached
    level = rays.coarser(PYRAMID[0])
    reached = Reached.on_sphere(level.flat(), radius)
    for factor in (*PYRAMID[1:], 1):
        _march(field, level.flat(), reached, pace, min(PYRAMID_STEPS, steps))
        steps = max(steps - PYRAMID_STEPS, 0)
        finer = rays.coarser(factor) if factor > 1 else rays
        parent = parents(level.shape, finer.shape, rays.origins.device)
        reached = reached.split(parent, level.flat(), finer.flat(), radius=radius)
        level = finer
    _march(field, level.flat(), reached, pace, steps)
    return reached


def _march(field: Field, rays: Rays, reached: Reached, pace: Pace, steps: int) -> None:
    """Moves flat rays [n, 3] by at most `steps` steps, in place."""
    index = reached.stopped(Stop.ON_THE_WAY).nonzero().squeeze(-1)
    origins, directions, moving = rays.origins[index], rays.directions[index], reached.some(index)
    for _ in range(steps):
        if index.numel() == 0:
            return
        goes_on = moving.advance(field(origins + moving.distance[:, None] * directions), pace)
        stopped, going = (~goes_on).nonzero().squeeze(-1), goes_on.nonzero().squeeze(-1)
        reached.table[index[stopped]] = moving.table[stopped]
        index, origins, directions, moving = index[going], origins[going], directions[going], moving.some(going)
    reached.table[index] = moving.table
