"""Newton: a march that stops short of the surface, and a Newton step on the value and slope that its gradient needs."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from renderers.bracket import BLOCK, Bracket, first_crossing, refine
from renderers.camera import Rays
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Field, Kind, carries_gradient
from renderers.gradients import crossing
from renderers.march import Stepping
from renderers.packed_march import Reached, Stop, approach
from renderers.rendering import Capabilities, Deferred, Rendering, Status, assemble
from renderers.silhouette import Hinge

LONGEST = 3.0  # times march_epsilon: after a longer Newton step the field is asked again, as it may not be straight
SETTLED = 0.1  # times march_epsilon: a value below it is a hit, whatever its slope


@dataclass(frozen=True)
class Newton:
    """Coarse-to-fine marching to a loose threshold, one dense search for the rays that are left, and a Newton step.

    The implicit gradient asks for the value and the slope at every hit. They also give the distance to second order, so
    that the march may stop at a threshold that is larger by a factor of 20 than DIST's.

    Source: ours. The march follows DIST, Sec. 3.2; the search DVR, Sec. 3.3; the gradient DVR, Eqs. 8 and 11.
    Differentiable in: field parameters and rays, by the implicit rule at the point before the last Newton step: off by
        that step times the surface's curvature, at most 3 `march_epsilon` over the cosine of incidence. What comes into
        view or leaves it has no part in the gradient of `distance`. That of `closest` is exact at a fixed sample, and
        left to the loss (`rendering.closest_values`); on a hit, `closest` is 0.
    Needs: a distance or a bound inside the sphere; a trained network is close enough to one. Its gradient towards
        points by automatic differentiation, also where no gradient is wanted.
    Deviates from the paper: there is none. What may be missed: parts thinner along a ray than `extra_step_cap`; in an
        image also those that a coarse ray passed on its way to a surface behind, as with DIST; on the rays of the dense
        search, what is thinner than the spacing of its samples, unless it is next to the least one. A ray that passes
        an edge closer than `march_epsilon` may hit it. `residual` is the value before the last step.

    Args:
        steps: most marching steps per ray, those of its coarse rays included; rays that are left are searched densely.
        march_epsilon: the march stops where the field's magnitude is at most this, in scene units; a Newton step does
            the rest.
        alpha, extra_step_cap: see `march.Stepping`.
        newton_steps: most evaluations of value and slope per root; a second one only where the first step is long.
        search_samples: of the dense search, between a ray's last positive value and where it leaves the sphere, and as
            many again about the least of these.
        search_steps: values per hit that narrow the interval found there.
        least_slope: see `gradients.implicit`.
        sphere_radius: of the sphere about the origin that holds the shape.
        silhouette_epsilon, silhouette_signed, silhouette_average: see `silhouette.Hinge`.
    """

    steps: int
    march_epsilon: float
    alpha: float
    extra_step_cap: float
    newton_steps: int
    search_samples: int
    search_steps: int
    least_slope: float
    sphere_radius: float
    silhouette_epsilon: float
    silhouette_signed: bool
    silhouette_average: str

    capabilities: ClassVar[Capabilities] = Capabilities(
        needs=(Kind.DISTANCE, Kind.BOUND), field_gradient=True, ray_gradient=True
    )

    def __post_init__(self) -> None:
        check_at_least("steps", self.steps, 1, "22 leave one ray in 200 to the search")
        check_positive("march_epsilon", self.march_epsilon, "1e-3 is a twentieth of a pixel at 64 x 64")
        check_at_least("alpha", self.alpha, 1, "1 is plain sphere tracing, 1.7 is aggressive marching")
        check_positive("extra_step_cap", self.extra_step_cap, "0.01 keeps parts of that thickness")
        check_at_least("newton_steps", self.newton_steps, 1, "3 are enough")
        check_at_least("search_samples", self.search_samples, 2, "32 find what a pixel shows")
        check_at_least("search_steps", self.search_steps, 0, "4 are enough")
        check_positive("least_slope", self.least_slope, "1e-3 leaves all but the most grazing rays as they are")
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")
        check_positive("silhouette_epsilon", self.silhouette_epsilon, "DIST uses 5e-5")
        check_choice("silhouette_average", self.silhouette_average, ("all", "violating"))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches and searches without a graph; the Newton steps carry the gradient."""
        flat = rays.flat()
        stepping = Stepping(
            self.march_epsilon, self.alpha, self.extra_step_cap, None, active_only=True, careful_split=True
        )
        with torch.no_grad():
            reached = approach(field, rays, stepping, steps=self.steps, radius=self.sphere_radius)
            crossed = reached.stopped(Stop.CROSSED)
            close = (crossed | reached.stopped(Stop.NEAR)).nonzero().squeeze(-1)
            guess = torch.where(crossed, reached.bracket().secant(), reached.distance)[close]
        first = self._solve(field, flat, reached, close, guess)
        with torch.no_grad():
            unsolved = close[~first.settled]
            between = unsolved[crossed[unsolved]]
            on_the_way = reached.stopped(Stop.ON_THE_WAY).nonzero().squeeze(-1)
            searched = torch.cat([unsolved[~crossed[unsolved]], on_the_way])
            found, bracket = self._search(field, flat, reached, searched)
            again = torch.cat([between, searched[found]])
            bracket = reached.some(between).bracket().joined(bracket)
            guess, _ = refine(field, flat[again], bracket, method="secant", steps=self.search_steps)
        second = self._solve(field, flat, reached, again, guess)
        return self._assembled(rays, reached, first.some(first.settled), second)

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """DIST, Eq. 11; see `silhouette.Hinge`."""
        hinge = Hinge(self.silhouette_epsilon, self.silhouette_signed, self.silhouette_average)
        return hinge.of_rendering(field, rays, rendering, mask)

    def _solve(
        self, field: Field, rays: Rays, reached: Reached, index: Int[Tensor, " m"], guess: Float[Tensor, " m"]
    ) -> "Solved":
        """Newton steps from `guess` along m of the rays; more than one only where the step is long.

        A root is settled where the step is short and stays on the ray, or the value is small. It lies at the ray's
        beginning where the step leads behind that.
        """
        towards_field = torch.is_grad_enabled() and carries_gradient(field, rays.origins)
        nothing = torch.zeros_like(guess)
        solved = Solved(index, guess, nothing, nothing, torch.zeros_like(index).bool())
        asked, longest = torch.arange(len(index), device=index.device), LONGEST * self.march_epsilon
        for _ in range(self.newton_steps):
            ray, at = index[asked], solved.distance.detach()[asked]
            found = crossing(field, rays[ray], at, towards_field=towards_field)
            slope = found.slope.clamp_max(-self.least_slope)
            step = -found.value / slope
            enters = found.value.isfinite() & (found.slope < 0)
            short = enters & (step.abs() <= longest) & (at + step <= reached.leave[ray])
            small = found.value.abs() <= SETTLED * self.march_epsilon
            step = torch.where(enters | small, step.clamp(-longest, longest), 0.0)
            step = torch.maximum(step, reached.entry[ray] - at)
            solved = solved.updated(asked, at + step - found.change / slope, found.value, found.change, short | small)
            asked = asked[enters & ~short]
            if asked.numel() == 0:
                break
        return solved

    def _search(
        self, field: Field, rays: Rays, reached: Reached, index: Int[Tensor, " m"]
    ) -> tuple[Bool[Tensor, " m"], Bracket]:
        """The first change of sign among samples of m of the rays: which of them have one, and between which samples.

        Writes into `reached` the rays' samples of least magnitude, and that a ray begins inside.
        """
        known = reached.some(index)
        start = torch.where(known.free_value.isfinite(), known.free, known.entry)
        distance, value = self._samples(field, rays[index], start, known.leave)
        ends = start.new_full((len(index), 4), torch.nan)
        _keep_crossing(ends, torch.arange(len(index), device=index.device), distance, value)
        # What is thinner than the spacing may hide beside a small value in front of the change of sign.
        free = torch.where((value <= 0).cumsum(dim=1) > 0, torch.inf, value.nan_to_num(torch.inf))
        least, place = free.min(dim=1)
        nearest = distance.gather(1, place[:, None]).squeeze(1)
        known.keep_least(nearest, least)
        inside = value[:, 0] < 0
        known.table[:, Reached.STOP] = torch.where(inside, float(Stop.INSIDE), known.table[:, Reached.STOP])
        reached.table[index] = known.table
        spacing = (known.leave - start) / (self.search_samples - 1)
        again = ((least < spacing / 2) & ~inside).nonzero().squeeze(-1)
        low, high = torch.maximum(nearest - spacing, start), torch.minimum(nearest + spacing, known.leave)
        distance, value = self._samples(field, rays[index[again]], low[again], high[again])
        _keep_crossing(ends, again, distance, value)
        found = ends[:, 0].isfinite() & ~inside
        return found, Bracket(*ends[found].unbind(dim=1))

    def _samples(
        self, field: Field, rays: Rays, start: Float[Tensor, " m"], end: Float[Tensor, " m"]
    ) -> tuple[Float[Tensor, "m samples"], Float[Tensor, "m samples"]]:
        """Equally spaced distances from `start` to `end`, and the field's values there."""
        shares = torch.linspace(0, 1, self.search_samples, dtype=start.dtype, device=start.device)
        distance = start[:, None] + shares * (end - start)[:, None]
        points = rays.origins[:, None] + distance[..., None] * rays.directions[:, None]
        return distance, torch.cat([field(some) for some in points.split(max(BLOCK // self.search_samples, 1))])

    def _assembled(self, rays: Rays, reached: Reached, *parts: "Solved") -> Rendering:
        """The rendering, with the gradient of hits; that of other rays' closest values is left to the loss."""
        inside, not_finite = reached.stopped(Stop.INSIDE), reached.stopped(Stop.NOT_FINITE)
        status = torch.full_like(inside, Status.MISS, dtype=torch.int8)
        status[inside], status[not_finite] = Status.STARTED_INSIDE, Status.OUT_OF_STEPS
        distance = torch.where(inside, reached.entry, torch.where(not_finite, reached.distance, reached.leave))
        residual, closest = reached.value.clone(), reached.least.clone()
        for part in parts:
            index, settled = part.index, part.settled
            status[index] = torch.where(settled, Status.HIT, Status.OUT_OF_STEPS).to(status.dtype)
            residual[index] = part.value.nan_to_num(0.0)
            distance = distance.index_put((index,), torch.where(settled, part.distance, part.distance.detach()))
            closest = closest.index_put((index[settled],), part.change[settled])
        sampled = reached.least.isfinite()
        queried = sampled.nonzero().squeeze(-1)
        rendering = assemble(
            rays,
            self.sphere_radius,
            distance=distance,
            status=status,
            residual=residual,
            closest=(queried, closest[queried]),
        )
        left_out = (sampled & (status != Status.HIT)).view(rays.shape)
        return replace(rendering, deferred=Deferred(reached.least_distance.clone().view(rays.shape), left_out))


@dataclass(frozen=True)
class Solved:
    """Where m of the rays, at `index`, cross the surface, as far as they are `settled`; see `gradients.Crossing`."""

    index: Int[Tensor, " m"]
    distance: Float[Tensor, " m"]
    value: Float[Tensor, " m"]
    change: Float[Tensor, " m"]
    settled: Bool[Tensor, " m"]

    def some(self, which: Bool[Tensor, " m"]) -> "Solved":
        """The same of some of them."""
        return Solved(*(part[which] for part in (self.index, self.distance, self.value, self.change, self.settled)))

    def updated(
        self, some: Int[Tensor, " k"], distance: Tensor, value: Tensor, change: Tensor, settled: Tensor
    ) -> "Solved":
        """The same with other answers for some of them."""
        return Solved(
            self.index,
            self.distance.index_put((some,), distance),
            self.value.index_put((some,), value),
            self.change.index_put((some,), change),
            self.settled.index_put((some,), settled),
        )


def _keep_crossing(ends: Float[Tensor, "m 4"], index: Int[Tensor, " k"], distance: Tensor, value: Tensor) -> None:
    """Writes the first change of sign among the samples of k rays, where they have one, as the ends of a Bracket."""
    found, bracket = first_crossing(distance, value)
    ends[index[found]] = torch.stack([bracket.near, bracket.far, bracket.near_value, bracket.far_value], dim=1)
