"""What a field is fitted to, what is held out, and what a fit may begin with."""

from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, nan
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.ladder.held_out import HeldOut, HeldOutError
from bench.tasks.code import Terms
from bench.tasks.given import GivenView
from bench.thickness import finest
from renderers.camera import Rays, sphere_span
from renderers.field import Field
from renderers.rendering import Renderer

FREE = 4  # points known to be free, on each ray that has some


@runtime_checkable
class Observations(Protocol):
    """What a field is fitted to through a renderer, and what is held out of it."""

    @property
    def renderer(self) -> Renderer: ...

    @property
    def footprint(self) -> float:
        """Half a pixel, in scene units (DIST, Eq. 10): an error below it is none. 0 where errors have another unit."""
        ...

    @property
    def rays(self) -> int:
        """That are rendered in an iteration."""
        ...

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """Of the surface, where they are known."""
        ...

    @property
    def free(self) -> Float[Tensor, "n 3"]:
        """Points that are known to lie outside."""
        ...

    def through(self, renderer: Renderer) -> "Observations":
        """The same, compared through another renderer."""
        ...

    def terms(self, field: Field, iteration: int, share: float) -> Terms:
        """The weighted loss of an iteration, at some share of its rays."""
        ...

    def left(self, terms: Terms) -> float:
        """The error that an iteration's terms show, in scene units; NaN where they have another unit."""
        ...

    def error(self, field: Field) -> HeldOutError:
        """Of what was held out."""
        ...


@dataclass(frozen=True)
class RayObservations:
    """Rays of one or more views, in a row, of which some are held out, and some of the others drawn for an iteration.

    Args:
        given: all rays that are not held out.
        held_out: the others.
        rays: drawn in an iteration.
        seed: of the draws, which are the same for every rung.
    """

    given: GivenView
    held_out: HeldOut
    rays: int
    seed: int

    @property
    def renderer(self) -> Renderer:
        """Through which they are compared."""
        return self.given.renderer

    @property
    def footprint(self) -> float:
        """Half a pixel, in scene units (DIST, Eq. 10)."""
        return self.held_out.footprint

    @cached_property
    def points(self) -> Float[Tensor, "n 3"]:
        """Of the surface, at the pixels whose depth is given."""
        observed = self.given.observed
        distance = self.given.depth[observed] / self.given.depth_of_distance[observed]
        return self.given.rays[observed].at(distance)

    @cached_property
    def through_sphere(self) -> Int[Tensor, " n"]:
        """The given rays that meet the unit sphere: the others say nothing of a shape in it."""
        _, _, meets = sphere_span(self.given.rays)
        return meets.nonzero().squeeze(-1)

    def through(self, renderer: Renderer) -> "RayObservations":
        """The same, compared through another renderer."""
        return replace(self, given=replace(self.given, renderer=renderer))

    def terms(self, field: Field, iteration: int, share: float) -> Terms:
        """The weighted loss of the rays that are drawn for an iteration."""
        count = max(round(share * self.rays), 1)
        drawn = torch.randint(len(self.through_sphere), (count,), generator=generator(self.seed, iteration))
        some = self.given.some(self.through_sphere[drawn.to(self.through_sphere.device)])
        with torch.random.fork_rng():  # a renderer's own draws are the same for every rung, too
            torch.manual_seed(generator(self.seed, iteration).initial_seed())
            return some.compare(field, iteration)

    def error(self, field: Field) -> HeldOutError:
        """Of the rays that are held out."""
        return self.held_out.error(field, finest(self.renderer))

    def left(self, terms: Terms) -> float:
        """That of the depth alone: what a silhouette costs is a length for some renderers only."""
        weight = self.given.settings.depth_weight
        return (float(terms["depth"].detach()) / weight or inf) if weight else nan  # 0: nothing was hit

    @cached_property
    def free(self) -> Float[Tensor, "n 3"]:
        """Points that are known to lie outside: in front of what was seen, and where nothing was."""
        given = self.given
        entry, leave, meets = sphere_span(given.rays)
        seen_to = torch.where(given.observed, given.depth / given.depth_of_distance, leave)
        empty = given.observed if given.mask is None else given.observed | ~given.mask
        chosen = (meets & empty).nonzero().squeeze(-1)
        draw = torch.Generator().manual_seed(self.seed)
        share = torch.rand(FREE, len(chosen), generator=draw).to(entry.device)
        distance = entry[chosen] + share * (seen_to[chosen] - entry[chosen])
        return given.rays[chosen].at(distance).reshape(-1, 3)


@dataclass(frozen=True)
class Holdout:
    """What is held out.

    Args:
        share: of the rays, and of those with a known depth, from 0 to 1.
        whole: groups of which nothing is given.
        footprint: half a pixel, in scene units.
        seed: of the draw.
    """

    share: float
    whole: tuple[int, ...]
    footprint: float
    seed: int


def hold_out(view: GivenView, group: Int[Tensor, " n"], split: Holdout, *, rays: int) -> RayObservations:
    """Holds out whole groups, and a share of the rays of the others.

    Args:
        view: of rays in a row.
        group: which view, or part of one, a ray belongs to, from 0.
        split: what is held out.
        rays: to be drawn in an iteration.

    Raises:
        ValueError: where too little is given to hold some out.
    """
    draw = torch.Generator().manual_seed(split.seed)
    out = torch.isin(group, torch.tensor(split.whole))
    for kind in (view.observed.cpu(), ~view.observed.cpu()):
        places = (kind & ~out).nonzero().squeeze(-1)
        count = round(split.share * len(places))
        out[places[torch.randperm(len(places), generator=draw)[:count]]] = True
    out = out.to(view.observed.device)
    given = view.some((~out).nonzero().squeeze(-1))
    held_out = held(view, out, group, split.footprint)
    if len(held_out.group[held_out.observed].unique()) < 2:
        raise ValueError(
            f"a field without a prior is judged by depths that it was not fitted to, and {int(view.observed.sum())} "
            "leave too few of them: give more depth (task.points=100), or set field=prior"
        )
    return RayObservations(given, held_out, rays, split.seed)


def together(views: list[GivenView]) -> GivenView:
    """Several views as one row of rays."""
    parts = {
        name: torch.cat([getattr(view, name).flatten() for view in views])
        for name in ("depth", "depth_of_distance", "observed")
    }
    flat = [view.rays.flat() for view in views]
    rays = Rays(torch.cat([rays.origins for rays in flat]), torch.cat([rays.directions for rays in flat]))
    masks = [view.mask.flatten() for view in views if view.mask is not None]
    return replace(views[0], rays=rays, **parts, mask=torch.cat(masks) if masks else None)


def held(view: GivenView, out: Bool[Tensor, " n"], group: Int[Tensor, " n"], footprint: float) -> HeldOut:
    """Of the rays that are held out, those of which something is known."""
    known = (out & view.observed if view.mask is None else out).nonzero().squeeze(-1)
    part = view.some(known)
    mask = part.observed if part.mask is None else part.mask
    own = group.to(known.device)[known].unique(return_inverse=True)[1]
    return HeldOut(part.rays, part.depth / part.depth_of_distance, part.observed, mask, own, footprint)


def generator(seed: int, iteration: int) -> torch.Generator:
    """The draws of an iteration: the same ones for every rung."""
    return torch.Generator().manual_seed(seed * 1_000_003 + iteration)
