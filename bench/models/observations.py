"""The observations that a field is fitted to, and those that are held out."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import asin, degrees, inf, nan, radians, sin, sqrt

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.models.held_out import HeldOut, HeldOutError
from bench.setup.auto import footprint
from bench.setup.fields import ViewSettings
from bench.solve.latent_code import Terms
from bench.solve.observed_view import ObservedView, ViewLossSettings
from datasets.scene import Truth, see
from datasets.views import ViewSampler
from renderers.camera import Camera, Rays, sphere_span
from renderers.checks import BadInput
from renderers.field import Field
from renderers.rendering import Renderer

GOLDEN = 180 * (3 - sqrt(5))  # degrees: the golden angle, from one camera of a Fibonacci lattice to the next
TILES = 4  # of a view along each side
FREE = 4  # points known to lie outside, on each ray that has some


@dataclass(frozen=True)
class RayObservations:
    """Rays of one or more views in one row: some are held out, and an iteration draws from the others.

    Args:
        rays: number drawn in an iteration.
        seed: of the draws, which are the same for every candidate.
    """

    given: ObservedView
    held_out: HeldOut
    rays: int
    seed: int

    @property
    def renderer(self) -> Renderer:
        """The renderer that compares a field with the given rays."""
        return self.given.renderer

    @property
    def footprint(self) -> float:
        """Half a pixel, in scene units (DIST, Eq. 10)."""
        return self.held_out.footprint

    @cached_property
    def points(self) -> Float[Tensor, "n 3"]:
        """Points of the surface at the pixels whose depth is given."""
        observed = self.given.observed
        distance = self.given.depth[observed] / self.given.depth_per_distance[observed]
        return self.given.rays[observed].at(distance)

    @cached_property
    def through_sphere(self) -> Int[Tensor, " n"]:
        """Indices of the given rays that meet the unit sphere; the others carry no information."""
        _, _, meets = sphere_span(self.given.rays)
        return meets.nonzero().squeeze(-1)

    def through(self, renderer: Renderer) -> "RayObservations":
        """The same, compared through another renderer."""
        return replace(self, given=replace(self.given, renderer=renderer))

    def terms(self, field: Field, iteration: int, share: float) -> Terms:
        """The weighted terms of the loss, over the rays that are drawn for an iteration."""
        count = max(round(share * self.rays), 1)
        drawn = torch.randint(len(self.through_sphere), (count,), generator=generator(self.seed, iteration))
        some = self.given.some(self.through_sphere[drawn.to(self.through_sphere.device)])
        with torch.random.fork_rng():  # a renderer's draws are the same for every candidate as well
            torch.manual_seed(generator(self.seed, iteration).initial_seed())
            return some.compare(field, iteration)

    def error(self, field: Field) -> HeldOutError:
        """The error of a field on the held-out rays."""
        return self.held_out.error(field, self.renderer)

    def depth_error(self, terms: Terms) -> float:
        """The mean depth error; a silhouette loss is a length for some renderers only, so it is left out."""
        weight = self.given.settings.depth_weight
        return (float(terms["depth"].detach()) / weight or inf) if weight else nan  # 0: nothing was hit

    @cached_property
    def free(self) -> Float[Tensor, "n 3"]:
        """Points that are known to lie outside: in front of observed depths, and on background rays."""
        given = self.given
        entry, leave, meets = sphere_span(given.rays)
        seen_to = torch.where(given.observed, given.depth / given.depth_per_distance, leave)
        empty = given.observed if given.mask is None else given.observed | ~given.mask
        chosen = (meets & empty).nonzero().squeeze(-1)
        draw = torch.Generator().manual_seed(self.seed)
        share = torch.rand(FREE, len(chosen), generator=draw).to(entry.device)
        distance = entry[chosen] + share * (seen_to[chosen] - entry[chosen])
        return given.rays[chosen].at(distance).reshape(-1, 3)


def hold_out(
    view: ObservedView, group: Int[Tensor, " n"], *, share: float, whole: tuple[int, ...], footprint: float, seed: int
) -> RayObservations:
    """Holds out whole groups, and a share of the rays of the others; an iteration draws as many rays as there are.

    Args:
        view: of rays in one row.
        group: which view, or part of one, a ray belongs to, from 0.
        share: of the rays with a known depth and of the others, from 0 to 1.
        footprint: half a pixel, in scene units.

    Raises:
        BadInput: where too few depths are given to hold some out.
    """
    draw = torch.Generator().manual_seed(seed)
    out = torch.isin(group, torch.tensor(whole))
    for kind in (view.observed.cpu(), ~view.observed.cpu()):
        places = (kind & ~out).nonzero().squeeze(-1)
        count = round(share * len(places))
        out[places[torch.randperm(len(places), generator=draw)[:count]]] = True
    out = out.to(view.observed.device)
    given = view.some((~out).nonzero().squeeze(-1))
    held_out = held(view, out, group, footprint)
    if len(held_out.group[held_out.observed].unique()) < 2:
        raise BadInput(
            f"a field without a prior is evaluated on held-out depths, and {int(view.observed.sum())} depths are too "
            "few to hold some out: give more (task.points=100), or set field=prior"
        )
    return RayObservations(given, held_out, len(group), seed)


@dataclass(frozen=True)
class Views:
    """Makes views of a shape from all around, by cameras at the distance and field of view of `sampler`."""

    truth: Truth
    sampler: ViewSampler
    settings: ViewSettings
    weights: ViewLossSettings
    renderer: Renderer
    device: torch.device

    @property
    def footprint(self) -> float:
        """Half a pixel where the shape may be nearest (DIST, Eq. 10), in scene units."""
        return footprint(self.sampler.focal_length, self.sampler.distance)

    def observations(self, seed: int) -> RayObservations:
        """Evenly spaced views to fit and, between them, held-out views."""
        settings = self.settings
        turn = float(np.random.default_rng([seed, 2]).uniform(0, 360))
        cameras = [*self._spread(settings.fitted, turn), *self._spread(settings.held_out, turn + GOLDEN / 2)]
        whole = tuple(range(settings.fitted, len(cameras)))
        view, group = self._seen(cameras)
        held = hold_out(view, group, share=settings.share, whole=whole, footprint=self.footprint, seed=seed)
        return replace(held, rays=settings.rays)

    def further(self, count: int, seed: int) -> HeldOut:
        """`count` further views at random, which no choice has used."""
        draw, highest = np.random.default_rng([seed, 3]), sin(radians(self.settings.elevation))
        angles = [(draw.uniform(0, 360), degrees(asin(draw.uniform(-highest, highest)))) for _ in range(count)]
        view, group = self._seen([self.sampler.camera(*pair) for pair in angles])
        return held(view, torch.ones_like(view.observed), group, self.footprint)

    def _spread(self, count: int, turn: float) -> list[Camera]:
        """Cameras spaced evenly over the belt of a sphere between the largest elevations (a Fibonacci lattice)."""
        highest = sin(radians(self.settings.elevation))
        heights = [highest * (1 - (2 * place + 1) / count) for place in range(count)]
        return [
            self.sampler.camera((turn + place * GOLDEN) % 360, degrees(asin(height)))
            for place, height in enumerate(heights)
        ]

    def _seen(self, cameras: list[Camera]) -> tuple[ObservedView, Int[Tensor, " n"]]:
        views = [see(self.truth, camera) for camera in cameras]
        given = [
            ObservedView.of(view, self.weights, self.renderer, observed=view.mask, mask=view.mask, device=self.device)
            for view in views
        ]
        pixels = views[0].mask.numel()
        return together(given), torch.arange(len(cameras)).repeat_interleave(pixels)


def together(views: list[ObservedView]) -> ObservedView:
    """Several views joined into one row of rays."""
    parts = {
        name: torch.cat([getattr(view, name).flatten() for view in views])
        for name in ("depth", "depth_per_distance", "observed")
    }
    flat = [view.rays.flat() for view in views]
    rays = Rays(torch.cat([rays.origins for rays in flat]), torch.cat([rays.directions for rays in flat]))
    masks = [view.mask.flatten() for view in views if view.mask is not None]
    normals = [view.normals.flatten(0, -2) for view in views if view.normals is not None]
    parts |= {name: torch.cat(some) if some else None for name, some in (("mask", masks), ("normals", normals))}
    return replace(views[0], rays=rays, **parts)


def held(view: ObservedView, out: Bool[Tensor, " n"], group: Int[Tensor, " n"], footprint: float) -> HeldOut:
    """The held-out rays `out` of a view that have an observation: a depth, or a mask."""
    known = (out & view.observed if view.mask is None else out).nonzero().squeeze(-1)
    part = view.some(known)
    mask = part.observed if part.mask is None else part.mask
    numbered = group.to(known.device)[known].unique(return_inverse=True)[1]
    return HeldOut(part.rays, part.depth / part.depth_per_distance, part.observed, mask, numbered, footprint)


def tiles(height: int, width: int) -> Int[Tensor, " pixels"]:
    """The tile of each pixel of a view, from 0, by rows: what is held out together, or judged as one."""
    rows, columns = torch.arange(height) * TILES // height, torch.arange(width) * TILES // width
    return (rows[:, None] * TILES + columns).flatten()


def generator(seed: int, iteration: int) -> torch.Generator:
    """The random generator of an iteration, the same for every candidate."""
    return torch.Generator().manual_seed(seed * 1_000_003 + iteration)
