"""Sphere tracing with a band about the silhouette that carries its gradient (Wang et al., SIGGRAPH Asia 2024)."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from renderers.camera import Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Field
from renderers.gradients import fixed_samples, implicit_front
from renderers.march import Front, Stepping, march
from renderers.rendering import Rendering, Status, Volume, check_kind
from renderers.silhouette import SurfaceRenderer

# Of the band: a lower sample is looked at closely; of a distance it is at most 1.16 times the least value.
CANDIDATE = 1.5
FARTHEST = 1e3  # a value that is larger, or infinite, counts as this one
TOGETHER = 8  # steps whose samples are looked at in one go


@dataclass(frozen=True)
class RelaxedBoundary(SurfaceRenderer):
    """Sphere tracing that gives rays close by a surface the gradient of coming into its view.

    On a ray that passes a surface, by a least field value within the band above `epsilon`, that surface has the weight
    0, whose derivative is minus that of the value over the width; what the ray sees behind has the rest. The mean over
    a pixel's rays then has the derivative of the pixel's content: the boundary's integral, spread over the band.

    Source: "A Simple Approach to Differentiable Rendering of SDFs" (Wang et al. 2024, arXiv 2405.08733), Secs. 4, 5.
    Differentiable in: field parameters and rays: hits by the implicit rule, exactly, up to `epsilon`; what comes into
        view or leaves it by the band, with a bias that falls with its width and a variance that grows as it does.
    Needs: a distance or a bound inside the sphere; the band is as wide as the field says.
    Deviates from the paper: the least value is that at the vertex of the parabola through three marched samples, and of
        several surfaces within the band the first one counts; the band begins at `epsilon`, where hits end; the mask
        loss is IDR's, since a mask of one ray per pixel says nothing to rays inside of the outline.

    Args:
        steps: most marching steps per ray.
        epsilon: a ray has converged where the field's magnitude is below this, in scene units.
        band: width of the band, in field units.
        least_slope, mask_sharpness, mask_weight, sphere_radius: see `silhouette.SurfaceRenderer`.
    """

    steps: int
    epsilon: float
    band: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least("steps", self.steps, 1, "400 converges, also next to an outline")
        check_positive("epsilon", self.epsilon, "5e-5 is a four-hundredth of a pixel at 64 x 64")
        check_positive("band", self.band, "0.01 is a third of a pixel at 64 x 64")

    @property
    def blur(self) -> float:
        """The band's width, in scene units where the field is a distance."""
        return self.band

    def with_blur(self, blur: float) -> "RelaxedBoundary":
        return replace(self, band=blur)

    def render(self, field: Field, rays: Rays) -> Rendering:
        """Marches without a graph, then attaches the gradients of hits and of what rays pass by."""
        check_kind(self, field)
        flat = rays.flat()
        with torch.no_grad():
            front, passed, least = self._march(field, flat)
        rendering = implicit_front(field, rays, front, least_slope=self.least_slope, radius=self.sphere_radius)
        distance, hit = rendering.distance.view(-1), (front.status == Status.HIT).nonzero().squeeze(-1)
        near = least.isfinite().nonzero().squeeze(-1)
        here = fixed_samples(field, flat[near], passed[near], least[near])
        coming = (here.detach() - here) / self.band
        behind = torch.ones_like(distance).index_put((near,), 1 - coming)[hit]
        volume = Volume(torch.cat([near, hit]), torch.cat([passed[near], distance[hit]]), torch.cat([coming, behind]))
        return replace(rendering, volume=volume)

    def _march(self, field: Field, rays: Rays) -> tuple[Front, Float[Tensor, " n"], Float[Tensor, " n"]]:
        """The front; where each ray first passed a surface within the band, and the value there: infinite without."""
        front = Front.on_sphere(rays, radius=self.sphere_radius, samples=1)
        seen = Seen(self, field, rays, front.distance)
        march(field, rays, front, Stepping(self.epsilon), self.steps, note=seen.note)
        seen.look()
        return front, seen.passed, seen.least


class Seen:
    """What n rays pass by: `passed`, where that is, and `least`, the value there, infinite where there is nothing yet.

    Samples are kept as they come, and looked at `TOGETHER`.
    """

    def __init__(self, renderer: RelaxedBoundary, field: Field, rays: Rays, begun: Float[Tensor, " n"]) -> None:
        self.renderer, self.field, self.rays, self.kept = renderer, field, rays, 2
        self.passed, self.least = begun.clone(), torch.full_like(begun, torch.inf)
        self.samples = begun.new_full((2 + TOGETHER, 2, len(begun)), torch.nan)  # places and values; first the last two

    def note(self, asked: Int[Tensor, " m"], distance: Float[Tensor, " m"], value: Float[Tensor, " m"]) -> None:
        """Keeps a sample of some of the rays."""
        self.samples[self.kept].index_copy_(1, asked, torch.stack([distance, value]))
        self.kept += 1
        if self.kept == len(self.samples):
            self.look()

    def look(self) -> None:
        """Asks the field where rays have passed a least value since the last look; the first within the band counts."""
        band, epsilon, values = self.renderer.band, self.renderer.epsilon, self.samples[:, 1]
        before, here, after = values[:-2], values[1:-1], values[2:]
        dips = (here < before) & (here < after) & (here > 0) & (here < CANDIDATE * band) & self.least.isinf()
        step, ray = dips.nonzero(as_tuple=True)
        if len(ray):
            three = torch.stack([self.samples[step + later, :, ray] for later in range(3)])
            place = _lowest(three[..., 0], three[..., 1].clamp_max(FARTHEST))
            there = self.field(self.rays[ray].at(place))
            order = torch.where((there > epsilon) & (there < band + epsilon), step, TOGETHER)
            first = torch.full_like(self.least, TOGETHER, dtype=step.dtype).scatter_reduce(0, ray, order, "amin")
            chosen = (order == first[ray]) & (order < TOGETHER)  # one of each ray
            found = [torch.where(chosen, one, torch.inf) for one in (place, there)]
            place, there = (torch.full_like(self.least, torch.inf).scatter_reduce(0, ray, f, "amin") for f in found)
            self.passed = torch.where(there < torch.inf, place, self.passed)
            self.least = torch.minimum(self.least, there)
        self.samples[:2] = self.samples[-2:]
        self.samples[2:] = torch.nan
        self.kept = 2


def _lowest(places: Float[Tensor, "3 n"], values: Float[Tensor, "3 n"]) -> Float[Tensor, " n"]:
    """Where the parabola through three values, of which the middle one is the least, is lowest."""
    fall, rise = places[1] - places[0], places[2] - places[1]
    down, up = (values[0] - values[1]) / fall, (values[2] - values[1]) / rise
    return places[1] + (down * rise - up * fall) / (2 * (down + up))
