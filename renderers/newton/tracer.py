"""Finds the surface along rays for `newton.Newton`: a march across it, Newton steps, and a search for the rest."""

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import (
    COARSE_STEP_FACTOR,
    Coarse,
    Field,
    Kind,
    PointFunction,
    Wrapper,
    carries_gradient,
    coarse_version,
    points_in_sphere,
)
from renderers.gradients import evaluate_crossing
from renderers.newton.packed_march import RayTable, Stop, Stride, march_rays, march_table
from renderers.rendering import Deferred, Rendering, Status, assemble
from renderers.tracing.bracket import SAMPLES_PER_BATCH, Bracket, equally_spaced, first_crossing, refine

# Scene units, times the slope along the ray: after a longer Newton step the field is evaluated again, since a step is
# off by its square over the slope, times half the field's curvature.
MAX_NEWTON_STEP = 0.006
BOUND_STEP_FACTOR = 5  # a bound gets this many times `steps`, since its values are smaller than the distance
COARSE_EPSILON_FACTOR = 0.25  # a march on coarse values stops at this fraction of their error
SLOPE_PAIR_COUNT, SLOPE_PAIR_DISTANCE = 64, 0.1  # the distance between the points of a pair is in sphere radii
SLOPE_QUANTILE = 0.95  # below the maximum: a few steep places do not shorten the steps everywhere
MAX_DISTANCE_SLOPE = 1.2  # values that are at most this steep count as distances


@dataclass(frozen=True)
class Tracer:
    """Marches coarse to fine until the sign changes, solves for the crossings by Newton steps, searches for the rest.

    Args:
        steps: maximum marching steps per ray, without those of its coarse rays; unfinished rays are searched densely.
            On coarse values `COARSE_STEP_FACTOR` times as many, as then on the field for doubtful rays. On a bound
            `BOUND_STEP_FACTOR` times as many.
        march_epsilon: the march stops if the field's magnitude is at most this, in scene units; a Newton step does the
            rest. A value so little behind the surface is a hit, whatever its slope.
        unseen: the longest gap between the empty spheres about samples of the march; see `packed_march.Stride`.
        newton_steps: maximum evaluations of value and slope per root; a second one only if the first step is long.
        search_samples: of the dense search, from a ray's last value above the threshold to where it leaves the sphere,
            and as many again around the smallest of these samples.
        search_steps: field evaluations per hit that narrow the interval of the search.
        least_slope: see `gradients.attach_implicit_gradient`.
        sphere_radius: of the sphere about the origin that contains the shape.
        coarse: whether rays are first marched on the field's coarse values, if it has any.
    """

    steps: int
    march_epsilon: float
    unseen: float
    newton_steps: int
    search_samples: int
    search_steps: int
    least_slope: float
    sphere_radius: float
    coarse: bool

    def __post_init__(self) -> None:
        check_at_least("steps", self.steps, 1, "20 leave one ray in 300 to the search")
        check_positive("march_epsilon", self.march_epsilon, "1e-4 is a two-hundredth of a pixel at 64 x 64")
        check_positive("unseen", self.unseen, "0.005 may miss what is 1.5 times as long on a ray")
        check_at_least("newton_steps", self.newton_steps, 1, "3 are enough")
        check_at_least("search_samples", self.search_samples, 2, "32 find what a pixel shows")
        check_at_least("search_steps", self.search_steps, 0, "4 are enough")
        check_positive("least_slope", self.least_slope, "0.03 keeps grazing rays from throwing a fit off")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")

    def stride(self, error: float = 0.0) -> Stride:
        """The settings of a march on values with at most this error."""
        return Stride(max(self.march_epsilon, COARSE_EPSILON_FACTOR * error), self.unseen)

    def trace(self, field: Field, rays: Rays) -> tuple[RayTable, "Crossings"]:
        """Where all rays stop, marched without a graph, and their crossings, which carry the gradient."""
        with torch.no_grad():
            marching = self._marching_field(field)
            steps = self._max_steps(field) * (1 if marching.values is field else COARSE_STEP_FACTOR)
            stride, error = self.stride(marching.error), marching.error
            table = march_rays(marching.values, rays, stride, steps=steps, radius=self.sphere_radius, error=error)
        return table, self._crossings_after(field, rays.flat(), table, marching)

    def resume(self, field: Field, rays: Rays, table: RayTable) -> "Crossings":
        """Marches flat rays on from where they are, in place; returns their crossings, which carry the gradient."""
        with torch.no_grad():
            marching = self._marching_field(field)
            march_table(marching.values, rays, table, self.stride(marching.error), self._max_steps(field))
        return self._crossings_after(field, rays, table, marching)

    def slope_scale(self, field: Field, rays: Rays) -> float:
        """The number by which a field's values are divided before rays are marched on them; see `SlopeNormalised`.

        1 for a bound: a step may be as long as its value, however steep the bound is.
        """
        if field.kind is not Kind.DISTANCE:
            return 1.0
        return measure_slope_scale(self._marching_field(field).values, rays.origins, radius=self.sphere_radius)

    def render_cold(self, field: Field, rays: Rays) -> Rendering:
        """The rendering, without the memory of an earlier one."""
        slope_scale = self.slope_scale(field, rays)
        return self.to_rendering(rays, *self.trace(normalise_slope(field, slope_scale), rays), slope_scale=slope_scale)

    def _max_steps(self, field: Field) -> int:
        """The maximum marching steps per ray for this kind of field."""
        return self.steps * (BOUND_STEP_FACTOR if field.kind is Kind.BOUND else 1)

    def _marching_field(self, field: Field) -> Coarse:
        """The values to march on: the field's coarse values if it has any, else the field itself."""
        return (coarse_version(field) if self.coarse else None) or Coarse(field, 0.0)

    def _crossings_after(self, field: Field, rays: Rays, table: RayTable, marching: Coarse) -> "Crossings":
        """The crossings of flat rays after a march on these values."""
        if marching.values is field:
            return self._crossings(field, rays, table)
        return self._resolve_doubtful_rays(field, rays, table, marching.error)

    def _resolve_doubtful_rays(self, field: Field, rays: Rays, table: RayTable, error: float) -> "Crossings":
        """The crossings of flat rays after a march on coarse values with at most this error.

        A ray is certain if it left the sphere or a Newton step on the field converged, and if it never came within
        `error` of the surface before. Values from which a step back was taken do not count. The other rays are marched
        again from their restart distance, on the field itself.
        """
        first = self._solve_near_hits(field, rays, table)
        with torch.no_grad():
            left, clear = table.stopped(Stop.LEFT), table.ray_clearance > error
            certain = left.index_put((first.index,), first.converged) & clear
            index = (~certain).nonzero().squeeze(-1)
            doubtful, resumes = rays[index], torch.ones_like(index, dtype=torch.bool)
            restarted = table.select(index).restarted(doubtful, resumes, radius=self.sphere_radius)
            march_table(field, doubtful, restarted, self.stride(), COARSE_STEP_FACTOR * self._max_steps(field))
        second = self._crossings(field, doubtful, restarted).reindexed(index)
        table.replace_rays(index, restarted)
        table.path_clearance = table.path_clearance - error
        return concatenate(first.select(certain[first.index]), second)

    def _solve_near_hits(self, field: Field, rays: Rays, table: RayTable) -> "Crossings":
        """The crossings of the flat rays that stopped close to a surface."""
        with torch.no_grad():
            crossed = table.stopped(Stop.CROSSED)
            near = (crossed | table.stopped(Stop.NEAR_SURFACE)).nonzero().squeeze(-1)
            guess = torch.where(crossed, table.bracket().secant(), table.distance)[near]
        return self.solve(field, rays, table, near, guess)

    def _crossings(self, field: Field, rays: Rays, table: RayTable) -> "Crossings":
        """Where flat rays cross the surface after the march; writes the samples of a search to `table`."""
        first = self._solve_near_hits(field, rays, table)
        with torch.no_grad():
            crossed = table.stopped(Stop.CROSSED)
            unsolved = torch.zeros_like(crossed).index_put((first.index,), ~first.converged)
            bracketed = (unsolved & crossed).nonzero().squeeze(-1)
            searched = ((unsolved & ~crossed) | table.stopped(Stop.MARCHING)).nonzero().squeeze(-1)
            hits, bracket = self._search(field, rays, table, searched)
            retried = torch.cat([bracketed, searched[hits]])
            bracket = concatenate(table.select(bracketed).bracket(), bracket)
            guess, _ = refine(field, rays[retried], bracket, method="secant", steps=self.search_steps)
        second = self.solve(field, rays, table, retried, guess)
        return concatenate(first.select(first.converged), second)

    def solve(
        self,
        field: Field,
        rays: Rays,
        table: RayTable,
        index: Int[Tensor, " m"],
        guess: Float[Tensor, " m"],
        *,
        max_step: float = MAX_NEWTON_STEP,
    ) -> "Crossings":
        """Newton steps from `guess` along m of the rays; more than one only if the step is long.

        A root has converged if the step is short and stays on the ray, or if the value is hardly negative. A step that
        leads behind the ray's start ends there.

        Args:
            max_step: maximum length of a step, in scene units.
        """
        towards_field = torch.is_grad_enabled() and carries_gradient(field, rays.origins)
        zeros = torch.zeros_like(guess)
        solved = Crossings(index, guess, zeros, zeros, zeros, zeros, torch.zeros_like(index).bool())
        pending = torch.arange(len(index), device=index.device)
        for steps_before in range(self.newton_steps):
            ray, start = index[pending], solved.distance.detach()[pending]
            crossing = evaluate_crossing(field, rays[ray], start, towards_field=towards_field)
            value, slope = crossing.value, crossing.slope.clamp_max(-self.least_slope)
            step = -value / slope
            enters = value.isfinite() & (crossing.slope < 0)
            steepness = crossing.slope.abs()
            short = enters & (value.abs() <= MAX_NEWTON_STEP * steepness * steepness.clamp_max(1.0))
            short &= start + step <= table.leave[ray]
            small = (value <= 0) & (value >= -self.march_epsilon)
            step = torch.where(enters | small, step.clamp(-max_step, max_step), 0.0)
            step = torch.maximum(step, table.entry[ray] - start)
            distance = start + step - crossing.change / slope
            first_value = solved.first_value[pending] if steps_before else value
            columns = distance, value, crossing.slope, first_value, crossing.change, short | small
            pairs = zip(solved.columns[1:], columns, strict=True)
            solved = Crossings(index, *(old.index_put((pending,), new) for old, new in pairs))
            if steps_before + 1 == self.newton_steps or (pending := pending[enters & ~short]).numel() == 0:
                break
        return solved

    def _search(
        self, field: Field, rays: Rays, table: RayTable, index: Int[Tensor, " m"]
    ) -> tuple[Int[Tensor, " k"], Bracket]:
        """The first change of sign among samples of m of the rays: the k rays that have one, and its bracket.

        Writes to `table` the rays' samples of smallest magnitude, and which rays start inside.
        """
        searched = table.select(index)
        start = torch.where(searched.free_value.isfinite(), searched.free, searched.entry)
        distance, value = self._samples(field, rays[index], start, searched.leave)
        crosses, bracket = first_crossing(distance, value)
        # A part that is thinner than the spacing may lie next to a small value in front of the change of sign.
        in_front = torch.where((value <= 0).cumsum(dim=1) > 0, torch.inf, value.nan_to_num(torch.inf))
        smallest, sample = in_front.min(dim=1)
        nearest = distance.gather(1, sample[:, None]).squeeze(1)
        searched.update_smallest_sample(nearest, smallest)
        inside = value[:, 0] < 0
        searched.stop = torch.where(inside, Stop.INSIDE, searched.stop)
        table.replace_rays(index, searched)
        spacing = (searched.leave - start) / (self.search_samples - 1)
        resampled = ((smallest < spacing / 2) & ~inside).nonzero().squeeze(-1)
        low, high = torch.maximum(nearest - spacing, start), torch.minimum(nearest + spacing, searched.leave)
        distance, value = self._samples(field, rays[index[resampled]], low[resampled], high[resampled])
        crosses_resampled, closer = first_crossing(distance, value)
        pairs = zip(bracket.columns, closer.columns, strict=True)
        merged = [(old, torch.where(crosses_resampled, new, old[resampled])) for old, new in pairs]
        bracket = Bracket(*(old.index_put((resampled,), new) for old, new in merged))
        hits = (crosses.index_put((resampled,), crosses[resampled] | crosses_resampled) & ~inside).nonzero().squeeze(-1)
        return hits, bracket.select(hits)

    def _samples(
        self, field: Field, rays: Rays, start: Float[Tensor, " m"], end: Float[Tensor, " m"]
    ) -> tuple[Float[Tensor, "m samples"], Float[Tensor, "m samples"]]:
        """Equally spaced distances from `start` to `end`, and the field's values there."""
        distance = equally_spaced(start, end, self.search_samples)
        batches = rays.at_each(distance).split(max(SAMPLES_PER_BATCH // self.search_samples, 1))
        return distance, torch.cat([field(points) for points in batches])

    def to_rendering(self, rays: Rays, table: RayTable, solved: "Crossings", *, slope_scale: float) -> Rendering:
        """The rendering, with the gradient of hits; the loss attaches the gradient of other rays' closest values.

        Args:
            rays: of any leading shape.
            table, solved: of the field divided by `slope_scale`.
            slope_scale: the rendering's values are multiplied by it again.
        """
        inside, not_finite = table.stopped(Stop.INSIDE), table.stopped(Stop.NOT_FINITE)
        status = torch.where(not_finite, Status.OUT_OF_STEPS, Status.MISS)
        status = torch.where(inside, Status.STARTED_INSIDE, status).to(torch.int8)
        distance = torch.where(inside, table.entry, torch.where(not_finite, table.distance, table.leave))
        residual, closest = table.value.clone(), table.least.clone()
        index, converged = solved.index, solved.converged
        status[index] = torch.where(converged, Status.HIT, Status.OUT_OF_STEPS).to(status.dtype)
        residual[index] = solved.value.nan_to_num(0.0)
        distance = distance.index_put((index,), torch.where(converged, solved.distance, solved.distance.detach()))
        closest = closest.index_put((index,), torch.where(converged, solved.change, closest[index]))
        sampled = table.least.isfinite()
        queried = sampled.nonzero().squeeze(-1)
        rendering = assemble(
            rays,
            self.sphere_radius,
            distance=distance,
            status=status,
            residual=slope_scale * residual,
            closest=(queried, slope_scale * closest[queried]),
        )
        left_out = (sampled & (status != Status.HIT)).view(rays.shape)
        return replace(rendering, deferred=Deferred(table.least_distance.clone().view(rays.shape), left_out))


@dataclass(frozen=True)
class Crossings:
    """Where m of the rays, in `index`, cross the surface, if they have `converged`; see `gradients.Crossing`.

    `first_value` is the value before the first Newton step.
    """

    index: Int[Tensor, " m"]
    distance: Float[Tensor, " m"]
    value: Float[Tensor, " m"]
    slope: Float[Tensor, " m"]
    first_value: Float[Tensor, " m"]
    change: Float[Tensor, " m"]
    converged: Bool[Tensor, " m"]

    @property
    def columns(self) -> tuple[Tensor, ...]:
        """The tensors in the order of the constructor."""
        return tuple(getattr(self, column.name) for column in fields(self))

    def select(self, chosen: Bool[Tensor, " m"]) -> "Crossings":
        """The chosen crossings."""
        index = chosen.nonzero().squeeze(-1)
        return Crossings(*(column.index_select(0, index) for column in self.columns))

    def reindexed(self, index: Int[Tensor, " n"]) -> "Crossings":
        """The same crossings, for rays that were selected by `index`: their index counts all rays."""
        return replace(self, index=index[self.index])


Columns = TypeVar("Columns", Bracket, Crossings)


def concatenate(first: Columns, second: Columns) -> Columns:
    """The first ones, followed by the second ones."""
    return type(first)(*(torch.cat(pair) for pair in zip(first.columns, second.columns, strict=True)))


@dataclass(frozen=True)
class SlopeNormalised(Wrapper):
    """A field whose values are divided by `slope_scale`, so that it is about as steep as a distance."""

    inner: Field
    slope_scale: float

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.inner(points) / self.slope_scale

    @property
    def coarse(self) -> Coarse | None:
        """The field's coarse values and their error, divided too."""
        coarse, scale = coarse_version(self.inner), self.slope_scale
        return coarse and Coarse(lambda points: coarse.values(points) / scale, coarse.error / scale)


def normalise_slope(field: Field, slope_scale: float) -> Field:
    """The field divided by `slope_scale`; the field itself if that is 1."""
    if slope_scale == 1:
        return field
    return SlopeNormalised(field, slope_scale)  # pyright: ignore[reportReturnType] (it is frozen)


@torch.no_grad()
def measure_slope_scale(values: PointFunction, like: Float[Tensor, "*batch 3"], *, radius: float) -> float:
    """How steep values are between pairs of points in the sphere; 1 if that is at most `MAX_DISTANCE_SLOPE`.

    Values that are not finite do not count. Those behind the surface do: in front of it most fields are as steep.

    Args:
        like: points of the dtype and device at which values are evaluated.
        radius: of the sphere about the origin that contains the points.
    """
    points = radius * points_in_sphere(SLOPE_PAIR_COUNT, like)
    distance = SLOPE_PAIR_DISTANCE * radius
    towards_next = torch.nn.functional.normalize(points.roll(1, dims=0) - points, dim=-1)
    first, second = values(torch.cat([points, points + distance * towards_next])).chunk(2)
    slopes = torch.where(first.isfinite() & second.isfinite(), (first - second).abs() / distance, torch.nan)
    slope_scale = float(slopes.nanquantile(SLOPE_QUANTILE))
    return slope_scale if slope_scale > MAX_DISTANCE_SLOPE else 1.0  # also if no value is finite: it is NaN then
