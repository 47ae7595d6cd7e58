"""Sphere tracing loops that renderers share: all rays or active rays, plain or aggressive, coarse to fine.

Nothing here builds a graph; `gradients.py` attaches a gradient afterwards, and `naive.py` keeps the graph instead.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.field import PointFunction
from renderers.rendering import Status
from renderers.tracing.waits import compaction_interval, evaluate_masked

COARSE_BLOCK_SIZES = (4, 2)  # pixels per side of a coarse ray's block, by level (DIST, Sec. 3.2)
STEPS_PER_COARSE_LEVEL = 3
SPHERE_GAP_TOLERANCE = 1.0001  # factor on the radii of two empty spheres: at normal incidence they just touch
HEAD_ON_SLOPE = -1.0  # slope of a distance along a ray towards a plane: the step is then the value
MAX_RELAXED_SLOPE = 0.5  # at this slope, a relaxed step is four times the value; it grows no more
SPLIT_DISTANCE_FACTOR = 2.0  # careful_split: the closest sample is not the closest point of the ray, so allow for more


@dataclass(frozen=True)
class Stepping:
    """Settings of sphere tracing: how the step length follows from a field value.

    Args:
        epsilon: a ray has converged if the field's magnitude is below this, in scene units (DIST, Sec. 3.2).
        alpha: the step is alpha times the value; 1 is sphere tracing, more is aggressive marching.
        extra_step_cap: bound on (alpha - 1) times the value, the part of a step that may pass a surface; None for none.
        step_clamp: bound on the magnitude of the value, before alpha, as in the official code; None for none.
        active_only: evaluate the field only for rays that have not finished; else for every ray that meets the sphere.
        careful_split: a fine ray starts at the closest sample of its coarse ray, if the surface there is about as near
            as the two rays are to each other; else at the coarse ray's end. Without it, rays at an edge may start
            behind it.
        step_back: a step longer than the value is shortened to the value if the empty spheres about its two ends do not
            meet (Keinert et al. 2014, "Enhanced sphere tracing", Sec. 3.1), or if it would leave the bounding sphere.
            Later steps may be longer than the value again.
        least_step: minimum length of forward steps, in scene units; 0 for none. It does not apply after a negative
            value, where the ray would go to and fro and never converge.
        slope: bound on the length of the field's gradient; the step length uses values divided by it.
        relaxation: weight of the last slope of the values along the ray in the running slope m. A step is then
            2 / (1 - m) times the value, instead of alpha, so that on a plane the empty spheres touch; 0 for none. It
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
        """The signed radius of the empty sphere for a field value."""
        return value if self.slope == 1 else value / self.slope


@dataclass
class RayFront:
    """The current ends of n marching rays, and the `samples` smallest field values on each."""

    distance: Float[Tensor, " n"]
    entry: Float[Tensor, " n"]  # of the bounding sphere; a ray that moves back beyond it started inside the shape
    leave: Float[Tensor, " n"]
    intersects: Bool[Tensor, " n"]  # the ray meets the bounding sphere
    active: Bool[Tensor, " n"]
    not_evaluated: Bool[Tensor, " n"]  # neither on this ray nor on its coarse ray
    status: Int8[Tensor, " n"]
    value: Float[Tensor, " n"]
    sample_distance: Float[Tensor, "n samples"]
    sample_value: Float[Tensor, "n samples"]  # infinite if there is no such sample
    step_history: Float[Tensor, "n 3"]  # see `MarchState`

    @staticmethod
    def on_sphere(rays: Rays, *, radius: float, samples: int) -> "RayFront":
        """Every ray where it enters the sphere of `radius` about the origin, or at its own origin if that is inside."""
        entry, leave, intersects = sphere_span(rays, radius)
        return RayFront(
            distance=entry,
            entry=entry.clone(),
            leave=leave,
            intersects=intersects,
            active=intersects.clone(),
            not_evaluated=torch.ones_like(intersects),
            status=torch.where(intersects, Status.OUT_OF_STEPS, Status.MISS).to(torch.int8),
            value=torch.zeros_like(entry),
            sample_distance=entry[:, None].repeat(1, samples),
            sample_value=entry.new_full((len(entry), samples), torch.inf),
            step_history=entry.new_tensor([0.0, 0.0, HEAD_ON_SLOPE]).repeat(len(entry), 1),
        )

    def split(
        self, parent: Int[Tensor, " children"], coarse: Rays, rays: Rays, *, radius: float, careful: bool
    ) -> "RayFront":
        """The front of finer rays, each continuing from its coarse `parent`; for `careful`, see Stepping.

        If a coarse ray missed the sphere, or started inside the shape, its finer rays start again at the sphere. A
        finer ray that would start beyond its exit from the sphere is a miss. The samples of a coarse ray without a hit
        are kept: its closest sample may lie behind the finer ray's start.
        """
        child = RayFront.on_sphere(rays, radius=radius, samples=self.sample_distance.shape[1])
        status, start = self.status[parent], self.distance[parent]
        sample_value, sample_distance = self.sample_value[parent], self.sample_distance[parent]
        inherits = self.intersects[parent] & (status != Status.STARTED_INSIDE)
        if careful:
            closest = sample_distance[:, 0]
            between_rays = torch.linalg.vector_norm(coarse[parent].at(closest) - rays.at(closest), dim=-1)
            start = torch.where(sample_value[:, 0].abs() <= SPLIT_DISTANCE_FACTOR * between_rays, closest, start)
        child.distance = torch.where(inherits, torch.maximum(start, child.distance), child.distance)
        child.not_evaluated = ~inherits
        inherits = inherits & child.intersects
        left_sphere = inherits & (child.distance >= child.leave)
        child.active &= ~left_sphere
        child.status = torch.where(left_sphere, Status.MISS, child.status).to(torch.int8)
        child.value = torch.where(left_sphere, self.value[parent], child.value)
        keeps_samples = (inherits & (status != Status.HIT))[:, None]
        child.sample_distance = torch.where(keeps_samples, sample_distance, child.sample_distance)
        child.sample_value = torch.where(keeps_samples, sample_value, child.sample_value)
        return child

    def update_status(self, moved: Bool[Tensor, " n"], stepping: Stepping) -> None:
        """Sets the status and the end of the rays that have `moved`, and which rays are still active."""
        unfinished = _not_converged(self.value.abs(), self.step_history.T, stepping)
        behind, left = self.distance < self.entry - stepping.epsilon, self.distance > self.leave
        converged = ~unfinished & ~self.value.isnan()
        status = torch.where(left, Status.MISS, Status.OUT_OF_STEPS)
        status = torch.where(behind, Status.STARTED_INSIDE, torch.where(converged, Status.HIT, status))
        self.status = torch.where(moved, status, self.status).to(torch.int8)
        self.active, self.not_evaluated = moved & unfinished & ~behind & ~left, self.not_evaluated & ~moved
        ends = torch.where(behind, self.entry, torch.where(left & ~converged, self.leave, self.distance))
        self.distance = torch.where(moved, ends, self.distance)
        self.value = self.value.nan_to_num(0.0)


@dataclass(frozen=True)
class MarchState:
    """The state of m marching rays, one column per ray, so that one indexing operation selects rays.

    Args:
        table: its rows are: the distance where the rays enter the sphere, less the threshold of a hit; where they leave
            it; their current distance, and the field's value there; the distances of the samples, and their values.
            With `step_back`, three rows of history follow: the step that the last value allowed, infinite after a step
            back; the last step; and the running slope of the values along the ray (see `Stepping.relaxation`).
        samples: number of samples per ray.
    """

    table: Float[Tensor, "rows m"]
    samples: int

    @staticmethod
    def of(front: RayFront, stepping: Stepping) -> "MarchState":
        """The state of all rays of a front."""
        ends = torch.stack([front.entry - stepping.epsilon, front.leave, front.distance, front.value])
        tables = [ends, front.sample_distance.T, front.sample_value.T]
        tables += [front.step_history.T] if stepping.step_back else []
        return MarchState(torch.cat(tables), front.sample_value.shape[1])

    def write(self, front: RayFront) -> None:
        """Writes this state of all its rays to the front."""
        _, _, distance, value, *rest = self.rows
        front.distance, front.value = distance.squeeze(0), value.squeeze(0)
        front.sample_distance, front.sample_value, history = (rows.T for rows in rest)
        front.step_history = history if history.shape[1] else front.step_history

    @property
    def rows(self) -> tuple[Float[Tensor, "_ m"], ...]:
        """Groups of rows: four single rows, the samples' distances, their values, and the step history."""
        samples = self.samples
        return self.table.split([1, 1, 1, 1, samples, samples, len(self.table) - 4 - 2 * samples])

    def select(self, index: Int[Tensor, " k"]) -> "MarchState":
        """The state of the rays in `index`."""
        return MarchState(self.table.index_select(1, index), self.samples)

    def where(self, chosen: Bool[Tensor, " m"], other: "MarchState") -> "MarchState":
        """This state for the `chosen` rays, the other state for the rest."""
        return MarchState(torch.where(chosen, self.table, other.table), self.samples)

    def advance(
        self, value: Float[Tensor, " m"], stepping: Stepping, not_evaluated: Bool[Tensor, " m"] | None
    ) -> tuple["MarchState", Bool[Tensor, " m"]]:
        """The state after a step by the field's values at the rays' ends, and which rays go on.

        A value that is not finite becomes NaN, and its ray stays.

        Args:
            not_evaluated: see `RayFront`; a ray that turns out to start inside is put infinitely far back. None if all
                rays were evaluated.
        """
        value = value.nan_to_num(torch.nan, torch.nan, torch.nan)[None]
        finite_value, magnitude = value.nan_to_num(0.0), value.abs()
        earliest, leave, distance, last_value, sample_distances, sample_values, history = self.rows
        length = stepping.length(finite_value)
        if stepping.relaxation:
            length, history = _relaxed_step(stepping.reach(finite_value), history, stepping.relaxation)
        if stepping.least_step:
            onward = (finite_value > 0) & (last_value >= 0)
            length = torch.where(onward, length.clamp_min(stepping.least_step), length)
        converged = magnitude < stepping.epsilon
        step = torch.where(converged, finite_value, length)  # the last query moves the ray without alpha (DIST, Eq. 1)
        if stepping.step_back:
            step, history = _step_back(distance, leave, stepping.reach(finite_value), step, history)
        moved = distance + step
        if not_evaluated is not None:
            moved = torch.where(not_evaluated & (value < 0) & ~converged, -torch.inf, moved)
        samples = _insert_sample(distance, value, magnitude, sample_distances, sample_values)
        advanced = MarchState(torch.cat([earliest, leave, moved, value, *samples, history]), self.samples)
        goes_on = (moved.clamp(earliest, leave) == moved) & _not_converged(magnitude, history, stepping)
        return advanced, goes_on.squeeze(0)


def _step_back(
    distance: Float[Tensor, "1 m"],
    leave: Float[Tensor, "1 m"],
    reach: Float[Tensor, "1 m"],
    step: Float[Tensor, "1 m"],
    history: Float[Tensor, "3 m"],
) -> tuple[Float[Tensor, "1 m"], Float[Tensor, "3 m"]]:
    """The steps, replaced by a step back where the last two empty spheres do not meet; and the new history."""
    safe, last_step, slope = history.split(1)
    too_long = (distance + step > leave) & (distance + reach <= leave)
    step = torch.where(too_long, reach, step)
    separate = (last_step > safe) & (last_step > (safe + reach.abs()) * SPHERE_GAP_TOLERANCE)
    step = torch.where(separate, safe - last_step, step)
    safe = torch.where(separate, torch.inf, reach.clamp_min(0))  # a step back ends where the ray is known to be safe
    return step, torch.cat([safe, step, slope])


def _insert_sample(
    distance: Float[Tensor, "1 m"],
    value: Float[Tensor, "1 m"],
    magnitude: Float[Tensor, "1 m"],
    distances: Float[Tensor, "samples m"],
    values: Float[Tensor, "samples m"],
) -> tuple[Float[Tensor, "samples m"], Float[Tensor, "samples m"]]:
    """The distances and values of the samples, with a new sample if it is among the smallest."""
    closer = magnitude < values.abs()
    if len(values) > 1:  # larger samples move back by one
        value = torch.cat([value, torch.where(closer[:-1], values[:-1], value)])
        distance = torch.cat([distance, torch.where(closer[:-1], distances[:-1], distance)])
    return torch.where(closer, distance, distances), torch.where(closer, value, values)


# Called with the indices of rays in the front, their distances, and the values there, NaN for a finished ray.
StepHook = Callable[[Tensor, Tensor, Tensor], None]


def march_front(
    values: PointFunction, rays: Rays, front: RayFront, stepping: Stepping, steps: int, on_step: StepHook | None = None
) -> None:
    """Moves the front of flat rays [n, 3] by at most `steps` steps, in place.

    Args:
        on_step: called in each step.
    """
    if steps < 1:
        return
    moved, all_rays = front.active, not stepping.active_only
    table, index = MarchState.of(front, stepping), (front.intersects if all_rays else moved).nonzero().squeeze(-1)
    state, going, not_evaluated = table.select(index), moved[index], front.not_evaluated[index]
    origins, directions, interval = rays.origins[index], rays.directions[index], compaction_interval(index.device)
    for step in range(steps):
        if index.numel() == 0:
            break
        # Finished rays are evaluated where they left the sphere, not beyond it.
        has_finished_rays = all_rays or step % interval != 0
        distance = state.table[2]
        clamped = distance.clamp(state.table[0], state.table[1]) if has_finished_rays else distance
        points = origins + clamped[:, None] * directions
        value = evaluate_masked(going, values, points) if has_finished_rays and not all_rays else values(points)
        advanced, goes_on = state.advance(value, stepping, None if step else not_evaluated)
        if on_step is not None:
            on_step(index, distance, torch.where(going, value, torch.nan) if has_finished_rays else value)
        state, going = (advanced.where(going, state), going & goes_on) if has_finished_rays else (advanced, goes_on)
        if all_rays or (step + 1) % interval:
            continue
        onward = going.nonzero().squeeze(-1)
        if len(onward) < len(index):
            table.table.index_copy_(1, index, state.table)
            index, origins, directions = (tensor.index_select(0, onward) for tensor in (index, origins, directions))
            state, going = state.select(onward), going.index_select(0, onward)
    table.table.index_copy_(1, index, state.table)
    table.write(front)
    front.update_status(moved, stepping)


def march_coarse_to_fine(
    values: PointFunction, rays: Rays, stepping: Stepping, *, steps: int, radius: float, samples: int
) -> RayFront:
    """Three steps with one ray per 4 x 4 pixels, three with one per 2 x 2, the rest with one per pixel (DIST, 3.2).

    Args:
        rays: an image of rays [*batch, height, width, 3].
        steps: maximum steps per pixel, including those of its coarse rays.
        radius, samples: see `RayFront.on_sphere`.

    Returns:
        the front of the rays at full resolution, flattened.
    """
    levels = ray_pyramid(rays)
    front = RayFront.on_sphere(levels[0].coarse, radius=radius, samples=samples)
    for level in levels:
        march_front(values, level.coarse, front, stepping, min(STEPS_PER_COARSE_LEVEL, steps))
        steps = max(steps - STEPS_PER_COARSE_LEVEL, 0)
        front = front.split(level.parent, level.coarse, level.fine, radius=radius, careful=stepping.careful_split)
    march_front(values, levels[-1].fine, front, stepping, steps)
    return front


class ResolutionPair(NamedTuple):
    """Two neighbouring resolutions of an image of rays, each flattened, and the coarse ray above each fine one."""

    coarse: Rays
    fine: Rays
    parent: Int[Tensor, " children"]


def ray_pyramid(rays: Rays) -> list[ResolutionPair]:
    """An image of rays from one ray per 4 x 4 pixels to one per pixel (DIST, Sec. 3.2)."""
    images = [*(rays.coarser(factor) for factor in COARSE_BLOCK_SIZES), rays]
    flat = [image.flat() for image in images]
    device = rays.origins.device
    parents = [_parents(coarse.shape, fine.shape, device) for coarse, fine in pairwise(images)]
    return [ResolutionPair(*pair) for pair in zip(flat[:-1], flat[1:], parents, strict=True)]


def _parents(coarse: torch.Size, fine: torch.Size, device: torch.device) -> Int[Tensor, " children"]:
    """For each ray of the finer image, the index of the coarse ray that covers it."""
    index = torch.arange(coarse.numel(), device=device).view(coarse)
    doubled = index.repeat_interleave(2, -2).repeat_interleave(2, -1)
    return doubled[..., : fine[-2], : fine[-1]].reshape(-1)


def _not_converged(
    magnitude: Float[Tensor, "*rays"], history: Float[Tensor, "rows n"], stepping: Stepping
) -> Bool[Tensor, "*rays"]:
    """Which rays have a finite value and have not converged, or have just stepped back."""
    unfinished = magnitude >= stepping.epsilon
    if stepping.step_back:
        unfinished |= (magnitude < stepping.epsilon) & history[0].isinf()
    return unfinished


def _relaxed_step(
    reach: Float[Tensor, "1 n"], history: Float[Tensor, "3 n"], weight: float
) -> tuple[Float[Tensor, "1 n"], Float[Tensor, "3 n"]]:
    """Steps to the next touching empty sphere if values fall as towards a plane; and the history with the new slope."""
    safe, last_step, slope = history.split(1)
    onward = (last_step > 0) & safe.isfinite()  # after a step back the slope is unknown
    last_slope = (reach - safe) / torch.where(onward, last_step, 1.0)
    running = torch.lerp(slope, last_slope.clamp(HEAD_ON_SLOPE, -HEAD_ON_SLOPE), weight)
    slope = torch.where(onward, running, HEAD_ON_SLOPE)
    length = torch.where(reach > 0, 2 * reach / (1 - slope.clamp_max(MAX_RELAXED_SLOPE)), reach)
    return length, torch.cat([safe, last_step, slope])
