"""Stepping loops that renderers share: all rays or the active ones, plain or aggressive, coarse to fine.

Everything here runs without a graph; `gradients.py` says how a gradient is attached afterwards, and `naive.py` keeps
the graph instead.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.field import Values
from renderers.rendering import Status
from renderers.waits import steps_between, values_where

PYRAMID = (4, 2)  # side of a coarse ray's block in pixels, at the first levels (DIST, Sec. 3.2)
PYRAMID_STEPS = 3  # steps at each of these levels
TOUCHING = 1.0001  # times the radii of two empty spheres: at normal incidence they just touch
STEEPEST_FALL = -1.0  # slope of a distance along a ray towards a plane: the step is then the value
FASTEST_RISE = 0.5  # slope above which a step grows no more: it is four times the value
CAREFUL = 2.0  # careful_split: the closest sample is not the closest point, so "closer" allows for twice the distance


@dataclass(frozen=True)
class Stepping:
    """How far a ray moves on a value of the field.

    Args:
        epsilon: a ray has converged where the field's magnitude is below this, in scene units (DIST, Sec. 3.2).
        alpha: the step is alpha times the value; 1 is sphere tracing, more is aggressive marching.
        extra_step_cap: bound on (alpha - 1) times the value, the part of a step that may pass a surface; None for none.
        step_clamp: bound on the magnitude of the value, before alpha, as in the official code; None for none.
        active_only: evaluate the field only for rays that have not finished; else for every ray that meets the sphere.
        careful_split: a ray continues not from the end of its coarse ray, but from the coarse ray's closest sample, if
            the surface is about as close there as the two rays are apart. Else rays next to an edge begin behind it.
        step_back: a step longer than the value is shortened to the value where the empty spheres about its two ends do
            not meet (Keinert et al. 2014, "Enhanced sphere tracing", Sec. 3.1), and where it would leave the bounding
            sphere. Later steps may be longer than the value again.
        least_step: forward steps are at least this long, in scene units, but for one that follows a step back from
            behind the surface, else a ray would never converge there; 0 for none.
        slope: bound on the length of the field's gradient, by which values are divided before a step is made of them.
        relaxation: weight of the last slope of the values along the ray in the running one, m: a step is then
            2 / (1 - m) times the value, in place of alpha, so that on a plane the empty spheres touch; 0 for none. It
            needs `step_back` (Bálint and Valasek 2018, "Accelerating Sphere Tracing"; Bán and Valasek 2023, "Automatic
            Step Size Relaxation in Sphere Tracing").
    """

    epsilon: float
    alpha: float = 1.0
    extra_step_cap: float | None = None
    step_clamp: float | None = None
    active_only: bool = True
    careful_split: bool = False
    step_back: bool = False
    least_step: float = 0.0
    slope: float = 1.0
    relaxation: float = 0.0

    def length(self, value: Float[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
        """The signed step along the ray for a field value."""
        value = self.reach(value)
        if self.step_clamp is not None:
            value = value.clamp(-self.step_clamp, self.step_clamp)
        if self.alpha == 1:
            return value
        extra = (self.alpha - 1) * value
        if self.extra_step_cap is not None:
            extra = extra.clamp(-self.extra_step_cap, self.extra_step_cap)
        return value + extra

    def reach(self, value: Float[Tensor, "*rays"]) -> Float[Tensor, "*rays"]:
        """The signed length within which a field value says that there is no surface."""
        return value if self.slope == 1 else value / self.slope


@dataclass
class Front:
    """The current ends of n marching rays, and the `samples` least field values found on each."""

    distance: Float[Tensor, " n"]
    entry: Float[Tensor, " n"]  # of the bounding sphere; a ray that moves back beyond it began inside
    leave: Float[Tensor, " n"]
    meets: Bool[Tensor, " n"]  # the ray meets the bounding sphere
    active: Bool[Tensor, " n"]
    fresh: Bool[Tensor, " n"]  # not evaluated yet, on this ray or on its coarse ray
    status: Int8[Tensor, " n"]
    value: Float[Tensor, " n"]
    sample_distance: Float[Tensor, "n samples"]
    sample_value: Float[Tensor, "n samples"]  # infinite where there is no such sample
    past: Float[Tensor, "n 3"]  # see `Moving`

    @staticmethod
    def on_sphere(rays: Rays, *, radius: float, samples: int) -> "Front":
        """Every ray where it enters the sphere of `radius` about the origin, or at its origin if that lies inside."""
        entry, leave, meets = sphere_span(rays, radius)
        return Front(
            distance=entry,
            entry=entry.clone(),
            leave=leave,
            meets=meets,
            active=meets.clone(),
            fresh=torch.ones_like(meets),
            status=torch.where(meets, Status.OUT_OF_STEPS, Status.MISS).to(torch.int8),
            value=torch.zeros_like(entry),
            sample_distance=entry[:, None].repeat(1, samples),
            sample_value=entry.new_full((len(entry), samples), torch.inf),
            past=entry.new_tensor([0.0, 0.0, STEEPEST_FALL]).repeat(len(entry), 1),
        )

    def split(
        self, parent: Int[Tensor, " children"], coarse: Rays, rays: Rays, *, radius: float, careful: bool
    ) -> "Front":
        """The front of finer rays, each continuing from its coarse `parent`; for `careful`, see Stepping.

        A ray whose coarse ray missed the sphere, or started inside the shape, begins anew. One whose coarse ray has
        left the sphere has left it too. The samples of a coarse ray without a hit are kept: its closest one may lie
        behind the finer ray's start.
        """
        child = Front.on_sphere(rays, radius=radius, samples=self.sample_distance.shape[1])
        status, start = self.status[parent], self.distance[parent]
        least, closest = self.sample_value[parent], self.sample_distance[parent]
        inherits = self.meets[parent] & (status != Status.STARTED_INSIDE)
        if careful:
            apart = torch.linalg.vector_norm(coarse[parent].at(closest[:, 0]) - rays.at(closest[:, 0]), dim=-1)
            start = torch.where(least[:, 0].abs() <= CAREFUL * apart, closest[:, 0], start)
        child.distance = torch.where(inherits, torch.maximum(start, child.distance), child.distance)
        child.fresh = ~inherits
        inherits = inherits & child.meets
        gone = inherits & (child.distance >= child.leave)
        child.active &= ~gone
        child.status = torch.where(gone, Status.MISS, child.status).to(torch.int8)
        child.value = torch.where(gone, self.value[parent], child.value)
        keeps = (inherits & (status != Status.HIT))[:, None]
        child.sample_distance = torch.where(keeps, closest, child.sample_distance)
        child.sample_value = torch.where(keeps, least, child.sample_value)
        return child

    def finish(self, moved: Bool[Tensor, " n"], stepping: Stepping) -> None:
        """Says of the rays that have `moved` where and how they ended, or that they go on."""
        unsettled = _unsettled(self.value.abs(), self.past.T, stepping)
        behind, left = self.distance < self.entry - stepping.epsilon, self.distance > self.leave
        converged = ~unsettled & ~self.value.isnan()
        status = torch.where(left, Status.MISS, Status.OUT_OF_STEPS)
        status = torch.where(behind, Status.STARTED_INSIDE, torch.where(converged, Status.HIT, status))
        self.status = torch.where(moved, status, self.status).to(torch.int8)
        self.active, self.fresh = moved & unsettled & ~behind & ~left, self.fresh & ~moved
        ends = torch.where(behind, self.entry, torch.where(left & ~converged, self.leave, self.distance))
        self.distance = torch.where(moved, ends, self.distance)
        self.value = self.value.nan_to_num(0.0)


@dataclass(frozen=True)
class Moving:
    """Where m rays are, as columns of one table, so that they are chosen in one operation; a step makes another one.

    Args:
        table: its rows are: where the rays enter the sphere, less the threshold of a hit; where they leave it; where
            they are, and the field there; the distances of the samples, and their values. Where steps may be taken
            back: the step that the last value allowed, infinite after a step back; the step taken; and the running
            slope of the values along the ray (see `Stepping.relaxation`).
        samples: of each ray.
    """

    table: Float[Tensor, "rows m"]
    samples: int

    @staticmethod
    def of(front: Front, stepping: Stepping) -> "Moving":
        """All rays of a front."""
        ends = torch.stack([front.entry - stepping.epsilon, front.leave, front.distance, front.value])
        tables = [ends, front.sample_distance.T, front.sample_value.T]
        tables += [front.past.T] if stepping.step_back else []
        return Moving(torch.cat(tables), front.sample_value.shape[1])

    def write(self, front: Front) -> None:
        """Has the front's rays, which are these, be here."""
        _, _, distance, value, *rest = self.parts
        front.distance, front.value = distance.squeeze(0), value.squeeze(0)
        front.sample_distance, front.sample_value, past = (rows.T for rows in rest)
        front.past = past if past.shape[1] else front.past

    @property
    def parts(self) -> tuple[Float[Tensor, "_ m"], ...]:
        """Its rows: four single ones, the samples' distances, their values, and what is past."""
        samples = self.samples
        return self.table.split([1, 1, 1, 1, samples, samples, len(self.table) - 4 - 2 * samples])

    def some(self, index: Int[Tensor, " k"]) -> "Moving":
        """The same of some of them."""
        return Moving(self.table.index_select(1, index), self.samples)

    def where(self, chosen: Bool[Tensor, " m"], other: "Moving") -> "Moving":
        """These where they are chosen, else the others."""
        return Moving(torch.where(chosen, self.table, other.table), self.samples)

    def after(
        self, value: Float[Tensor, " m"], stepping: Stepping, fresh: Bool[Tensor, " m"] | None
    ) -> tuple["Moving", Bool[Tensor, " m"]]:
        """The rays after a step by the field's values at their ends, and which of them go on.

        Where a value is not finite it becomes NaN, and the ray stays.

        Args:
            fresh: see `Front`; a ray that turns out to begin inside is put infinitely far back. None for no ray.
        """
        value = value.nan_to_num(torch.nan, torch.nan, torch.nan)[None]
        known, magnitude = value.nan_to_num(0.0), value.abs()
        earliest, leave, distance, before, places, values, past = self.parts
        length = stepping.length(known)
        if stepping.relaxation:
            length, past = _relaxed(stepping.reach(known), past, stepping.relaxation)
        if stepping.least_step:
            onward = (known > 0) & (before >= 0)
            length = torch.where(onward, length.clamp_min(stepping.least_step), length)
        converged = magnitude < stepping.epsilon
        step = torch.where(converged, known, length)  # the last query moves the ray without alpha (DIST, Eq. 1)
        if stepping.step_back:
            step, past = _taken_back(distance, leave, stepping.reach(known), step, past)
        moved = distance + step
        if fresh is not None:
            moved = torch.where(fresh & (value < 0) & ~converged, -torch.inf, moved)
        least = _least(distance, value, magnitude, places, values)
        after = Moving(torch.cat([earliest, leave, moved, value, *least, past]), self.samples)
        goes_on = (moved.clamp(earliest, leave) == moved) & _unsettled(magnitude, past, stepping)
        return after, goes_on.squeeze(0)


def _taken_back(
    distance: Float[Tensor, "1 m"],
    leave: Float[Tensor, "1 m"],
    reach: Float[Tensor, "1 m"],
    step: Float[Tensor, "1 m"],
    past: Float[Tensor, "3 m"],
) -> tuple[Float[Tensor, "1 m"], Float[Tensor, "3 m"]]:
    """The steps, with a step back where the last two empty spheres do not meet; and what is then past."""
    safe, gone, rise = past.split(1)
    over = (distance + step > leave) & (distance + reach <= leave)
    step = torch.where(over, reach, step)
    apart = (gone > safe) & (gone > (safe + reach.abs()) * TOUCHING)
    back = torch.where(apart, safe - gone, step)
    safe = torch.where(apart, torch.inf, reach.clamp_min(0))  # where it went back to is known to be safe
    return back, torch.cat([safe, back, rise])


def _least(
    distance: Float[Tensor, "1 m"],
    value: Float[Tensor, "1 m"],
    magnitude: Float[Tensor, "1 m"],
    distances: Float[Tensor, "samples m"],
    values: Float[Tensor, "samples m"],
) -> tuple[Float[Tensor, "samples m"], Float[Tensor, "samples m"]]:
    """The distances and values of the samples, with a new one where it is among the least."""
    closer = magnitude < values.abs()
    if len(values) > 1:  # those behind move on by one
        value = torch.cat([value, torch.where(closer[:-1], values[:-1], value)])
        distance = torch.cat([distance, torch.where(closer[:-1], distances[:-1], distance)])
    return torch.where(closer, distance, distances), torch.where(closer, value, values)


# Of rays: their places in the front, and distances and values there, NaN of a ray that has ended.
Note = Callable[[Tensor, Tensor, Tensor], None]


def march(values: Values, rays: Rays, front: Front, stepping: Stepping, steps: int, note: Note | None = None) -> None:
    """Moves the front of flat rays [n, 3] by at most `steps` steps, in place.

    Args:
        note: is told of the values of each step.
    """
    if steps < 1:
        return
    moved, every = front.active, not stepping.active_only
    table, index = Moving.of(front, stepping), (front.meets if every else moved).nonzero().squeeze(-1)
    moving, going, fresh = table.some(index), moved[index], front.fresh[index]
    origins, directions, between = rays.origins[index], rays.directions[index], steps_between(index.device)
    for step in range(steps):
        if index.numel() == 0:
            break
        some_ended = every or step % between  # these stay, and are asked for where they left the sphere, not beyond it
        distance = moving.table[2]
        at = distance.clamp(moving.table[0], moving.table[1]) if some_ended else distance
        points = origins + at[:, None] * directions
        value = values_where(going, values, points) if some_ended and not every else values(points)
        after, goes_on = moving.after(value, stepping, None if step else fresh)
        if note is not None:
            note(index, distance, torch.where(going, value, torch.nan) if some_ended else value)
        moving, going = (after.where(going, moving), going & goes_on) if some_ended else (after, goes_on)
        if every or (step + 1) % between:
            continue
        onward = going.nonzero().squeeze(-1)
        if len(onward) < len(index):
            table.table.index_copy_(1, index, moving.table)
            index, origins, directions = (kept.index_select(0, onward) for kept in (index, origins, directions))
            moving, going = moving.some(onward), going.index_select(0, onward)
    table.table.index_copy_(1, index, moving.table)
    table.write(front)
    front.finish(moved, stepping)


def march_coarse_to_fine(
    values: Values, rays: Rays, stepping: Stepping, *, steps: int, radius: float, samples: int
) -> Front:
    """Three steps with one ray per 4 x 4 pixels, three with one per 2 x 2, the rest with one per pixel (DIST, 3.2).

    Args:
        rays: an image of rays [*batch, height, width, 3].
        steps: most steps per pixel, those of its coarse rays included.
        radius, samples: see `Front.on_sphere`.

    Returns:
        the front of the rays at full resolution, in one row.
    """
    levels = pyramid(rays)
    front = Front.on_sphere(levels[0].coarse, radius=radius, samples=samples)
    for level in levels:
        march(values, level.coarse, front, stepping, min(PYRAMID_STEPS, steps))
        steps = max(steps - PYRAMID_STEPS, 0)
        front = front.split(level.parent, level.coarse, level.fine, radius=radius, careful=stepping.careful_split)
    march(values, levels[-1].fine, front, stepping, steps)
    return front


class Level(NamedTuple):
    """Two neighbouring resolutions of an image of rays, each in one row, and the coarse ray above each fine one."""

    coarse: Rays
    fine: Rays
    parent: Int[Tensor, " children"]


def pyramid(rays: Rays) -> list[Level]:
    """An image of rays from one ray per 4 x 4 pixels to one per pixel (DIST, Sec. 3.2)."""
    images = [*(rays.coarser(factor) for factor in PYRAMID), rays]
    flat = [image.flat() for image in images]
    device = rays.origins.device
    above = [_parents(coarse.shape, fine.shape, device) for coarse, fine in pairwise(images)]
    return [Level(*level) for level in zip(flat[:-1], flat[1:], above, strict=True)]


def _parents(coarse: torch.Size, fine: torch.Size, device: torch.device) -> Int[Tensor, " children"]:
    """For each ray of the finer image, the index of the coarse ray that covers it."""
    index = torch.arange(coarse.numel(), device=device).view(coarse)
    doubled = index.repeat_interleave(2, -2).repeat_interleave(2, -1)
    return doubled[..., : fine[-2], : fine[-1]].reshape(-1)


def _unsettled(
    magnitude: Float[Tensor, "*rays"], past: Float[Tensor, "rows n"], stepping: Stepping
) -> Bool[Tensor, "*rays"]:
    """Which rays have a finite value and have not converged, or went back since, which the rows of `past` say."""
    unsettled = magnitude >= stepping.epsilon
    if stepping.step_back:
        unsettled |= (magnitude < stepping.epsilon) & past[0].isinf()
    return unsettled


def _relaxed(
    reach: Float[Tensor, "1 n"], past: Float[Tensor, "3 n"], weight: float
) -> tuple[Float[Tensor, "1 n"], Float[Tensor, "3 n"]]:
    """Steps to where the empty sphere of a plane that falls as the values do would touch this one; with its slope."""
    safe, gone, rise = past.split(1)
    onward = (gone > 0) & safe.isfinite()  # after a step back nothing is known of the slope
    last = (reach - safe) / torch.where(onward, gone, 1.0)
    running = torch.lerp(rise, last.clamp(STEEPEST_FALL, -STEEPEST_FALL), weight)
    rise = torch.where(onward, running, STEEPEST_FALL)
    length = torch.where(reach > 0, 2 * reach / (1 - rise.clamp_max(FASTEST_RISE)), reach)
    return length, torch.cat([safe, gone, rise])
