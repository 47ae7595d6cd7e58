"""Stepping loops that renderers share: all rays or the active ones, plain or aggressive, coarse to fine.

Everything here runs without a graph; `gradients.py` says how a gradient is attached afterwards, and `naive.py` keeps
the graph instead.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.field import Field
from renderers.rendering import Status

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
        value = value / self.slope
        if self.step_clamp is not None:
            value = value.clamp(-self.step_clamp, self.step_clamp)
        extra = (self.alpha - 1) * value
        if self.extra_step_cap is not None:
            extra = extra.clamp(-self.extra_step_cap, self.extra_step_cap)
        return value + extra


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
    safe: Float[Tensor, " n"]  # the step that the last value allowed, and the step taken
    gone: Float[Tensor, " n"]
    rise: Float[Tensor, " n"]  # the running slope of the values along the ray; see `Stepping.relaxation`

    @staticmethod
    def on_sphere(rays: Rays, *, radius: float, samples: int) -> "Front":
        """Every ray where it enters the sphere of `radius` about the origin, or at its origin if that lies inside."""
        entry, leave, meets = sphere_span(rays, radius)
        status = torch.where(meets, Status.OUT_OF_STEPS, Status.MISS).to(torch.int8)
        return Front(
            distance=entry,
            entry=entry.clone(),
            leave=leave,
            meets=meets,
            active=meets.clone(),
            fresh=torch.ones_like(meets),
            status=status,
            value=torch.zeros_like(entry),
            sample_distance=entry[:, None].repeat(1, samples),
            sample_value=torch.full_like(entry, torch.inf)[:, None].repeat(1, samples),
            safe=torch.zeros_like(entry),
            gone=torch.zeros_like(entry),
            rise=torch.full_like(entry, STEEPEST_FALL),
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
        inherits = self.meets[parent] & (self.status[parent] != Status.STARTED_INSIDE)
        start = self.distance[parent]
        if careful:
            closest, least = self.sample_distance[parent, 0], self.sample_value[parent, 0].abs()
            apart = torch.linalg.vector_norm(coarse[parent].at(closest) - rays.at(closest), dim=-1)
            start = torch.where(least <= CAREFUL * apart, closest, start)
        child.distance = torch.where(inherits, torch.maximum(start, child.distance), child.distance)
        child.fresh = ~inherits
        gone = child.meets & inherits & (child.distance >= child.leave)
        child.active &= ~gone
        child.status[gone] = Status.MISS
        child.value[gone] = self.value[parent[gone]]
        keeps = child.meets & inherits & (self.status[parent] != Status.HIT)
        child.sample_distance[keeps] = self.sample_distance[parent[keeps]]
        child.sample_value[keeps] = self.sample_value[parent[keeps]]
        return child


def march(field: Field, rays: Rays, front: Front, stepping: Stepping, steps: int) -> None:
    """Moves the front of flat rays [n, 3] by at most `steps` steps, in place."""
    for _ in range(steps):
        queried = (front.active if stepping.active_only else front.meets).nonzero().squeeze(-1)
        if queried.numel() == 0:
            return
        value = field(rays.origins[queried] + front.distance[queried, None] * rays.directions[queried])
        if not stepping.active_only:
            moving = front.active[queried]
            queried, value = queried[moving], value[moving]
        _advance(front, queried, value, stepping)


def march_coarse_to_fine(
    field: Field, rays: Rays, stepping: Stepping, *, steps: int, radius: float, samples: int
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
        march(field, level.coarse, front, stepping, min(PYRAMID_STEPS, steps))
        steps = max(steps - PYRAMID_STEPS, 0)
        front = front.split(level.parent, level.coarse, level.fine, radius=radius, careful=stepping.careful_split)
    march(field, levels[-1].fine, front, stepping, steps)
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


def _advance(front: Front, queried: Int[Tensor, " m"], value: Float[Tensor, " m"], stepping: Stepping) -> None:
    """Moves the active rays `queried` by their field values, in place."""
    finite = value.isfinite()
    value = torch.where(finite, value, 0.0)
    converged = finite & (value.abs() < stepping.epsilon)
    inside = finite & front.fresh[queried] & (value < 0) & ~converged
    distance = front.distance[queried]
    _keep_least(front, queried, torch.where(finite, value, torch.inf), distance)

    # The last query moves the ray by the value itself, without alpha (DIST, Eq. 1).
    length = _relaxed(front, queried, value, stepping) if stepping.relaxation else stepping.length(value)
    onward = (value > 0) & (front.value[queried] >= 0)
    length = torch.where(onward, length.clamp_min(stepping.least_step), length)
    step = torch.where(converged, value, torch.where(inside, 0.0, length))
    if stepping.step_back:
        reach = value / stepping.slope
        over = (distance + step > front.leave[queried]) & (distance + reach <= front.leave[queried])
        step, apart = _taken_back(front, queried, reach, torch.where(over, reach, step))
        converged &= ~apart
    moved = distance + step
    left = ~converged & (moved > front.leave[queried])
    behind = moved < front.entry[queried] - stepping.epsilon
    inside |= behind
    converged &= ~behind
    moved = torch.where(behind, front.entry[queried], moved)

    status = torch.full_like(front.status[queried], Status.OUT_OF_STEPS)
    status[left] = Status.MISS
    status[converged] = Status.HIT
    status[inside] = Status.STARTED_INSIDE
    front.status[queried] = status
    front.value[queried] = value
    front.distance[queried] = torch.where(left, front.leave[queried], moved)
    front.fresh[queried] = False
    front.active[queried] = finite & ~converged & ~inside & ~left


def _taken_back(
    front: Front, queried: Int[Tensor, " m"], reach: Float[Tensor, " m"], step: Float[Tensor, " m"]
) -> tuple[Float[Tensor, " m"], Bool[Tensor, " m"]]:
    """The steps, with a step back where the last two empty spheres do not meet; and on which rays that is."""
    safe, gone = front.safe[queried], front.gone[queried]
    apart = (gone > safe) & (gone > (safe + reach.abs()) * TOUCHING)
    back = torch.where(apart, safe - gone, step)
    front.safe[queried] = torch.where(apart, torch.inf, reach.clamp_min(0))  # where it went back to is known to be safe
    front.gone[queried] = back
    return back, apart


def _relaxed(
    front: Front, queried: Int[Tensor, " m"], value: Float[Tensor, " m"], stepping: Stepping
) -> Float[Tensor, " m"]:
    """Steps to where the empty sphere of a plane that falls as the values do would touch this one; keeps the slope."""
    gone, reach = front.gone[queried], value / stepping.slope
    onward = (gone > 0) & front.safe[queried].isfinite()  # after a step back nothing is known of the slope
    last = (reach - front.safe[queried]) / torch.where(onward, gone, 1.0)
    running = torch.lerp(front.rise[queried], last.clamp(STEEPEST_FALL, -STEEPEST_FALL), stepping.relaxation)
    rise = torch.where(onward, running, STEEPEST_FALL)
    front.rise[queried] = rise
    return torch.where(value > 0, 2 * reach / (1 - rise.clamp_max(FASTEST_RISE)), reach)


def _keep_least(
    front: Front, queried: Int[Tensor, " m"], value: Float[Tensor, " m"], distance: Float[Tensor, " m"]
) -> None:
    """Keeps the samples of least magnitude of each ray, in rising order."""
    values = torch.cat([front.sample_value[queried], value[:, None]], dim=1)
    distances = torch.cat([front.sample_distance[queried], distance[:, None]], dim=1)
    order = values.abs().argsort(dim=1, stable=True)[:, :-1]
    front.sample_value[queried] = values.gather(1, order)
    front.sample_distance[queried] = distances.gather(1, order)
