"""A march that stops at the surface, or right behind it: if the field's magnitude is small, or its sign changes.

The columns of marching rays are packed in one tensor, so that a step costs few operations. Nothing here builds a
graph; `tracer.py` finds the surface from where the rays stopped.
"""

from dataclasses import dataclass, fields, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.field import PointFunction
from renderers.tracing.bracket import Bracket
from renderers.tracing.march import ResolutionPair, ray_pyramid
from renderers.tracing.waits import compaction_interval, evaluate_masked

MAX_STEPS_PER_LEVEL = 5  # more steps are wasted near silhouettes, where both the coarse and the fine ray advance slowly
PARENT_SPHERE_FACTOR = 2.0  # coarse rays stop while their empty sphere is this many times the distance to finer rays
MAX_GAP_PER_VALUE = 1.4  # near surfaces, gaps between empty spheres shrink with the value, since small parts are there
MAX_OVERSTEP = 0.03  # scene units by which a step may exceed the value; the warm start's margin grows with it
GAP_TOLERANCE_FACTOR = 1.5  # times `unseen`: the gap that a step may leave, since slopes change on the way
CLEARANCE_THRESHOLD = 0.1  # scene units: below it a value is close to a surface


class Stop(IntEnum):
    """Where a ray stopped."""

    MARCHING = 0  # it has not stopped
    NEAR_SURFACE = 1  # the magnitude is small
    CROSSED = 2  # the value is negative, after a positive one
    LEFT = 3  # at the end of the sphere, or the ray does not meet it
    INSIDE = 4  # the field is negative where the ray starts
    NOT_FINITE = 5  # the value is NaN or infinite


@dataclass(frozen=True)
class Stride:
    """Settings of the march: how the step length follows from field values.

    The sphere about a sample with the value as its radius is empty. If the field goes on to fall as between the last
    two samples, a step of (2 value + unseen) / (1 + slope) leaves a gap of `unseen` between the spheres about its ends.
    Close to a surface the gap shrinks with the value, since small parts have small values nearby. If the gap turns out
    to be larger than `GAP_TOLERANCE_FACTOR` times `unseen`, the ray goes back to the boundary of the first sphere, also
    from behind a surface: there may be another surface in the gap. The ray then does not step past that surface.

    Source: ours, after Balint and Valasek 2018, "Accelerating sphere tracing", and Keinert et al. 2014, "Enhanced
    sphere tracing", Sec. 3.1, whose spheres touch.

    Args:
        epsilon: a ray stops near the surface if the field's magnitude is at most this, in scene units.
        unseen: the longest gap that a step should leave between the spheres about its ends, in scene units; at most
            `MAX_GAP_PER_VALUE` times the value. From `MAX_OVERSTEP` / `GAP_TOLERANCE_FACTOR` on, no ray goes back.
    """

    epsilon: float
    unseen: float

    def length(self, value: Float[Tensor, " n"], slope: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """The signed step for values that fell by `slope` per distance; 1 if the slope is unknown."""
        step = (2 * value + (MAX_GAP_PER_VALUE * value).clamp_max(self.unseen)) / (1 + slope.clamp(0, 1))
        return torch.where(value > 0, torch.minimum(step, value + MAX_OVERSTEP), value)


@dataclass
class RayTable:
    """The state of n marching rays, a tensor for each column of the table. Distances are along the ray.

    Args:
        distance: to where the ray stopped, or is evaluated next; beyond its end if it has LEFT.
        value: the last value of the field.
        least_distance: to the sample of smallest magnitude, which may be on the coarse ray.
        least: the value of that sample, with its sign; infinite before the first.
        free: to the ray's own last value above the threshold; before the first, to the ray's start.
        free_value: that value; infinite before the first.
        entry: to the ray's start.
        leave: to where it leaves the sphere.
        stop: a Stop, as a floating-point number like all columns.
        path_clearance: a lower bound of the field along the path so far, except on the final descent. It is the
            smallest value at which this ray, or its coarse ray, turned from falling to rising; for the coarse ray minus
            the distance between the two.
        restart_distance: to the last sample with `path_clearance` > `CLEARANCE_THRESHOLD`; else `entry`.
        clear_from: if it has LEFT: to where samples stay above `CLEARANCE_THRESHOLD`, or to `leave`.
        ray_clearance: as `path_clearance`, of the ray's own values alone; infinite before the first.
        step_back_limit: to the last sample behind a surface that was stepped back from; else infinite.
    """

    distance: Float[Tensor, " n"]
    value: Float[Tensor, " n"]
    least_distance: Float[Tensor, " n"]
    least: Float[Tensor, " n"]
    free: Float[Tensor, " n"]
    free_value: Float[Tensor, " n"]
    entry: Float[Tensor, " n"]
    leave: Float[Tensor, " n"]
    stop: Float[Tensor, " n"]
    path_clearance: Float[Tensor, " n"]
    restart_distance: Float[Tensor, " n"]
    clear_from: Float[Tensor, " n"]
    ray_clearance: Float[Tensor, " n"]
    step_back_limit: Float[Tensor, " n"]

    @staticmethod
    def on_sphere(rays: Rays, radius: float) -> "RayTable":
        """Every ray where it enters the sphere of `radius` about the origin, or at its own origin if that is inside."""
        entry, leave, intersects = sphere_span(rays, radius)
        zero, infinite = torch.zeros_like(entry), torch.full_like(entry, torch.inf)
        stop = torch.where(intersects, Stop.MARCHING, Stop.LEFT).to(entry.dtype)
        return RayTable(
            distance=entry,
            value=zero,
            least_distance=entry,
            least=infinite,
            free=entry,
            free_value=infinite,
            entry=entry,
            leave=leave,
            stop=stop,
            path_clearance=infinite,
            restart_distance=entry,
            clear_from=entry,
            ray_clearance=infinite,
            step_back_limit=infinite,
        )

    def stopped(self, stop: Stop) -> Bool[Tensor, " n"]:
        """Which rays have this Stop."""
        return self.stop == stop

    def select(self, index: Int[Tensor, " m"]) -> "RayTable":
        """A copy of the rays in `index`."""
        return RayTable(*self.packed().index_select(1, index))

    def packed(self) -> Float[Tensor, "14 n"]:
        """All columns in one tensor, so that one indexing operation selects rays; `RayTable(*packed)` unpacks it."""
        return torch.stack([getattr(self, column.name) for column in fields(self)])

    def restarted(self, rays: Rays, resumes: Bool[Tensor, " n"], *, radius: float) -> "RayTable":
        """The rays, ready to march again: from `restart_distance` if the ray `resumes`, else from their start.

        Resuming rays keep their clearance up to there. Those that had LEFT end at `clear_from`, since they are free
        from there on.
        """
        restarted = RayTable.on_sphere(rays, radius)
        restarted.distance = torch.where(resumes, self.restart_distance, restarted.distance)
        restarted.restart_distance = torch.where(resumes, self.restart_distance, restarted.restart_distance)
        restarted.clear_from = torch.where(resumes, self.clear_from, restarted.clear_from)
        clearance = self.path_clearance.clamp_min(CLEARANCE_THRESHOLD)
        restarted.path_clearance = torch.where(resumes, clearance, restarted.path_clearance)
        restarted.leave = torch.where(resumes & self.stopped(Stop.LEFT), self.clear_from, restarted.leave)
        return restarted

    def replace_rays(self, index: Int[Tensor, " m"], others: "RayTable") -> None:
        """Replaces the rays in `index` by `others`, except for their `leave`."""
        packed = self.packed().index_copy_(1, index, others.packed())
        for column, values in zip(fields(self), packed, strict=True):
            if column.name != "leave":
                setattr(self, column.name, values)

    def bracket(self) -> Bracket:
        """Between `free` and where each ray stopped; meant for rays that have CROSSED."""
        return Bracket(self.free, self.distance, self.free_value, self.value)

    def update_smallest_sample(self, distance: Float[Tensor, " n"], value: Float[Tensor, " n"]) -> None:
        """Keeps a sample of each ray if its magnitude is the smallest so far."""
        closer = value.isfinite() & (value.abs() < self.least.abs())
        self.least_distance = torch.where(closer, distance, self.least_distance)
        self.least = torch.where(closer, value, self.least)

    def set_stops(self, epsilon: float) -> None:
        """Sets how each ray stopped, from its distance and its last value."""
        value = self.value
        inside = (value < 0) & self.free_value.isinf() & (self.distance <= self.entry)
        stop = torch.where(inside, Stop.INSIDE, torch.where(value < -epsilon, Stop.CROSSED, Stop.NEAR_SURFACE))
        stop = torch.where(self.distance > self.leave, Stop.LEFT, stop)
        self.stop = torch.where(value.isfinite(), stop, Stop.NOT_FINITE).to(value.dtype)
        self.value = value.nan_to_num(0.0, 0.0, 0.0)

    def advance(self, value: Float[Tensor, " n"], stride: Stride) -> tuple["RayTable", Bool[Tensor, " n"]]:
        """The rays after a step by the field's values at the rays' distances, and which rays go on.

        A ray that continues from its coarse ray may start behind the surface: it goes back until the field is positive,
        at most to its start. A ray that stops stays at the sample; if it has left the sphere, it ends beyond `leave`.
        """
        distance, safe, magnitude, negative = self.distance, self.free_value, value.abs(), value < 0
        travelled, finite = distance - self.free, magnitude < torch.inf
        above, behind = (value > stride.epsilon) & finite, (value < -stride.epsilon) & finite
        too_far = finite & (travelled - safe - magnitude > GAP_TOLERANCE_FACTOR * stride.unseen)
        from_behind = too_far & negative
        closer = finite & ~from_behind & (magnitude < self.least.abs())
        limit = torch.where(from_behind, distance, self.step_back_limit)
        positive, end = above & ~too_far, distance + value
        left = positive & (end > self.leave) & self.step_back_limit.isinf()
        first = safe.isinf() & (distance > self.entry)
        goes_on = too_far | (behind & first) | (above & ~left)
        slope = ((safe - value) / travelled).nan_to_num(1.0)  # a step too short for the dtype has no slope
        moved = torch.where(too_far, self.free + safe, distance + stride.length(value, slope))
        moved = torch.minimum(torch.maximum(moved, self.entry), torch.minimum(self.leave, limit))
        rises = value > safe
        lower = torch.where(rises, safe, value)
        minimum = torch.where(rises | left, lower, torch.inf)
        clear_from = torch.where(left & (value <= CLEARANCE_THRESHOLD), self.leave, distance)
        clear = torch.minimum(self.path_clearance, lower) > CLEARANCE_THRESHOLD
        advanced = RayTable(
            distance=torch.where(goes_on, moved, torch.where(left, end, distance)),
            value=value,
            least_distance=torch.where(closer, distance, self.least_distance),
            least=torch.where(closer, value, self.least),
            free=torch.where(positive, distance, self.free),
            free_value=torch.where(positive, value, safe),
            entry=self.entry,
            leave=self.leave,
            stop=self.stop,
            path_clearance=torch.minimum(self.path_clearance, minimum),
            restart_distance=torch.where(clear, distance, self.restart_distance),
            clear_from=torch.where(lower <= CLEARANCE_THRESHOLD, clear_from, self.clear_from),
            ray_clearance=torch.minimum(self.ray_clearance, minimum),
            step_back_limit=limit,
        )
        return advanced, goes_on

    def split(
        self, parent: Int[Tensor, " m"], parent_distance: Float[Tensor, " m"], child: "RayTable", *, error: float
    ) -> "RayTable":
        """The finer rays, each continuing from its coarse `parent`, as far as the parent's empty spheres reach.

        A finer ray keeps the closest sample of its parent, if the parent came close to nothing.

        Args:
            parent_distance: maximum distance between each finer ray and its parent.
            child: the finer rays on the sphere, which are changed.
            error: maximum error of the parent's values.
        """
        coarse = self.select(parent)
        inherits = ~coarse.stopped(Stop.INSIDE) & ~coarse.stopped(Stop.NOT_FINITE) & coarse.least.isfinite()
        inherits &= child.stopped(Stop.MARCHING)
        spheres = coarse.stopped(Stop.CROSSED) | (coarse.stopped(Stop.MARCHING) & coarse.free_value.isfinite())
        reach = torch.where(spheres, coarse.free + coarse.free_value, coarse.distance)
        start = torch.where(inherits, torch.maximum(reach - parent_distance - error, child.entry), child.entry)
        at_surface = coarse.stopped(Stop.NEAR_SURFACE) | coarse.stopped(Stop.CROSSED)
        keeps_sample = inherits & ~at_surface & (coarse.least > 0)
        left_sphere, resume_distance = keeps_sample & (start >= child.leave), torch.minimum(start, child.leave)
        child.distance = torch.where(left_sphere, start, resume_distance)
        child.stop = torch.where(left_sphere, Stop.LEFT, child.stop)
        child.value = torch.where(keeps_sample, coarse.value, child.value)
        child.least_distance = torch.where(keeps_sample, coarse.least_distance, child.least_distance)
        child.least = torch.where(keeps_sample, coarse.least, child.least)
        clearance = coarse.path_clearance
        clearance = torch.where(at_surface, clearance, torch.minimum(clearance, coarse.least))
        child.path_clearance = torch.where(inherits, clearance - parent_distance, child.path_clearance)
        clear = ~at_surface & (child.path_clearance > CLEARANCE_THRESHOLD)
        child.restart_distance = torch.where(clear, resume_distance, child.entry)
        child.clear_from = resume_distance
        return child


def march_rays(
    values: PointFunction, rays: Rays, stride: Stride, *, steps: int, radius: float, error: float
) -> RayTable:
    """Marches all rays; those of an image coarse to fine (DIST, Sec. 3.2).

    A coarse ray stops before its empty sphere is too small to contain the finer rays next to it.

    Args:
        rays: of any leading shape; the table has them flattened.
        stride: for rays at full resolution; coarse rays stop earlier.
        steps: maximum steps per ray, without those of its coarse rays.
        radius: of the sphere about the origin that contains the shape.
        error: maximum error of a value.
    """
    levels = ray_pyramid(rays) if rays.image else []
    table, *finer = (RayTable.on_sphere(each, radius) for each in [*(level.coarse for level in levels), rays.flat()])
    distances = [_parent_distance(level, start) for level, start in zip(levels, [table, *finer], strict=False)]
    maxima = [torch.nn.functional.pad(distance, (0, 1)).amax() for distance in distances]
    maxima = torch.stack(maxima).tolist() if levels else []
    for level, child, distance, max_distance in zip(levels, finer, distances, maxima, strict=True):
        coarse_epsilon = max(PARENT_SPHERE_FACTOR * max_distance + error, stride.epsilon)
        march_table(values, level.coarse, table, replace(stride, epsilon=coarse_epsilon), MAX_STEPS_PER_LEVEL)
        table = table.split(level.parent, distance, child, error=error)
    march_table(values, rays.flat(), table, stride, steps)
    return table


def march_table(values: PointFunction, rays: Rays, table: RayTable, stride: Stride, steps: int) -> None:
    """Moves flat rays [n, 3] by at most `steps` steps, in place."""
    index = table.stopped(Stop.MARCHING).nonzero().squeeze(-1)
    origins, directions, packed = rays.origins[index], rays.directions[index], table.packed().index_select(1, index)
    finished: list[tuple[Tensor, Tensor]] = []  # rays that have stopped: their index, and their packed columns
    going, interval = torch.ones_like(index, dtype=torch.bool), compaction_interval(index.device)
    for step in range(steps):
        if index.numel() == 0:
            break
        state = RayTable(*packed)
        if step % interval:  # some rays may have stopped, and stay where they are
            distance = torch.minimum(state.distance, state.leave)
            value = evaluate_masked(going, values, origins + distance[:, None] * directions)
            advanced, goes_on = state.advance(value, stride)
            packed, going = torch.where(going, advanced.packed(), packed), going & goes_on
        else:
            advanced, going = state.advance(values(origins + state.distance[:, None] * directions), stride)
            packed = advanced.packed()
        if (step + 1) % interval:
            continue
        onward = going.nonzero().squeeze(-1)
        if len(onward) < len(index):
            stopped = (~going).nonzero().squeeze(-1)
            finished.append((index[stopped], packed.index_select(1, stopped)))
            index, origins, directions = (tensor.index_select(0, onward) for tensor in (index, origins, directions))
            packed, going = packed.index_select(1, onward), going.index_select(0, onward)
    marching = torch.nn.functional.pad(going, (sum(len(stopped) for stopped, _ in finished), 0))
    index, packed = (torch.cat(tensors, -1) for tensors in zip(*finished, (index, packed), strict=True))
    marched = RayTable(*packed)
    marched.set_stops(stride.epsilon)
    marched.stop = torch.where(marching, Stop.MARCHING, marched.stop)
    table.replace_rays(index, marched)


def _parent_distance(level: ResolutionPair, coarse_start: RayTable) -> Float[Tensor, " n"]:
    """The maximum distance between each finer ray and its coarse ray within the sphere, at equal distances along both.

    Args:
        coarse_start: the coarse rays on the sphere.
    """
    coarse = level.coarse[level.parent]
    ends = (distance[level.parent] for distance in (coarse_start.entry, coarse_start.leave))
    return torch.maximum(*(torch.linalg.vector_norm(coarse.at(end) - level.fine.at(end), dim=-1) for end in ends))
