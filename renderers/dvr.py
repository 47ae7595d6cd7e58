"""DVR: samples along the ray, a secant to the surface, and the implicit gradient (Niemeyer et al., CVPR 2020)."""

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays, sphere_span
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Field
from renderers.gradients import attach_implicit_gradient, reevaluate_with_graph
from renderers.rendering import LEVEL_SET_CAPABILITIES, Capabilities, RayObservation, Rendering, Status, assemble
from renderers.schedule import schedule_position
from renderers.silhouette import OCCUPANCY_POINTS, Occupancy
from renderers.tracing.bracket import REFINEMENTS, SAMPLES_PER_BATCH, equally_spaced, first_crossing, refine


@dataclass(frozen=True)
class DVR:
    """Differentiable volumetric rendering: the first change from free to occupied among equally spaced samples.

    Source: DVR, Secs. 3.2, 3.3, 3.5.
    Differentiable in: field parameters and rays, by the implicit rule (Eqs. 8, 11), exactly, up to the error of the
        refined root. The gradient of `distance` lacks the visibility gradient.
    Needs: any level set: only signs are searched. Parts thinner along the ray than the spacing may be missed.
    Deviates from the paper: the first sample lies where the ray enters the volume (Eq. 9 from j = 0, as in the official
        code), which is the unit sphere. A ray that starts occupied has STARTED_INSIDE. Rays have a gradient, unlike in
        the official code. If the slope along the ray is nearly 0, its sign is kept; the official code takes it as
        negative.
        `early_stop` is ours. L_occupancy (Eq. 15) is at a random point even if depth is observed, unless `occupied_at`
        is "depth". With several masks of one object, the paper uses the depth of the visual hull; here a task can
        provide it as the observed depth (`task.guide=hull` of task=reconstruction).

    Args:
        n_ray_samples: n, equally spaced between where a ray enters and leaves the sphere, both ends included.
        doublings: iterations of an optimisation at which n doubles, up to `n_ray_samples` after the last.
        refinement: "secant" as in the paper, or "bisection".
        refinement_steps: field evaluations per hit after the search.
        early_stop: evaluate the samples of a ray from front to back up to the first occupied one; else all samples, as
            in the paper.
        least_slope: see `gradients.attach_implicit_gradient`.
        occupancy_width, mask_weight, occupied_at: of both mask losses; see `silhouette.Occupancy`.
        sphere_radius: of the volume of interest, a sphere about the origin.
    """

    n_ray_samples: int
    doublings: tuple[int, ...]
    refinement: str
    refinement_steps: int
    early_stop: bool
    least_slope: float
    occupancy_width: float
    mask_weight: float
    occupied_at: str
    sphere_radius: float

    capabilities: ClassVar[Capabilities] = LEVEL_SET_CAPABILITIES

    def __post_init__(self) -> None:
        check_at_least("n_ray_samples", self.n_ray_samples, 2, "the paper uses 16 to 128")
        check_choice("refinement", self.refinement, REFINEMENTS)
        check_at_least("refinement_steps", self.refinement_steps, 0, "the official code uses 8")
        check_positive("least_slope", self.least_slope, "1e-3 leaves all but the most grazing rays as they are")
        check_positive("occupancy_width", self.occupancy_width, "0.02 suits distances in the unit sphere")
        check_at_least("mask_weight", self.mask_weight, 0, "1 keeps the paper's equations")
        check_choice("occupied_at", self.occupied_at, OCCUPANCY_POINTS)
        check_positive("sphere_radius", self.sphere_radius, "shapes lie in the unit sphere, radius 1")
        if list(self.doublings) != sorted(set(self.doublings)) or min(self.doublings, default=0) < 0:
            raise ValueError(f"doublings must be rising iterations from 0, not {list(self.doublings)}: [10, 30, 50]")

    def at_iteration(self, iteration: int) -> "DVR":
        """The renderer of an iteration: n is halved for each future doubling (Sec. 3.5)."""
        future_doublings = sum(schedule_position(iteration) < doubling for doubling in self.doublings)
        return replace(self, n_ray_samples=max(self.n_ray_samples // 2**future_doublings, 2))

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Searches without a graph, then attaches the implicit gradient to the hits."""
        flat = rays.flat()
        entry, leave, intersects = (tensor.detach() for tensor in sphere_span(flat, self.sphere_radius))
        queried = intersects.nonzero().squeeze(-1)
        batches = queried.split(max(SAMPLES_PER_BATCH // self.n_ray_samples, 1))
        with torch.no_grad():
            searches = [self._search(field, flat[batch], entry[batch], leave[batch]) for batch in batches]
        status, end, least_distance, least = (torch.cat(tensors) for tensors in zip(*searches, strict=True))
        hit = queried[status == Status.HIT]
        distance = entry.index_put((queried,), end)
        hit_distance = attach_implicit_gradient(field, flat[hit], distance[hit], least_slope=self.least_slope)
        return assemble(
            rays,
            self.sphere_radius,
            distance=distance.index_put((hit,), hit_distance),
            status=torch.full_like(intersects, Status.MISS, dtype=torch.int8).index_put((queried,), status),
            residual=torch.zeros_like(entry).index_put((queried,), least),
            closest=(queried, reevaluate_with_graph(field, flat[queried], least_distance, least)),
        )

    def silhouette_loss(
        self, field: Field, rays: Rays, rendering: Rendering, mask: Bool[Tensor, "*rays"]
    ) -> Float[Tensor, ""]:
        """DVR, Eqs. 14 and 15, for a mask without observed distances; see `silhouette.Occupancy`."""
        return self.observed_loss(field, rays, rendering, RayObservation(mask))

    def observed_loss(
        self, field: Field, rays: Rays, rendering: Rendering, observed: RayObservation
    ) -> Float[Tensor, ""]:
        """DVR, Eqs. 14 and 15; see `silhouette.Occupancy`."""
        occupancy = Occupancy(self.occupancy_width, self.mask_weight, self.sphere_radius, self.occupied_at)
        return occupancy(self, field, rays, rendering, observed)

    def _search(self, field: Field, rays: Rays, entry: Tensor, leave: Tensor) -> tuple[Tensor, ...]:
        """The status and distance of rays that meet the sphere; distance and value of their sample nearest to 0."""
        distance = equally_spaced(entry, leave, self.n_ray_samples)
        value = self._in_order(field, rays, distance) if self.early_stop else field(rays.at_each(distance))
        inside = value[:, 0] < 0
        crosses, bracket = first_crossing(distance, value)
        hit = (crosses & ~inside).nonzero().squeeze(-1)
        bracket, steps = bracket.select(hit), self.refinement_steps
        root, remaining = refine(field, rays[hit], bracket, method=self.refinement, steps=steps)

        status = torch.where(inside, Status.STARTED_INSIDE, Status.MISS).to(torch.int8)
        status[hit] = Status.HIT
        end = torch.where(inside, entry, leave)
        magnitude = torch.where(value.isfinite(), value.abs(), torch.inf)
        magnitude[:, 1:].masked_fill_(inside[:, None], torch.inf)  # such a ray ended at its first sample
        index = magnitude.argmin(dim=1, keepdim=True)
        least_distance, least = distance.gather(1, index).squeeze(1), value.gather(1, index).squeeze(1)
        end[hit], least_distance[hit], least[hit] = root, root, remaining
        return status, end, least_distance, least

    def _in_order(self, field: Field, rays: Rays, distance: Tensor) -> Tensor:
        """The values of the samples up to the first occupied one; NaN behind it."""
        values = torch.full_like(distance, torch.nan)
        searching = torch.arange(len(distance), device=distance.device)
        for sample in range(self.n_ray_samples):
            value = field(rays[searching].at(distance[searching, sample]))
            values[searching, sample] = value
            searching = searching[~(value < 0 if sample == 0 else value <= 0)]
        return values
