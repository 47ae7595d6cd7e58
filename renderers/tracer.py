"""What finds the surface along rays for `newton.Newton`: a march across it, Newton steps, a search for the rest."""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.bracket import BLOCK, Bracket, evenly, first_crossing, refine
from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import PATIENT, Coarse, Field, Kind, Values, Wrapper, carries_gradient, coarse_of, points_in_sphere
from renderers.gradients import crossing
from renderers.packed_march import Reached, Stop, Stride, approach, march
from renderers.rendering import Deferred, Rendering, Status, assemble

# Scene units, times the slope along the ray: after a longer Newton step the field is asked again, since a step is off
# by its square over the slope, times half the field's curvature.
LONGEST = 0.006
OF_BOUNDS = 5  # times `steps`, on a bound, whose values are a part of the distance
NO_NEARER = 0.25  # times the error of coarse values: to how small ones rays are marched
PAIRS, SPAN = 64, 0.1  # of points between which the steepness is measured; how far apart they are, in radii
MOST = 0.95  # quantile of the slopes between them: a few places do not decide the steps everywhere
STEEP = 1.2  # up to which values are taken for distances


@dataclass(frozen=True)
class Tracer:
    """Marches coarse to fine until the sign changes, solves for the crossings by Newton steps, searches for the rest.

    Args:
        steps: most marching steps per ray, beside those of its coarse rays; rays that are left are searched densely.
            `PATIENT` times as many on coarse values, and after it for those in doubt on the field; see `OF_BOUNDS`.
        march_epsilon: the march stops where the field's magnitude is at most this, in scene units; a Newton step does
            the rest. A value so little behind the surface is a hit, whatever its slope.
        unseen: of a ray, between the samples of the march; see `packed_march.Stride`.
        newton_steps: most evaluations of value and slope per root; a second one only where the first step is long.
        search_samples: of the dense search, from a ray's last value above the threshold to where it leaves the sphere,
            and as many again about the least of these.
        search_steps: values per hit that narrow the interval found there.
        least_slope: see `gradients.implicit`.
        sphere_radius: of the sphere about the origin that holds the shape.
        coarse: whether rays are first marched on the field's coarse values, where it offers any.
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
        """How the march steps on values that are off by at most `error`."""
        return Stride(max(self.march_epsilon, NO_NEARER * error), self.unseen)

    def trace(self, field: Field, rays: Rays) -> tuple[Reached, "Solved"]:
        """Where all rays end, marched without a graph, and their crossings, which carry the gradient."""
        with torch.no_grad():
            asked = self._asked(field)
            steps = self._most(field) * (1 if asked.values is field else PATIENT)
            stride, error = self.stride(asked.error), asked.error
            reached = approach(asked.values, rays, stride, steps=steps, radius=self.sphere_radius, error=error)
        return reached, self._crossings_after(field, rays.flat(), reached, asked)

    def resume(self, field: Field, rays: Rays, reached: Reached) -> "Solved":
        """Marches flat rays on from where they are, in place, and gives their crossings, which carry the gradient."""
        with torch.no_grad():
            asked = self._asked(field)
            march(asked.values, rays, reached, self.stride(asked.error), self._most(field))
        return self._crossings_after(field, rays, reached, asked)

    def steepness(self, field: Field, rays: Rays) -> float:
        """By what a field's values are to be divided before rays are marched on them; see `Evened`.

        Those of a bound are lengths that a step may take, however steep they are.
        """
        if field.kind is not Kind.DISTANCE:
            return 1.0
        return measured_steepness(self._asked(field).values, rays.origins, radius=self.sphere_radius)

    def render_anew(self, field: Field, rays: Rays) -> Rendering:
        """The rendering, without knowledge of an earlier one."""
        steepness = self.steepness(field, rays)
        return self.assembled(rays, *self.trace(evened(field, steepness), rays), steepness=steepness)

    def _most(self, field: Field) -> int:
        """The most marching steps per ray of a field of this kind."""
        return self.steps * (OF_BOUNDS if field.kind is Kind.BOUND else 1)

    def _asked(self, field: Field) -> Coarse:
        """What the march asks: the field's coarse values where it offers any, else the field itself."""
        return (coarse_of(field) if self.coarse else None) or Coarse(field, 0.0)

    def _crossings_after(self, field: Field, rays: Rays, reached: Reached, asked: Coarse) -> "Solved":
        """The crossings of flat rays that were marched on these values."""
        if asked.values is field:
            return self._crossings(field, rays, reached)
        return self._decided(field, rays, reached, asked.error)

    def _decided(self, field: Field, rays: Rays, reached: Reached, error: float) -> "Solved":
        """The crossings of flat rays that were marched on coarse values, which are off by at most `error`.

        A ray is certain if it left the sphere, or a Newton step on the field settled; and if it rose from no value
        within `error` before, but for values that a step was taken back from. The others are marched again from their
        anchors, on the field itself.
        """
        first = self._close(field, rays, reached)
        with torch.no_grad():
            certain = reached.stopped(Stop.LEFT).index_put((first.index,), first.settled) & (reached.grazed > error)
            index = (~certain).nonzero().squeeze(-1)
            doubtful, anchored = rays[index], torch.ones_like(index, dtype=torch.bool)
            again = reached.some(index).begun_again(doubtful, anchored, radius=self.sphere_radius)
            march(field, doubtful, again, self.stride(), PATIENT * self._most(field))
        second = self._crossings(field, doubtful, again).among(index)
        reached.put_back(index, again)
        reached.passed -= error
        return first.some(certain[first.index]).joined(second)

    def _close(self, field: Field, rays: Rays, reached: Reached) -> "Solved":
        """The crossings of those flat rays that stopped close to a surface."""
        with torch.no_grad():
            crossed = reached.stopped(Stop.CROSSED)
            close = (crossed | reached.stopped(Stop.NEAR)).nonzero().squeeze(-1)
            guess = torch.where(crossed, reached.bracket().secant(), reached.distance)[close]
        return self.solve(field, rays, reached, close, guess)

    def _crossings(self, field: Field, rays: Rays, reached: Reached) -> "Solved":
        """Where flat rays cross the surface, from where the march left them; in `reached`, also what a search saw."""
        first = self._close(field, rays, reached)
        with torch.no_grad():
            crossed = reached.stopped(Stop.CROSSED)
            unsolved = torch.zeros_like(crossed).index_put((first.index,), ~first.settled)
            between = (unsolved & crossed).nonzero().squeeze(-1)
            searched = ((unsolved & ~crossed) | reached.stopped(Stop.ON_THE_WAY)).nonzero().squeeze(-1)
            found, bracket = self._search(field, rays, reached, searched)
            again = torch.cat([between, searched[found]])
            bracket = reached.some(between).bracket().joined(bracket)
            guess, _ = refine(field, rays[again], bracket, method="secant", steps=self.search_steps)
        second = self.solve(field, rays, reached, again, guess)
        return first.some(first.settled).joined(second)

    def solve(
        self,
        field: Field,
        rays: Rays,
        reached: Reached,
        index: Int[Tensor, " m"],
        guess: Float[Tensor, " m"],
        *,
        furthest: float = LONGEST,
    ) -> "Solved":
        """Newton steps from `guess` along m of the rays; more than one only where the step is long.

        A root is settled where the step is short and stays on the ray, or the value is hardly negative. It lies at the
        ray's beginning where the step leads behind that.

        Args:
            furthest: longest step, in scene units.
        """
        towards_field = torch.is_grad_enabled() and carries_gradient(field, rays.origins)
        nothing = torch.zeros_like(guess)
        solved = Solved(index, guess, nothing, nothing, nothing, nothing, torch.zeros_like(index).bool())
        asked = torch.arange(len(index), device=index.device)
        for steps_before in range(self.newton_steps):
            ray, at = index[asked], solved.distance.detach()[asked]
            found = crossing(field, rays[ray], at, towards_field=towards_field)
            slope = found.slope.clamp_max(-self.least_slope)
            step = -found.value / slope
            enters = found.value.isfinite() & (found.slope < 0)
            steep = found.slope.abs()
            short = enters & (found.value.abs() <= LONGEST * steep * steep.clamp_max(1.0))
            short &= at + step <= reached.leave[ray]
            small = (found.value <= 0) & (found.value >= -self.march_epsilon)
            step = torch.where(enters | small, step.clamp(-furthest, furthest), 0.0)
            step = torch.maximum(step, reached.entry[ray] - at)
            distance = at + step - found.change / slope
            begun = solved.begun[asked] if steps_before else found.value
            solved = solved.updated(asked, distance, found.value, found.slope, begun, found.change, short | small)
            if steps_before + 1 == self.newton_steps or (asked := asked[enters & ~short]).numel() == 0:
                break
        return solved

    def _search(
        self, field: Field, rays: Rays, reached: Reached, index: Int[Tensor, " m"]
    ) -> tuple[Int[Tensor, " k"], Bracket]:
        """The first change of sign among samples of m of the rays: which k have one, and between which samples it is.

        Writes into `reached` the rays' samples of least magnitude, and that a ray begins inside.
        """
        known = reached.some(index)
        start = torch.where(known.free_value.isfinite(), known.free, known.entry)
        distance, value = self._samples(field, rays[index], start, known.leave)
        found, bracket = first_crossing(distance, value)
        # What is thinner than the spacing may hide beside a small value in front of the change of sign.
        in_front = torch.where((value <= 0).cumsum(dim=1) > 0, torch.inf, value.nan_to_num(torch.inf))
        least, place = in_front.min(dim=1)
        nearest = distance.gather(1, place[:, None]).squeeze(1)
        known.keep_least(nearest, least)
        inside = value[:, 0] < 0
        known.stop = torch.where(inside, Stop.INSIDE, known.stop)
        reached.table[index] = known.table
        spacing = (known.leave - start) / (self.search_samples - 1)
        again = ((least < spacing / 2) & ~inside).nonzero().squeeze(-1)
        low, high = torch.maximum(nearest - spacing, start), torch.minimum(nearest + spacing, known.leave)
        distance, value = self._samples(field, rays[index[again]], low[again], high[again])
        closer, ends = first_crossing(distance, value)
        bracket = bracket.replaced(again, closer, ends)
        some = (found.index_put((again,), found[again] | closer) & ~inside).nonzero().squeeze(-1)
        return some, bracket.some(some)

    def _samples(
        self, field: Field, rays: Rays, start: Float[Tensor, " m"], end: Float[Tensor, " m"]
    ) -> tuple[Float[Tensor, "m samples"], Float[Tensor, "m samples"]]:
        """Equally spaced distances from `start` to `end`, and the field's values there."""
        distance = evenly(start, end, self.search_samples)
        points = rays.at_each(distance)
        return distance, torch.cat([field(some) for some in points.split(max(BLOCK // self.search_samples, 1))])

    def assembled(self, rays: Rays, reached: Reached, solved: "Solved", *, steepness: float) -> Rendering:
        """The rendering, with the gradient of hits; that of other rays' closest values is left to the loss.

        Args:
            rays: of any leading shape.
            reached, solved: of the field divided by its steepness.
            steepness: by which its values are multiplied again.
        """
        inside, not_finite = reached.stopped(Stop.INSIDE), reached.stopped(Stop.NOT_FINITE)
        status = torch.where(not_finite, Status.OUT_OF_STEPS, Status.MISS)
        status = torch.where(inside, Status.STARTED_INSIDE, status).to(torch.int8)
        distance = torch.where(inside, reached.entry, torch.where(not_finite, reached.distance, reached.leave))
        residual, closest = reached.value.clone(), reached.least.clone()
        index, settled = solved.index, solved.settled
        status[index] = torch.where(settled, Status.HIT, Status.OUT_OF_STEPS).to(status.dtype)
        residual[index] = solved.value.nan_to_num(0.0)
        distance = distance.index_put((index,), torch.where(settled, solved.distance, solved.distance.detach()))
        closest = closest.index_put((index,), torch.where(settled, solved.change, closest[index]))
        sampled = reached.least.isfinite()
        queried = sampled.nonzero().squeeze(-1)
        rendering = assemble(
            rays,
            self.sphere_radius,
            distance=distance,
            status=status,
            residual=steepness * residual,
            closest=(queried, steepness * closest[queried]),
        )
        left_out = (sampled & (status != Status.HIT)).view(rays.shape)
        return replace(rendering, deferred=Deferred(reached.least_distance.clone().view(rays.shape), left_out))


@dataclass(frozen=True)
class Solved:
    """Where m of the rays, at `index`, cross the surface, as far as they are `settled`; see `gradients.Crossing`.

    `begun` is the value where the first step began.
    """

    index: Int[Tensor, " m"]
    distance: Float[Tensor, " m"]
    value: Float[Tensor, " m"]
    slope: Float[Tensor, " m"]
    begun: Float[Tensor, " m"]
    change: Float[Tensor, " m"]
    settled: Bool[Tensor, " m"]

    @property
    def columns(self) -> tuple[Tensor, ...]:
        """The tensors in the order of the constructor."""
        return tuple(getattr(self, column.name) for column in fields(self))

    def some(self, which: Bool[Tensor, " m"]) -> "Solved":
        """The same of some of them."""
        index = which.nonzero().squeeze(-1)
        return Solved(*(column.index_select(0, index) for column in self.columns))

    def among(self, index: Int[Tensor, " n"]) -> "Solved":
        """The same, with `index` counted among the n rays from which these were chosen by `index`."""
        return replace(self, index=index[self.index])

    def joined(self, other: "Solved") -> "Solved":
        """These, and behind them the others."""
        return Solved(*(torch.cat(pair) for pair in zip(self.columns, other.columns, strict=True)))

    def updated(self, some: Int[Tensor, " k"], *columns: Tensor) -> "Solved":
        """The same with other answers for some of them: the columns behind the index."""
        pairs = zip(self.columns[1:], columns, strict=True)
        return Solved(self.index, *(old.index_put((some,), new) for old, new in pairs))


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
    points = radius * points_in_sphere(PAIRS, like)
    towards = torch.nn.functional.normalize(points.roll(1, dims=0) - points, dim=-1)
    here, there = values(torch.cat([points, points + SPAN * radius * towards])).chunk(2)
    slopes = (here - there).abs() / (SPAN * radius)
    steepness = float(torch.where(here.isfinite() & there.isfinite(), slopes, torch.nan).nanquantile(MOST))
    return steepness if steepness > STEEP else 1.0  # not a number where no value is finite
