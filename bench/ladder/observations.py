"""What a field is fitted to, what is held out, and what a fit may begin with."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.ladder.held_out import HeldOut
from bench.tasks.completion import GivenView
from renderers.camera import Rays, sphere_span
from renderers.rendering import Renderer

FREE = 4  # points known to be free, on each ray that has some


@dataclass(frozen=True)
class Observations:
    """Rays of one or more views, in a row, of which some are held out.

    Args:
        given: all rays that are not held out.
        held_out: the others.
        footprint: half a pixel, in scene units (DIST, Eq. 10).
    """

    given: GivenView
    held_out: HeldOut
    footprint: float

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """Of the surface, at the pixels whose depth is given."""
        observed = self.given.observed
        distance = self.given.depth[observed] / self.given.depth_of_distance[observed]
        return self.given.rays[observed].at(distance)

    def through(self, renderer: Renderer) -> "Observations":
        """The same, compared through another renderer."""
        return replace(self, given=replace(self.given, renderer=renderer))

    def through_sphere(self) -> Int[Tensor, " n"]:
        """The given rays that meet the unit sphere: the others say nothing of a shape in it."""
        _, _, meets = sphere_span(self.given.rays)
        return meets.nonzero().squeeze(-1)

    def free(self, seed: int) -> Float[Tensor, "n 3"]:
        """Points that are known to lie outside: in front of what was seen, and where nothing was."""
        given = self.given
        entry, leave, meets = sphere_span(given.rays)
        seen_to = torch.where(given.observed, given.depth / given.depth_of_distance, leave)
        empty = given.observed if given.mask is None else given.observed | ~given.mask
        chosen = (meets & empty).nonzero().squeeze(-1)
        generator = torch.Generator().manual_seed(seed)
        share = torch.rand(FREE, len(chosen), generator=generator).to(entry.device)
        distance = entry[chosen] + share * (seen_to[chosen] - entry[chosen])
        return given.rays[chosen].at(distance).reshape(-1, 3)


def hold_out(
    view: GivenView,
    group: Int[Tensor, " n"],
    *,
    share: float,
    whole: Bool[Tensor, " groups"],
    footprint: float,
    seed: int,
) -> Observations:
    """Holds out whole groups, and a share of the rays of the others.

    Args:
        view: of rays in a row.
        group: which view, or part of one, a ray belongs to, from 0.
        share: of the rays of other groups, and of those with a known depth, from 0 to 1.
        whole: groups of which nothing is given.
        footprint: half a pixel, in scene units.
        seed: of the draw.
    """
    generator = torch.Generator().manual_seed(seed)
    out = whole[group]
    for kind in (view.observed.cpu(), ~view.observed.cpu()):
        places = kind.nonzero().squeeze(-1)
        count = round(share * len(places))
        out[places[torch.randperm(len(places), generator=generator)[:count]]] = True
    out = out.to(view.observed.device)
    return Observations(view.some((~out).nonzero().squeeze(-1)), _held(view, out, group, footprint), footprint)


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


def _held(view: GivenView, out: Bool[Tensor, " n"], group: Int[Tensor, " n"], footprint: float) -> HeldOut:
    """Of the rays that are held out, those of which something is known."""
    known = (out & view.observed if view.mask is None else out).nonzero().squeeze(-1)
    part = view.some(known)
    mask = part.observed if part.mask is None else part.mask
    own = group.to(known.device)[known].unique(return_inverse=True)[1]
    return HeldOut(part.rays, part.depth / part.depth_of_distance, part.observed, mask, own, footprint)


@dataclass(frozen=True)
class Drawn:
    """A view's loss over rays that are drawn anew in each iteration.

    Args:
        view: of rays in a row.
        among: rays that may be drawn.
        count: how many, at most.
        seed: of the draws: the same for every rung.
    """

    view: GivenView
    among: Int[Tensor, " n"]
    count: int
    seed: int

    def rays(self, iteration: int, count: int) -> GivenView:
        """What is given of so many rays of an iteration."""
        drawn = torch.randint(len(self.among), (count,), generator=generator(self.seed, iteration))
        return self.view.some(self.among[drawn.to(self.among.device)])


def generator(seed: int, iteration: int) -> torch.Generator:
    """The draws of an iteration: the same ones for every rung."""
    return torch.Generator().manual_seed(seed * 1_000_003 + iteration)
