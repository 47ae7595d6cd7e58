"""Renders the same rays as in the last iteration of an optimisation, starting from where that rendering ended.

The movement of the field's values is measured at the last hits, where a rendering evaluates them anyway, and at one
point on each of some rays. If the field was larger than twice that movement along a ray's whole path, the ray is still
free. A hit is solved again from its last distance, by the Newton step that its gradient needs. All other rays are
marched again, from where their path came close to a surface if it is free up to there, else from their start.

This is no proof, since the movement is measured at samples: a surface that appears between them is found when the ray
is marched again. An audit marches one ray in a hundred from its start, other rays in each rendering. If too many
audited rays differ, all rays are marched again. A miss keeps its closest sample until it is marched again.
"""

from dataclasses import dataclass, field
from threading import get_ident
from weakref import ref

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field
from renderers.newton.packed_march import CLEARANCE_THRESHOLD, MAX_OVERSTEP, RayTable
from renderers.newton.tracer import Crossings, Tracer, concatenate, normalise_slope
from renderers.rendering import Rendering

MOVEMENT_SAFETY_FACTOR = 2.0  # elsewhere the field may have moved further than at the samples
MAX_REUSABLE_SLOPE = -0.1  # hits with a flatter slope along the ray are marched again, since they may vanish suddenly
MOVEMENT_QUANTILE = 0.9  # this quantile of the movements at hits predicts the movement in the next rendering
MAX_REMARCHED_FRACTION = 0.5  # if more rays must be marched again, rendering everything coarse to fine is cheaper
PROBE_STRIDE = 29  # every 29th ray measures the movement; a usual image's width is no multiple
GOLDEN_RATIO_STEP = 0.618034  # fraction of the ray from one probed point to the next: they spread over the whole ray
AUDIT_STRIDE, AUDIT_OFFSET = 100, 37  # every 100th ray is audited; the first one moves by 37 in each rendering
MAX_MISMATCH_FRACTION = 0.025  # if more than one and more than this fraction of the audited rays differ, march all rays
MAX_TOTAL_MISMATCH_FRACTION, MIN_AUDITED_RAYS = 0.02, 200  # if all renderings together exceed it, the cache is disabled
MISMATCH_DISTANCE = 0.01  # scene units
SLOPE_CHECK_INTERVAL = 4  # renderings
MAX_SLOPE_CHANGE = 0.05  # relative change of the slope scale, or of the slopes at hits; beyond it all rays are marched


@dataclass
class CachedRays:
    """The last rendering of n flattened rays, without a graph.

    Args:
        table: where the march left the rays.
        hit, distance, slope: whether and where they hit, and the slope of the field along the ray there.
        total_movement: how far values have moved since the first rendering, in field units.
        last_movement: how far they moved in the last rendering.
        movement_when_marched: `total_movement` when the ray was last marched from its start.
        probe_values: the field's last values at the points of `_probe`.
        slope_scale: the field's values here are divided by it.
        renderings: their number so far.
    """

    table: RayTable
    hit: Bool[Tensor, " n"]
    distance: Float[Tensor, " n"]
    slope: Float[Tensor, " n"]
    total_movement: Float[Tensor, ""]
    last_movement: Float[Tensor, ""]
    movement_when_marched: Float[Tensor, " n"]
    probe_values: Float[Tensor, " m"]
    slope_scale: float
    renderings: int = 0

    def update_hits(self, solved: Crossings) -> None:
        """Stores where the rays hit now."""
        index, converged = solved.index, solved.converged
        self.hit = torch.zeros_like(self.hit).index_put((index,), converged)
        distance = torch.where(converged, solved.distance.detach(), self.distance[index])
        self.distance = self.distance.index_put((index,), distance)
        self.slope = self.slope.index_put((index,), torch.where(converged, solved.slope, self.slope[index]))
        self.renderings += 1

    def still_free(self, total_movement: Float[Tensor, ""]) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"]]:
        """Masks of rays that are still free after this movement: along the whole path; up to their restart distance.

        On a step that is at most `MAX_OVERSTEP` longer than the value, the field is at least half the smaller of the
        values at its ends, less half of `MAX_OVERSTEP`. A hit's final descent is not compared: its Newton step sees it.
        """
        margin = 2 * (total_movement - self.movement_when_marched) + MAX_OVERSTEP
        clearance, up_to_restart = self.table.path_clearance, margin < CLEARANCE_THRESHOLD
        clearance = torch.where(self.hit, clearance, torch.minimum(clearance, self.table.least))
        return (margin < clearance) & (up_to_restart | ~self.hit), up_to_restart


@dataclass
class Memory:
    """The memory of an optimisation: the last rendering of each set of rays that still exists, and the audit's counts.

    It serves one optimisation in one thread; in another thread nothing is cached.
    """

    cached: dict[int, tuple[ref[Tensor], ref[Tensor], CachedRays]] = field(default_factory=dict)
    audited: int = 0
    differed: int = 0
    thread: int = field(default_factory=get_ident)

    def forget(self) -> None:
        """Prepares for another optimisation."""
        self.cached, self.audited, self.differed, self.thread = {}, 0, 0, get_ident()

    @property
    def disabled(self) -> bool:
        """Whether so many audited rays differed that the cache is not used any more."""
        return self.audited >= MIN_AUDITED_RAYS and self.differed > MAX_TOTAL_MISMATCH_FRACTION * self.audited

    def lookup(self, rays: Rays) -> CachedRays | None:
        """The last rendering of these very rays."""
        entry = self.cached.get(id(rays.origins))
        return entry[2] if entry and entry[0]() is rays.origins and entry[1]() is rays.directions else None

    def store(self, rays: Rays, cache: CachedRays) -> None:
        """Caches a rendering until its rays are deleted."""
        cached, key = self.cached, id(rays.origins)
        cached[key] = ref(rays.origins, lambda _: cached.pop(key, None)), ref(rays.directions), cache

    def audit(self, rays: int, differing: int) -> bool:
        """Counts the audited rays and those that differ; returns whether too many differ in this rendering."""
        self.audited += rays
        self.differed += differing
        return differing > max(1, MAX_MISMATCH_FRACTION * rays)

    def notes(self) -> list[str]:
        """The result of the audit, for the record; empty without an audit."""
        if not self.audited:
            return []
        note = f"renderer.warm: {self.differed} of {self.audited} audited rays had another answer when marched anew"
        return [f"{note}: too many, so nothing was taken from memory any more" if self.disabled else note]


def render_warm(tracer: Tracer, memory: Memory, field: Field, rays: Rays) -> Rendering:
    """The rendering, starting from the cached one of the same rays; stores the new one.

    Rays with a gradient move from one iteration to the next, and are not cached. Other rays are identified by their
    tensors, which must not be changed in place.
    """
    if rays.origins.requires_grad or rays.directions.requires_grad or memory.thread != get_ident():
        return tracer.render_cold(field, rays)
    cache, solved = memory.lookup(rays), None
    if cache is not None and not memory.disabled and _is_worthwhile(cache):
        solved = _solve_cached(tracer, memory, field, rays.flat(), cache)
    if cache is None or solved is None:
        cache, solved = _march_all(tracer, field, rays, cache)
        memory.store(rays, cache)
    else:
        cache.update_hits(solved)
    return tracer.to_rendering(rays, cache.table, solved, slope_scale=cache.slope_scale)


def _march_all(tracer: Tracer, field: Field, rays: Rays, previous: CachedRays | None) -> tuple[CachedRays, Crossings]:
    """Marches all rays coarse to fine; hits of the previous rendering measure how far values have moved."""
    slope_scale = tracer.slope_scale(field, rays)
    field = normalise_slope(field, slope_scale)
    table, solved = tracer.trace(field, rays)
    movement = table.distance.new_zeros(())
    if previous is not None:
        again = solved.select(solved.converged & previous.hit[solved.index])
        movements = ((again.distance.detach() - previous.distance[again.index]) * again.slope).abs()
        movement = MOVEMENT_SAFETY_FACTOR * movements.quantile(MOVEMENT_QUANTILE) if len(movements) else movement
    with torch.no_grad():
        zeros, probes = torch.zeros_like(table.distance), _probe(field, rays.flat(), table)
    cache = CachedRays(
        table, zeros.bool(), zeros, zeros, zeros.new_zeros(()), movement, zeros.clone(), probes, slope_scale
    )
    cache.update_hits(solved)
    return cache, solved


def _is_worthwhile(cache: CachedRays) -> bool:
    """Whether enough rays will be free, if values move as far as in the last rendering."""
    free, _ = cache.still_free(cache.total_movement + cache.last_movement)
    return bool((~free).sum() <= MAX_REMARCHED_FRACTION * len(free))


def _solve_cached(tracer: Tracer, memory: Memory, field: Field, rays: Rays, cache: CachedRays) -> Crossings | None:
    """The crossings of flat rays; None if the field is steeper now, or too many rays differ or must be marched.

    The slope scale is measured again at intervals, and if the slopes at hits have changed.
    """
    table, normalised = cache.table, normalise_slope(field, cache.slope_scale)
    reusable = (cache.hit & (cache.slope < MAX_REUSABLE_SLOPE)).nonzero().squeeze(-1)
    solved = tracer.solve(normalised, rays, table, reusable, cache.distance[reusable], max_step=CLEARANCE_THRESHOLD)
    with torch.no_grad():
        ratio = torch.where(solved.converged, solved.slope / cache.slope[reusable], torch.nan).nanmedian()
        changed = not bool((ratio - 1).abs() <= MAX_SLOPE_CHANGE)  # the ratio is NaN if no root has converged
        check = changed or cache.renderings % SLOPE_CHECK_INTERVAL == 0
        if check and not abs(tracer.slope_scale(field, rays) / cache.slope_scale - 1) <= MAX_SLOPE_CHANGE:
            return None
        probe_values = _probe(normalised, rays, table)
        movement = torch.maximum(_largest(solved.first_value), _largest(probe_values - cache.probe_values))
        cache.last_movement, cache.probe_values = MOVEMENT_SAFETY_FACTOR * movement, probe_values
        cache.total_movement = cache.total_movement + cache.last_movement
        free, up_to_restart = cache.still_free(cache.total_movement)
        certain = free & ~cache.hit.index_put((reusable,), ~solved.converged)
        audited = torch.zeros_like(free)
        audited[AUDIT_OFFSET * cache.renderings % AUDIT_STRIDE :: AUDIT_STRIDE] = True
        index = (~certain | audited).nonzero().squeeze(-1)
        if len(index) > MAX_REMARCHED_FRACTION * len(free):
            return None
        resumes = up_to_restart & ~audited
        marching = table.select(index).restarted(rays[index], resumes[index], radius=tracer.sphere_radius)
    marched = tracer.resume(normalised, rays[index], marching).reindexed(index)
    with torch.no_grad():
        compared = certain & audited
        differing = compared & _differing(solved, marched, compared)
        if memory.audit(*torch.stack([compared.sum(), differing.sum()]).tolist()):
            return None
        table.replace_rays(index, marching)
        marched_at = cache.movement_when_marched
        marched_at[index] = torch.where(resumes[index], marched_at[index], cache.total_movement)
    return concatenate(solved.select((certain & ~audited)[solved.index]), marched)


def _probe(field: Field, rays: Rays, table: RayTable) -> Float[Tensor, " m"]:
    """The field's values at one point on every `PROBE_STRIDE`th ray, the same points in each rendering; 0 for NaN."""
    index = torch.arange(0, len(table.entry), PROBE_STRIDE, device=table.entry.device)
    entry, leave = table.entry[index], table.leave[index]
    fractions = torch.arange(1, len(index) + 1, dtype=entry.dtype, device=entry.device) * GOLDEN_RATIO_STEP % 1
    return field(rays[index].at(entry + fractions * (leave - entry))).nan_to_num(0.0)


def _differing(cached: Crossings, marched: Crossings, like: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Which rays hit in only one of the two renderings, or at another distance."""

    def distances(solved: Crossings) -> Float[Tensor, " n"]:
        infinite = torch.full_like(like, torch.inf, dtype=solved.distance.dtype)
        return infinite.index_put((solved.index,), solved.distance.detach().where(solved.converged, torch.inf))

    old, new = distances(cached), distances(marched)
    return ~((old == new) | ((old - new).abs() <= MISMATCH_DISTANCE))


def _largest(values: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """The largest magnitude; 0 without values, infinite if a value is not finite."""
    return values.abs().nan_to_num(torch.inf).amax() if values.numel() else values.new_zeros(())
