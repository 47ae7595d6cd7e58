"""A march that stops short of the surface: where the field's magnitude is small, or its sign changes.

The rays that go on are rows of one table, so that a step costs few operations. Everything here runs without a graph;
`newton.py` finds the surface from where the rays stopped.
"""

from dataclasses import dataclass, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.bracket import Bracket
from renderers.camera import Rays, sphere_span
from renderers.field import Values
from renderers.march import pyramid

LEVEL_STEPS = 5  # at each coarse level, most: with more, rays next to a silhouette crawl twice
HOLDS = 2.0  # times the distance to the finer rays: with a smaller empty sphere, finer rays begin behind its boundary
OVERLAP = 1.4  # times the value: what a step may leave between two spheres, beside surfaces that hide small parts
FURTHER = 0.03  # scene units: most by which a step is longer than the value; the warm start's margin grows with it
TOLERATED = 1.5  # times `unseen`: what a step may leave, since slopes change on the way
CLEAR = 0.1  # scene units: the march notes how far a ray came before its first value at most this


class Stop(IntEnum):
    """Where a ray stopped."""

    ON_THE_WAY = 0  # nowhere yet
    NEAR = 1  # the magnitude is small
    CROSSED = 2  # the value is negative, behind a positive one
    LEFT = 3  # at the end of the sphere, or the ray does not meet it
    INSIDE = 4  # the field is negative where the ray begins
    NOT_FINITE = 5  # the value is NaN or infinite


@dataclass(frozen=True)
class Stride:
    """How far a ray moves on a value of the field.

    The sphere about a sample whose radius is the value is empty. A step is so long that the spheres about its two ends
    are `unseen` apart if the field goes on to fall as between the last two samples: (2 value + unseen) / (1 + slope).
    Close to a surface they are less apart, in proportion to the value, since what is small casts small values. Where
    they turn out to be further apart than `unseen`, the ray goes back to the boundary of the first.

    Source: ours, after Balint and Valasek 2018, "Accelerating sphere tracing", and Keinert et al. 2014, "Enhanced
    sphere tracing", Sec. 3.1, whose spheres touch.

    Args:
        epsilon: a ray has come near where the field's magnitude is at most this, in scene units.
        unseen: of a ray, between the spheres of two samples, in scene units; less beside values below it.
    """

    epsilon: float
    unseen: float

    def length(self, value: Float[Tensor, " n"], slope: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The signed step for values; the slope is that by which they fell per distance, 1 where it is not known."""
        further = (2 * value + (OVERLAP * value).clamp_max(self.unseen)) / (1 + slope.clamp(0, 1))
        return torch.where(value > 0, torch.minimum(further, value + FURTHER), value)


@dataclass
class Reached:
    """Where n rays are, and what is known of them: one row each, so that rays are chosen in one operation.

    Args:
        table: the columns that the properties below name.
    """

    table: Float[Tensor, "n 13"]

    DISTANCE, VALUE, LEAST_DISTANCE, LEAST, FREE, FREE_VALUE, ENTRY, LEAVE, STOP = range(9)
    PASSED, ANCHOR, CLEARED, GRAZED = range(9, 13)

    @staticmethod
    def on_sphere(rays: Rays, radius: float) -> "Reached":
        """Every ray where it enters the sphere of `radius` about the origin, or at its origin if that lies inside."""
        entry, leave, meets = sphere_span(rays, radius)
        none = torch.full_like(entry, torch.inf)
        stop = torch.where(meets, float(Stop.ON_THE_WAY), float(Stop.LEFT)).to(entry.dtype)
        columns = (entry, torch.zeros_like(entry), entry, none, entry, none, entry, leave, stop)
        return Reached(torch.stack([*columns, none, entry, entry, none], dim=1))

    @property
    def distance(self) -> Float[Tensor, " n"]:
        """Along each ray to where it stopped, or is to be evaluated next; beyond its end where it has LEFT."""
        return self.table[:, self.DISTANCE]

    @property
    def value(self) -> Float[Tensor, " n"]:
        """The last value of the field on each ray."""
        return self.table[:, self.VALUE]

    @property
    def least_distance(self) -> Float[Tensor, " n"]:
        """Along each ray to its sample of least magnitude, which may have been evaluated on its coarse ray."""
        return self.table[:, self.LEAST_DISTANCE]

    @property
    def least(self) -> Float[Tensor, " n"]:
        """The value of that sample, with its sign; infinite before the first."""
        return self.table[:, self.LEAST]

    @property
    def free(self) -> Float[Tensor, " n"]:
        """Along each ray to its own last value above the threshold; to where it begins before the first."""
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

    @property
    def passed(self) -> Float[Tensor, " n"]:
        """The least value from which each ray rose again, or its coarse ray, less how far apart these are.

        That is what the field is at least on the way to where the ray stopped, but for the descent there.
        """
        return self.table[:, self.PASSED]

    @property
    def anchor(self) -> Float[Tensor, " n"]:
        """Along each ray to its last sample before `passed` fell to `CLEAR`; to where it begins if there is none."""
        return self.table[:, self.ANCHOR]

    @property
    def cleared(self) -> Float[Tensor, " n"]:
        """Along each ray that has LEFT, to where its samples are above `CLEAR` from then on; its end at the most."""
        return self.table[:, self.CLEARED]

    @property
    def grazed(self) -> Float[Tensor, " n"]:
        """The same of each ray's own values alone; infinite before the first."""
        return self.table[:, self.GRAZED]

    def stopped(self, stop: Stop) -> Bool[Tensor, " n"]:
        """Which rays stopped so."""
        return self.table[:, self.STOP] == float(stop)

    def some(self, index: Int[Tensor, " m"]) -> "Reached":
        """The same of some of the rays, as a copy."""
        return Reached(self.table[index])

    def begun_again(self, rays: Rays, anchored: Bool[Tensor, " n"], *, radius: float) -> "Reached":
        """The rays to be marched again, from their anchor where they are `anchored`, else from their beginning.

        What they have passed up to there stays known. Those that had LEFT end where they had passed all that is close,
        since they are free from there on.
        """
        start = Reached.on_sphere(rays, radius)
        columns = [self.DISTANCE, self.ANCHOR, self.CLEARED, self.PASSED, self.LEAVE]
        leave = torch.where(self.stopped(Stop.LEFT), self.cleared, self.leave)
        begun = torch.stack([self.anchor, self.anchor, self.cleared, self.passed.clamp_min(CLEAR), leave], dim=1)
        start.table[:, columns] = torch.where(anchored[:, None], begun, start.table[:, columns])
        return start

    def put_back(self, index: Int[Tensor, " m"], others: "Reached") -> None:
        """Has m of the rays as `others` are now; both leave the sphere where these rays did."""
        others.table[:, self.LEAVE] = self.leave[index]
        self.table[index] = others.table

    def bracket(self) -> Bracket:
        """Between `free` and where each ray stopped; meant for rays that have CROSSED."""
        return Bracket(self.free, self.distance, self.free_value, self.value)

    def keep_least(self, distance: Float[Tensor, " n"], value: Float[Tensor, " n"]) -> None:
        """Keeps a sample of each ray where its magnitude is the least so far."""
        closer = value.isfinite() & (value.abs() < self.least.abs())
        self.table[:, self.LEAST_DISTANCE] = torch.where(closer, distance, self.least_distance)
        self.table[:, self.LEAST] = torch.where(closer, value, self.least)

    def advance(self, value: Float[Tensor, " n"], stride: Stride) -> Bool[Tensor, " n"]:
        """Moves all rays by the field's values where they are; which of them go on.

        A ray that continues from its coarse ray may begin behind the surface: it goes back until the field is positive,
        to where it begins at the most.
        """
        at, epsilon = self.distance.clone(), stride.epsilon
        went, safe = at - self.free, self.free_value
        too_far = (value > epsilon) & (went - safe - value > TOLERATED * stride.unseen)
        rises = value > safe
        before = torch.where(rises, self.free_value, value)
        closest = torch.minimum(self.passed, before)
        self.keep_least(at, value)
        behind, own, begins = value < -epsilon, self.free_value.isfinite(), at <= self.entry
        finite = value.isfinite()
        left = (value > epsilon) & (at + value > self.leave) & finite & ~too_far
        back = behind & ~own & ~begins
        goes_on = back | ((value > epsilon) & ~left)
        stop = torch.where(begins & (value < 0) & ~own, Stop.INSIDE, torch.where(behind, Stop.CROSSED, Stop.NEAR))
        stop = torch.where(goes_on, Stop.ON_THE_WAY, torch.where(left, Stop.LEFT, stop))
        slope = ((safe - value) / went).nan_to_num(1.0)  # a step too short for the dtype has no slope
        moved = torch.where(too_far, self.free + safe, at + stride.length(value, slope))
        moved = torch.minimum(torch.maximum(moved, self.entry), self.leave)
        self.table[:, self.STOP] = torch.where(finite, stop, Stop.NOT_FINITE).to(value.dtype)
        self.table[:, self.VALUE] = torch.where(finite, value, 0.0)
        self.table[:, self.DISTANCE] = torch.where(goes_on & finite, moved, torch.where(left, at + value, at))
        cleared = torch.where(left & (value <= CLEAR), self.leave, at)
        self.table[:, self.CLEARED] = torch.where(before <= CLEAR, cleared, self.cleared)
        positive = (value > epsilon) & finite & ~too_far
        self.table[:, self.FREE] = torch.where(positive, at, self.free)
        self.table[:, self.FREE_VALUE] = torch.where(positive, value, self.free_value)
        self.table[:, self.ANCHOR] = torch.where(closest > CLEAR, at, self.anchor)
        for column in (self.PASSED, self.GRAZED):
            least = self.table[:, column]
            self.table[:, column] = torch.where(rises | left, torch.minimum(least, before), least)
        return goes_on & finite

    def split(
        self, parent: Int[Tensor, " m"], apart: Float[Tensor, " m"], rays: Rays, *, radius: float, error: float
    ) -> "Reached":
        """The same of finer rays, each of which continues from its coarse `parent`: as far as that one's spheres reach.

        One whose coarse ray came close to nothing keeps its closest sample.

        Args:
            apart: how far each of the finer rays is from its coarse one, at most.
            error: most that the values of the coarse ray are off.
        """
        child, known = Reached.on_sphere(rays, radius), self.some(parent)
        inherits = ~known.stopped(Stop.INSIDE) & ~known.stopped(Stop.NOT_FINITE) & known.least.isfinite()
        inherits &= child.stopped(Stop.ON_THE_WAY)
        reach = torch.where(known.stopped(Stop.CROSSED), known.free + known.free_value, known.distance)
        start = torch.where(inherits, torch.maximum(reach - apart - error, child.entry), child.entry)
        ended = known.stopped(Stop.NEAR) | known.stopped(Stop.CROSSED)
        keeps = inherits & ~ended & (known.least > 0)
        gone, begins = keeps & (start >= child.leave), torch.minimum(start, child.leave)
        child.table[:, self.DISTANCE] = torch.where(gone, start, begins)
        child.table[:, self.STOP] = torch.where(gone, float(Stop.LEFT), child.table[:, self.STOP])
        for column in (self.VALUE, self.LEAST_DISTANCE, self.LEAST):
            child.table[:, column] = torch.where(keeps, known.table[:, column], child.table[:, column])
        passed = torch.where(ended, known.passed, torch.minimum(known.passed, known.least))
        child.table[:, self.PASSED] = torch.where(inherits, passed - apart, child.passed)
        child.table[:, self.ANCHOR] = torch.where(~ended & (child.passed > CLEAR), begins, child.entry)
        child.table[:, self.CLEARED] = begins
        return child


def approach(values: Values, rays: Rays, stride: Stride, *, steps: int, radius: float, error: float = 0.0) -> Reached:
    """Marches all rays; those of an image coarse to fine (DIST, Sec. 3.2).

    A coarse ray stops before its empty sphere is too small to hold the finer rays next to it.

    Args:
        rays: of any leading shape; the answer has them in one row.
        stride: of rays that are not coarse ones; these come near earlier.
        steps: most steps per ray, beside those of its coarse rays.
        radius: of the sphere about the origin that holds the shape.
        error: most that one of the values is off.
    """
    levels = pyramid(rays) if rays.image else []
    reached = Reached.on_sphere(levels[0].coarse if levels else rays.flat(), radius)
    for level in levels:
        coarse, parent = level.coarse[level.parent], level.parent
        apart = _apart(coarse, level.fine, reached.entry[parent], reached.leave[parent])
        clear = HOLDS * (float(apart.max()) if apart.numel() else 0.0) + error
        march(values, level.coarse, reached, replace(stride, epsilon=max(clear, stride.epsilon)), LEVEL_STEPS)
        reached = reached.split(parent, apart, level.fine, radius=radius, error=error)
    march(values, levels[-1].fine if levels else rays.flat(), reached, stride, steps)
    return reached


def march(values: Values, rays: Rays, reached: Reached, stride: Stride, steps: int) -> None:
    """Moves flat rays [n, 3] by at most `steps` steps, in place."""
    index = reached.stopped(Stop.ON_THE_WAY).nonzero().squeeze(-1)
    origins, directions, moving = rays.origins[index], rays.directions[index], reached.some(index)
    for _ in range(steps):
        if index.numel() == 0:
            return
        goes_on = moving.advance(values(origins + moving.distance[:, None] * directions), stride)
        stopped, going = (~goes_on).nonzero().squeeze(-1), goes_on.nonzero().squeeze(-1)
        reached.table[index[stopped]] = moving.table[stopped]
        index, origins, directions, moving = index[going], origins[going], directions[going], moving.some(going)
    reached.table[index] = moving.table


def _apart(first: Rays, second: Rays, begin: Float[Tensor, " n"], end: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """How far two sets of n rays are apart at the same distance between `begin` and `end`, at most."""
    ends = (torch.linalg.vector_norm(first.at(distance) - second.at(distance), dim=-1) for distance in (begin, end))
    return torch.maximum(*ends)
