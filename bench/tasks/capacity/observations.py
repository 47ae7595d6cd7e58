"""The observations of a fit, and the held-out observations."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import asin, degrees, inf, nan, radians, sin, sqrt

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.setup.auto import footprint
from bench.solve.latent_code import Terms
from bench.solve.observed_view import ObservedView, ViewLossSettings
from bench.solve.pixel_draw import generator_of
from bench.tasks.capacity.held_out import HeldOut, HeldOutError
from bench.tasks.capacity.settings import ViewSettings
from datasets.scene import Truth, see
from datasets.views import ViewSampler
from renderers.camera import Camera, Rays, sphere_span
from renderers.checks import BadInput
from renderers.field import Field
from renderers.rendering import Renderer

GOLDEN_ANGLE_DEGREES = 180 * (3 - sqrt(5))  # between successive cameras of a Fibonacci lattice
TILES_PER_SIDE = 4
FREE_POINTS_PER_RAY = 4  # points known to lie outside, on each ray with free space


@dataclass(frozen=True)
class RayObservations:
    """Rays of one or more views in one row: some are held out, and iterations draw from the others.

    Args:
        rays: number drawn in an iteration.
        seed: of the draws, which are the same for every candidate.
    """

    fitted: ObservedView
    held_out: HeldOut
    rays: int
    seed: int

    @property
    def renderer(self) -> Renderer:
        """The renderer that compares a field with the fitted rays."""
        return self.fitted.renderer

    @property
    def footprint(self) -> float:
        """Half a pixel, in scene units (DIST, Eq. 10)."""
        return self.held_out.footprint

    @cached_property
    def points(self) -> Float[Tensor, "n 3"]:
        """Surface points of the observed depths."""
        observed = self.fitted.observed
        distance = self.fitted.depth[observed] / self.fitted.depth_per_distance[observed]
        return self.fitted.rays[observed].at(distance)

    @cached_property
    def through_sphere(self) -> Int[Tensor, " n"]:
        """Indices of the fitted rays that intersect the unit sphere; other rays carry no information."""
        _, _, intersects = sphere_span(self.fitted.rays)
        return intersects.nonzero().squeeze(-1)

    def with_renderer(self, renderer: Renderer) -> "RayObservations":
        return replace(self, fitted=replace(self.fitted, renderer=renderer))

    def terms(self, field: Field, iteration: int, share: float) -> Terms:
        """The weighted terms of the loss over the rays drawn for an iteration, a fraction `share` of `rays`."""
        count = max(round(share * self.rays), 1)
        chosen = torch.randint(len(self.through_sphere), (count,), generator=generator_of(self.seed, iteration))
        sampled = self.fitted.select(self.through_sphere[chosen.to(self.through_sphere.device)])
        with torch.random.fork_rng():  # a renderer's draws are also the same for every candidate
            torch.manual_seed(generator_of(self.seed, iteration).initial_seed())
            return sampled.compare(field, iteration)

    def error(self, field: Field) -> HeldOutError:
        return self.held_out.error(field, self.renderer)

    def depth_error(self, terms: Terms) -> float:
        """The mean depth error. The silhouette loss is left out, since only some renderers have it as a length."""
        weight = self.fitted.settings.depth_weight
        return (float(terms["depth"].detach()) / weight or inf) if weight else nan  # 0: nothing was hit

    @cached_property
    def free(self) -> Float[Tensor, "n 3"]:
        """Points known to lie outside: in front of observed depths, and on background rays."""
        fitted = self.fitted
        entry, exit, intersects = sphere_span(fitted.rays)
        free_until = torch.where(fitted.observed, fitted.depth / fitted.depth_per_distance, exit)
        empty = fitted.observed if fitted.mask is None else fitted.observed | ~fitted.mask
        chosen = (intersects & empty).nonzero().squeeze(-1)
        draw = torch.Generator().manual_seed(self.seed)
        share = torch.rand(FREE_POINTS_PER_RAY, len(chosen), generator=draw).to(entry.device)
        distance = entry[chosen] + share * (free_until[chosen] - entry[chosen])
        return fitted.rays[chosen].at(distance).reshape(-1, 3)


def hold_out(
    view: ObservedView, group: Int[Tensor, " n"], *, share: float, entire: tuple[int, ...], footprint: float, seed: int
) -> RayObservations:
    """Holds out complete groups, and a fraction of the rays of the others; an iteration draws as many rays as exist.

    Args:
        view: of rays in one row.
        group: index of the view, or of the part of a view, of each ray, from 0.
        share: held-out fraction, from 0 to 1, of the rays with a depth and of those without.
        entire: the groups that are held out entirely.
        footprint: half a pixel, in scene units.

    Raises:
        BadInput: too few depths are observed to hold some out.
    """
    draw = torch.Generator().manual_seed(seed)
    is_held_out = torch.isin(group, torch.tensor(entire))
    for kind in (view.observed.cpu(), ~view.observed.cpu()):
        indices = (kind & ~is_held_out).nonzero().squeeze(-1)
        count = round(share * len(indices))
        is_held_out[indices[torch.randperm(len(indices), generator=draw)[:count]]] = True
    is_held_out = is_held_out.to(view.observed.device)
    fitted = view.select((~is_held_out).nonzero().squeeze(-1))
    validation = held_out_rays(view, is_held_out, group, footprint)
    if len(validation.group[validation.observed].unique()) < 2:
        raise BadInput(
            f"a field without a prior is evaluated on held-out depths, and {int(view.observed.sum())} depths are too "
            "few to hold some out: give more (task.points=100), or set field=prior"
        )
    return RayObservations(fitted, validation, len(group), seed)


@dataclass(frozen=True)
class Views:
    """Makes views of a shape from all around, by cameras at the distance and field of view of `sampler`.

    At most `held_out_rays` random rays of each held-out group are kept, so that an error costs the same at every
    resolution.
    """

    truth: Truth
    sampler: ViewSampler
    settings: ViewSettings
    weights: ViewLossSettings
    renderer: Renderer
    device: torch.device
    held_out_rays: int

    @property
    def footprint(self) -> float:
        """Half a pixel at the nearest point of the unit sphere (DIST, Eq. 10), in scene units."""
        return footprint(self.sampler.focal_length, self.sampler.distance)

    def observations(self, seed: int) -> RayObservations:
        """Evenly spaced views to fit and, between them, held-out views."""
        settings = self.settings
        turn = float(np.random.default_rng([seed, 2]).uniform(0, 360))
        cameras = self._spread(settings.fitted, turn)
        cameras += self._spread(settings.held_out, turn + GOLDEN_ANGLE_DEGREES / 2)
        entire, (view, group) = tuple(range(settings.fitted, len(cameras))), self._observe(cameras)
        held = hold_out(view, group, share=settings.share, entire=entire, footprint=self.footprint, seed=seed)
        return replace(held, held_out=held.held_out.thinned(self.held_out_rays, seed), rays=settings.rays)

    def further(self, count: int, seed: int) -> HeldOut:
        """`count` further random views, not used by any choice."""
        draw, highest = np.random.default_rng([seed, 3]), sin(radians(self.settings.elevation))
        angles = [(draw.uniform(0, 360), degrees(asin(draw.uniform(-highest, highest)))) for _ in range(count)]
        view, group = self._observe([self.sampler.camera(*pair) for pair in angles])
        held_out = held_out_rays(view, torch.ones_like(view.observed), group, self.footprint)
        return held_out.thinned(self.held_out_rays, seed)

    def _spread(self, count: int, turn: float) -> list[Camera]:
        """Cameras spread evenly over the belt of a sphere between the largest elevations (a Fibonacci lattice)."""
        highest = sin(radians(self.settings.elevation))
        heights = [highest * (1 - (2 * index + 1) / count) for index in range(count)]
        angles = [((turn + i * GOLDEN_ANGLE_DEGREES) % 360, degrees(asin(height))) for i, height in enumerate(heights)]
        return [self.sampler.camera(*pair) for pair in angles]

    def _observe(self, cameras: list[Camera]) -> tuple[ObservedView, Int[Tensor, " n"]]:
        views = [see(self.truth, camera) for camera in cameras]
        observed_views = [
            ObservedView.of(view, self.weights, self.renderer, observed=view.mask, mask=view.mask, device=self.device)
            for view in views
        ]
        pixels = views[0].mask.numel()
        return concatenate_views(observed_views), torch.arange(len(cameras)).repeat_interleave(pixels)


def concatenate_views(views: list[ObservedView]) -> ObservedView:
    tensors = {
        name: torch.cat([getattr(view, name).flatten() for view in views])
        for name in ("depth", "depth_per_distance", "observed")
    }
    flat = [view.rays.flat() for view in views]
    rays = Rays(torch.cat([rays.origins for rays in flat]), torch.cat([rays.directions for rays in flat]))
    masks = [view.mask.flatten() for view in views if view.mask is not None]
    normals = [view.normals.flatten(0, -2) for view in views if view.normals is not None]
    tensors |= {name: torch.cat(values) if values else None for name, values in (("mask", masks), ("normals", normals))}
    return replace(views[0], rays=rays, **tensors)


def held_out_rays(view: ObservedView, where: Bool[Tensor, " n"], group: Int[Tensor, " n"], footprint: float) -> HeldOut:
    """The selected rays of a view that have an observation: a depth, or a mask."""
    indices = (where & view.observed if view.mask is None else where).nonzero().squeeze(-1)
    view = view.select(indices)
    mask = view.observed if view.mask is None else view.mask
    groups = group.to(indices.device)[indices].unique(return_inverse=True)[1]
    return HeldOut(view.rays, view.depth / view.depth_per_distance, view.observed, mask, groups, footprint)


def tiles(height: int, width: int) -> Int[Tensor, " pixels"]:
    """The tile of each pixel of a view, from 0, by rows; a tile is a group of pixels."""
    rows, columns = torch.arange(height) * TILES_PER_SIDE // height, torch.arange(width) * TILES_PER_SIDE // width
    return (rows[:, None] * TILES_PER_SIDE + columns).flatten()
