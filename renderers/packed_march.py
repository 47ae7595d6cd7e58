"""A march that stops at the surface, or right behind it: where the field's magnitude is small, or its sign changes.

The rays that go on are rows of one table, so that a step costs few operations. Everything here runs without a graph;
`newton.py` finds the surface from where the rays stopped.
"""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.bracket import Bracket
from renderers.camera import Rays, sphere_span
from renderers.field import Values
from renderers.march import Level, pyramid
from renderers.waits import steps_between, values_where

LEVEL_STEPS = 5  # at each coarse level, most: with more, rays next to a silhouette crawl twice
HOLDS = 2.0  # times the distance to the finer rays: with a smaller empty sphere, finer rays begin behind its boundary
GAP = 1.4  # times the value: what a step may leave between two spheres; beside surfaces, where parts are small
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
    they turn out to be further apart than `TOLERATED` times `unseen`, the ray goes back to the boundary of the first,
    also from behind a surface: another one may lie between. It does not pass that one then.

    Source: ours, after Balint and Valasek 2018, "Accelerating sphere tracing", and Keinert et al. 2014, "Enhanced
    sphere tracing", Sec. 3.1, whose spheres touch.

    Args:
        epsilon: a ray has come near where the field's magnitude is at most this, in scene units.
        unseen: longest part of a ray that a step should leave between the spheres about its ends, in scene units; at
            most `GAP` times the value. From `FURTHER` / `TOLERATED` on no step is taken back.
    """

    epsilon: float
    unseen: float

    def length(self, value: Float[Tensor, " n"], slope: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The signed step for values; the slope is that by which they fell per distance, 1 where it is not known."""
        step = (2 * value + (GAP * value).clamp_max(self.unseen)) / (1 + slope.clamp(0, 1))
        return torch.where(value > 0, torch.minimum(step, value + FURTHER), value)


@dataclass(frozen=True)
class Column:
    """A column of `Reached.table`, to read and to write."""

    place: int

    def __get__(self, reached: "Reached", owner: type) -> Float[Tensor, " n"]:
        return reached.table[:, self.place]

    def __set__(self, reached: "Reached", values: Tensor) -> None:
        reached.table[:, self.place] = values


@dataclass
class Reached:
    """Where n rays are, and what is known of them: one row each, so that rays are chosen in one operation.

    Args:
        table: the columns below.
    """

    table: Float[Tensor, "n 14"]

    distance = Column(0)  # along each ray to where it stopped, or is evaluated next; beyond its end where it has LEFT
    value = Column(1)  # the last value of the field on each ray
    least_distance = Column(2)  # to the sample of least magnitude, which may have been evaluated on the coarse ray
    least = Column(3)  # the value of that sample, with its sign; infinite before the first
    free = Column(4)  # to the ray's own last value above the threshold; to where it begins before the first
    free_value = Column(5)  # that value; infinite before the first
    entry = Column(6)  # to where each ray begins
    leave = Column(7)  # to where it leaves the sphere
    stop = Column(8)  # a Stop
    # The least value from which each ray rose again, or its coarse ray, less how far apart these are: what the field is
    # at least on the way to where the ray stopped, but for the descent there.
    passed = Column(9)
    anchor = Column(10)  # to the last sample before `passed` fell to `CLEAR`; to where the ray begins if there is none
    cleared = Column(11)  # of a ray that has LEFT: to where its samples are above `CLEAR` from then on, or to its end
    grazed = Column(12)  # as `passed`, of the ray's own values alone; infinite before the first
    wall = Column(13)  # to the last sample behind a surface that a step was taken back from; infinite before the first

    @staticmethod
    def on_sphere(rays: Rays, radius: float) -> "Reached":
        """Every ray where it enters the sphere of `radius` about the origin, or at its origin if that lies inside."""
        entry, leave, meets = sphere_span(rays, radius)
        zero, infinite = torch.zeros_like(entry), torch.full_like(entry, torch.inf)
        stop = torch.where(meets, Stop.ON_THE_WAY, Stop.LEFT).to(entry.dtype)
        columns = (entry, zero, entry, infinite, entry, infinite, entry, leave, stop, infinite, entry, entry)
        return Reached(torch.stack([*columns, infinite, infinite], dim=1))

    def stopped(self, stop: Stop) -> Bool[Tensor, " n"]:
        """Which rays stopped so."""
        return self.stop == stop

    def some(self, index: Int[Tensor, " m"]) -> "Reached":
        """The same of some of the rays, as a copy."""
        return Reached(self.table.index_select(0, index))

    def begun_again(self, rays: Rays, anchored: Bool[Tensor, " n"], *, radius: float) -> "Reached":
        """The rays to be marched again, from their anchor where they are `anchored`, else from their beginning.

        What they have passed up to there stays known. Those that had LEFT end where they had passed all that is close,
        since they are free from there on.
        """
        again = Reached.on_sphere(rays, radius)
        again.distance = torch.where(anchored, self.anchor, again.distance)
        again.anchor = torch.where(anchored, self.anchor, again.anchor)
        again.cleared = torch.where(anchored, self.cleared, again.cleared)
        again.passed = torch.where(anchored, self.passed.clamp_min(CLEAR), again.passed)
        again.leave = torch.where(anchored & self.stopped(Stop.LEFT), self.cleared, again.leave)
        return again

    def put_back(self, index: Int[Tensor, " m"], others: "Reached") -> None:
        """Has m of the rays as `others` are now; both leave the sphere where these rays did."""
        others.leave = self.leave[index]
        self.table[index] = others.table

    def bracket(self) -> Bracket:
        """Between `free` and where each ray stopped; meant for rays that have CROSSED."""
        return Bracket(self.free, self.distance, self.free_value, self.value)

    def keep_least(self, distance: Float[Tensor, " n"], value: Float[Tensor, " n"]) -> None:
        """Keeps a sample of each ray where its magnitude is the least so far."""
        closer = value.isfinite() & (value.abs() < self.least.abs())
        self.least_distance = torch.where(closer, distance, self.least_distance)
        self.least = torch.where(closer, value, self.least)

    def note_stops(self, epsilon: float) -> None:
        """Says how each ray stopped, from where it did and the field's last value."""
        value = self.value
        inside = (value < 0) & self.free_value.isinf() & (self.distance <= self.entry)
        stop = torch.where(inside, Stop.INSIDE, torch.where(value < -epsilon, Stop.CROSSED, Stop.NEAR))
        stop = torch.where(self.distance > self.leave, Stop.LEFT, stop)
        self.stop = torch.where(value.isfinite(), stop, Stop.NOT_FINITE)
        self.value = value.nan_to_num(0.0, 0.0, 0.0)

    def split(
        self, parent: Int[Tensor, " m"], apart: Float[Tensor, " m"], child: "Reached", *, error: float
    ) -> "Reached":
        """The same of finer rays, each of which continues from its coarse `parent`: as far as that one's spheres reach.

        One whose coarse ray came close to nothing keeps its closest sample.

        Args:
            apart: how far each of the finer rays is from its coarse one, at most.
            child: the finer rays on the sphere, which are changed.
            error: most that the values of the coarse ray are off.
        """
        known = self.some(parent)
        inherits = ~known.stopped(Stop.INSIDE) & ~known.stopped(Stop.NOT_FINITE) & known.least.isfinite()
        inherits &= child.stopped(Stop.ON_THE_WAY)
        spheres = known.stopped(Stop.CROSSED) | (known.stopped(Stop.ON_THE_WAY) & known.free_value.isfinite())
        reach = torch.where(spheres, known.free + known.free_value, known.distance)
        start = torch.where(inherits, torch.maximum(reach - apart - error, child.entry), child.entry)
        ended = known.stopped(Stop.NEAR) | known.stopped(Stop.CROSSED)
        keeps = inherits & ~ended & (known.least > 0)
        gone, resumes = keeps & (start >= child.leave), torch.minimum(start, child.leave)
        child.distance = torch.where(gone, start, resumes)
        child.stop = torch.where(gone, Stop.LEFT, child.stop)
        child.value = torch.where(keeps, known.value, child.value)
        child.least_distance = torch.where(keeps, known.least_distance, child.least_distance)
        child.least = torch.where(keeps, known.least, child.least)
        passed = torch.where(ended, known.passed, torch.minimum(known.passed, known.least))
        child.passed = torch.where(inherits, passed - apart, child.passed)
        child.anchor = torch.where(~ended & (child.passed > CLEAR), resumes, child.entry)
        child.cleared = resumes
        return child


def approach(values: Values, rays: Rays, stride: Stride, *, steps: int, radius: float, error: float) -> Reached:
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
    reached, *finer = (Reached.on_sphere(each, radius) for each in [*(level.coarse for level in levels), rays.flat()])
    apart = [_apart(level, begun) for level, begun in zip(levels, [reached, *finer], strict=False)]
    widest = torch.stack([torch.nn.functional.pad(each, (0, 1)).amax() for each in apart]).tolist() if levels else []
    for level, child, each, most in zip(levels, finer, apart, widest, strict=True):
        clear = max(HOLDS * most + error, stride.epsilon)
        march(values, level.coarse, reached, replace(stride, epsilon=clear), LEVEL_STEPS)
        reached = reached.split(level.parent, each, child, error=error)
    march(values, rays.flat(), reached, stride, steps)
    return reached


def march(values: Values, rays: Rays, reached: Reached, stride: Stride, steps: int) -> None:
    """Moves flat rays [n, 3] by at most `steps` steps, in place."""
    index = reached.stopped(Stop.ON_THE_WAY).nonzero().squeeze(-1)
    origins, directions, columns = rays.origins[index], rays.directions[index], reached.table[index].T.contiguous()
    ended: list[tuple[Tensor, Tensor]] = []  # rays that have stopped, and their columns
    going, between = torch.ones_like(index, dtype=torch.bool), steps_between(index.device)
    for step in range(steps):
        if index.numel() == 0:
            break
        moving = Moving(*columns)
        if step % between:  # some may have stopped: they stay where they are
            at = torch.minimum(moving.distance, moving.leave)
            value = values_where(going, values, origins + at[:, None] * directions)
            after, goes_on = moving.after(value, stride)
            columns, going = torch.where(going, after, columns), going & goes_on
        else:
            columns, going = moving.after(values(origins + moving.distance[:, None] * directions), stride)
        if (step + 1) % between:
            continue
        onward = going.nonzero().squeeze(-1)
        if len(onward) < len(index):
            stopped = (~going).nonzero().squeeze(-1)
            ended.append((index[stopped], columns.index_select(1, stopped)))
            index, origins, directions = (kept.index_select(0, onward) for kept in (index, origins, directions))
            columns, going = columns.index_select(1, onward), going.index_select(0, onward)
    on_the_way = torch.nn.functional.pad(going, (sum(len(some) for some, _ in ended), 0))
    index, columns = (torch.cat(parts, -1) for parts in zip(*ended, (index, columns), strict=True))
    stopped = Reached(columns.T)
    stopped.note_stops(stride.epsilon)
    stopped.stop = torch.where(on_the_way, Stop.ON_THE_WAY, stopped.stop)
    reached.table.index_copy_(0, index, stopped.table)


class Moving(NamedTuple):
    """The columns of `Reached.table`, in their order, of m rays that go on."""

    distance: Tensor
    value: Tensor
    least_distance: Tensor
    least: Tensor
    free: Tensor
    free_value: Tensor
    entry: Tensor
    leave: Tensor
    stop: Tensor
    passed: Tensor
    anchor: Tensor
    cleared: Tensor
    grazed: Tensor
    wall: Tensor

    def after(self, value: Float[Tensor, " m"], stride: Stride) -> tuple[Float[Tensor, "14 m"], Bool[Tensor, " m"]]:
        """The columns after a step by the field's values where the rays are, and which of them go on.

        A ray that continues from its coarse ray may begin behind the surface: it goes back until the field is positive,
        to where it begins at the most. That of a ray that stops is at the value's place; beyond the end if it has left.
        """
        at, safe, magnitude, negative = self.distance, self.free_value, value.abs(), value < 0
        went, finite = at - self.free, magnitude < torch.inf
        above, behind = (value > stride.epsilon) & finite, (value < -stride.epsilon) & finite
        too_far = finite & (went - safe - magnitude > TOLERATED * stride.unseen)
        from_behind = too_far & negative
        closer = finite & ~from_behind & (magnitude < self.least.abs())
        wall = torch.where(from_behind, at, self.wall)
        positive, end = above & ~too_far, at + value
        left = positive & (end > self.leave) & self.wall.isinf()
        first = safe.isinf() & (at > self.entry)
        goes_on = too_far | (behind & first) | (above & ~left)
        slope = ((safe - value) / went).nan_to_num(1.0)  # a step too short for the dtype has no slope
        moved = torch.where(too_far, self.free + safe, at + stride.length(value, slope))
        moved = torch.minimum(torch.maximum(moved, self.entry), torch.minimum(self.leave, wall))
        rises = value > safe
        lower = torch.where(rises, safe, value)
        risen = torch.where(rises | left, lower, torch.inf)
        cleared = torch.where(left & (value <= CLEAR), self.leave, at)
        columns = Moving(
            distance=torch.where(goes_on, moved, torch.where(left, end, at)),
            value=value,
            least_distance=torch.where(closer, at, self.least_distance),
            least=torch.where(closer, value, self.least),
            free=torch.where(positive, at, self.free),
            free_value=torch.where(positive, value, safe),
            entry=self.entry,
            leave=self.leave,
            stop=self.stop,
            passed=torch.minimum(self.passed, risen),
            anchor=torch.where(torch.minimum(self.passed, lower) > CLEAR, at, self.anchor),
            cleared=torch.where(lower <= CLEAR, cleared, self.cleared),
            grazed=torch.minimum(self.grazed, risen),
            wall=wall,
        )
        return torch.stack(columns), goes_on


def _apart(level: Level, begun: Reached) -> Float[Tensor, " n"]:
    """How far each of the finer rays is from its coarse one within the sphere, at the same distance, at most.

    Args:
        begun: the coarse rays on the sphere.
    """
    coarse = level.coarse[level.parent]
    ends = (distance[level.parent] for distance in (begun.entry, begun.leave))
    return torch.maximum(*(torch.linalg.vector_norm(coarse.at(end) - level.fine.at(end), dim=-1) for end in ends))
