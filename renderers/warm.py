"""A rendering of the same rays as in the last iteration of an optimisation, begun where that one ended.

How far the field's values have moved is measured at the last hits, where they are asked for anyway, and at one place on
each of some rays. A ray on whose path the field was larger than twice that movement is as free as before. A hit is
solved again from its last place, by the Newton step that its gradient needs. All other rays are marched, from where
their path came close to a surface if it is free up to there.

None of this is a proof, since the movement is measured at samples: what appears between them is seen when the ray is
marched again. An audit marches one ray in a hundred from its beginning, whatever is known of it, and another one the
next time. Where the two answers differ too often, all rays are. A miss keeps its closest sample until it is marched
again.
"""

from dataclasses import dataclass, field
from threading import get_ident
from weakref import ref

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Rays
from renderers.field import Field
from renderers.packed_march import CLEAR, FURTHER, Reached
from renderers.rendering import Rendering
from renderers.tracer import Solved, Tracer, evened

SAFETY = 2.0  # times the movement at the hits: elsewhere the field may have moved further
STEEP = -0.1  # slope of the field along a ray: a hit on a flatter one is marched again, since it may leave at a touch
USUAL = 0.9  # quantile of the movement of hits that were marched: it foretells how far values move the next time
MARCHED = 0.5  # share of the rays that may be marched one by one: beyond it, coarse to fine is cheaper
LOOKED = 29  # on one of so many rays the field's movement is measured; no part of a usual image's width
GOLDEN = 0.618034  # of the way along a ray from one of these places to the next: they spread over all of it
AUDITED, SHIFT = 100, 37  # of so many rays one is audited in a rendering; by how many it is another the next time
SHARE = 0.025  # of the audited rays that may differ: a rendering in which more do, and more than one, is begun anew
WRONG, ENOUGH = 0.02, 200  # the same of all renderings together, from so many audited rays on
APART = 0.01  # scene units: crossings further apart differ
MEASURED = 4  # of so many renderings one measures how steep the field is
STEEPER = 0.05  # by what share that may have changed: where it has by more, all rays are begun anew; and slopes at hits


@dataclass
class Image:
    """What is known of n rays in one row, all of it without a graph.

    Args:
        reached: where the march left them.
        hit, distance, slope: whether they met a surface, where, and the slope of the field along the ray there.
        moved: how far values have moved since the first rendering, in field units.
        step: how far of that in the last rendering.
        marched: what `moved` was when the ray was last marched from its beginning.
        looked: the field's last values at the places of `_look`.
        steepness: of the field; its values here are divided by it.
        renderings: their number so far.
    """

    reached: Reached
    hit: Bool[Tensor, " n"]
    distance: Float[Tensor, " n"]
    slope: Float[Tensor, " n"]
    moved: Float[Tensor, ""]
    step: Float[Tensor, ""]
    marched: Float[Tensor, " n"]
    looked: Float[Tensor, " m"]
    steepness: float
    renderings: int = 0

    @staticmethod
    def of(reached: Reached, step: Float[Tensor, ""], looked: Float[Tensor, " m"], steepness: float) -> "Image":
        """Rays that were just marched."""
        zeros = torch.zeros_like(reached.distance)
        return Image(reached, zeros.bool(), zeros, zeros, zeros.new_zeros(()), step, zeros.clone(), looked, steepness)

    def note(self, solved: Solved) -> None:
        """Notes where the rays meet a surface now."""
        index, settled = solved.index, solved.settled
        self.hit = torch.zeros_like(self.hit).index_put((index,), settled)
        distance = torch.where(settled, solved.distance.detach(), self.distance[index])
        self.distance = self.distance.index_put((index,), distance)
        self.slope = self.slope.index_put((index,), torch.where(settled, solved.slope, self.slope[index]))
        self.renderings += 1

    def free(self, moved: Float[Tensor, ""]) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"]]:
        """Which rays are as free as they were, after values have moved so far: as a whole, and up to their anchor.

        On a step that is at most `FURTHER` longer than the value, the field is at least half the smaller of the values
        at its ends, less half of `FURTHER`. A hit is not compared with what it passed on its last descent, which its
        Newton step sees.
        """
        margin = 2 * (moved - self.marched) + FURTHER
        passed, up_to_anchor = self.reached.passed, margin < CLEAR
        passed = torch.where(self.hit, passed, torch.minimum(passed, self.reached.least))
        return (margin < passed) & (up_to_anchor | ~self.hit), up_to_anchor


@dataclass
class Memory:
    """What an optimisation remembers: its images of rays, as long as these exist, and what the audit found.

    It serves one optimisation in one thread: in another thread nothing is remembered.
    """

    images: dict[int, tuple[ref[Tensor], ref[Tensor], Image]] = field(default_factory=dict)
    audited: int = 0
    differed: int = 0
    thread: int = field(default_factory=get_ident)

    def forget(self) -> None:
        """Begins another optimisation."""
        self.images, self.audited, self.differed, self.thread = {}, 0, 0, get_ident()

    @property
    def unsound(self) -> bool:
        """Whether the audit found so much that nothing is taken from memory any more."""
        return self.audited >= ENOUGH and self.differed > WRONG * self.audited

    def of(self, rays: Rays) -> Image | None:
        """What is known of these very rays."""
        kept = self.images.get(id(rays.origins))
        same = kept and kept[0]() is rays.origins and kept[1]() is rays.directions
        return kept[2] if kept and same else None

    def keep(self, rays: Rays, image: Image) -> None:
        """Remembers an image until its rays are gone."""
        images, key = self.images, id(rays.origins)
        images[key] = ref(rays.origins, lambda _: images.pop(key, None)), ref(rays.directions), image

    def audit(self, rays: int, differing: int) -> bool:
        """Notes how many audited rays have another answer; whether these are too many for one rendering."""
        self.audited += rays
        self.differed += differing
        return differing > max(1, SHARE * rays)

    def notes(self) -> list[str]:
        """What the audit found, for the record; nothing where there was none."""
        if not self.audited:
            return []
        found = f"renderer.warm: {self.differed} of {self.audited} audited rays had another answer when marched anew"
        return [f"{found}: too many, so nothing was taken from memory any more" if self.unsound else found]


def warm_trace(tracer: Tracer, memory: Memory, field: Field, rays: Rays) -> Rendering:
    """The rendering, from what the memory knows of the rays; and from now on it knows more.

    Rays with a gradient of their own move from one iteration to the next, and are not remembered. Others are known by
    their tensors, which must not be changed in place.
    """
    if rays.origins.requires_grad or rays.directions.requires_grad or memory.thread != get_ident():
        return tracer.render_anew(field, rays)
    image, solved = memory.of(rays), None
    if image is not None and not memory.unsound and _worthwhile(image):
        solved = _continued(tracer, memory, field, rays.flat(), image)
    if image is None or solved is None:
        image, solved = _begun(tracer, field, rays, image)
        memory.keep(rays, image)
    else:
        image.note(solved)
    return tracer.assembled(rays, image.reached, solved, steepness=image.steepness)


def _as_steep(tracer: Tracer, field: Field, rays: Rays, image: Image) -> bool:
    """Whether the field is as steep as where these rays were begun."""
    return abs(tracer.steepness(field, rays) / image.steepness - 1) <= STEEPER


def _begun(tracer: Tracer, field: Field, rays: Rays, before: Image | None) -> tuple[Image, Solved]:
    """All rays marched coarse to fine; what was known of them tells how far values have moved."""
    steepness = tracer.steepness(field, rays)
    field = evened(field, steepness)
    reached, solved = tracer.trace(field, rays)
    step = reached.distance.new_zeros(())
    if before is not None:
        again = solved.some(solved.settled & before.hit[solved.index])
        apart = ((again.distance.detach() - before.distance[again.index]) * again.slope).abs()
        step = SAFETY * apart.quantile(USUAL) if len(apart) else step
    with torch.no_grad():
        image = Image.of(reached, step, _look(field, rays.flat(), reached), steepness)
    image.note(solved)
    return image, solved


def _worthwhile(image: Image) -> bool:
    """Whether enough rays will be free, if values move as far as the last time."""
    free, _ = image.free(image.moved + image.step)
    return bool((~free).sum() <= MARCHED * len(free))


def _continued(tracer: Tracer, memory: Memory, field: Field, rays: Rays, image: Image) -> Solved | None:
    """The crossings of flat rays; None where the field is steeper now, or so many must be marched that it does not pay.

    How steep the field is, is measured now and then, and where the slopes at hits have changed.
    """
    reached, asked = image.reached, evened(field, image.steepness)
    steady = (image.hit & (image.slope < STEEP)).nonzero().squeeze(-1)
    solved = tracer.solve(asked, rays, reached, steady, image.distance[steady], furthest=CLEAR)
    with torch.no_grad():
        change = torch.where(solved.settled, solved.slope / image.slope[steady], torch.nan).nanmedian()
        changed = not bool((change - 1).abs() <= STEEPER)  # not a number where no root is settled
        if (changed or image.renderings % MEASURED == 0) and not _as_steep(tracer, field, rays, image):
            return None
        looked = _look(asked, rays, reached)
        image.step = SAFETY * torch.maximum(_largest(solved.begun), _largest(looked - image.looked))
        image.moved, image.looked = image.moved + image.step, looked
        free, up_to_anchor = image.free(image.moved)
        certain = free & ~image.hit.index_put((steady,), ~solved.settled)
        audited = torch.zeros_like(free)
        audited[SHIFT * image.renderings % AUDITED :: AUDITED] = True
        index = (~certain | audited).nonzero().squeeze(-1)
        if len(index) > MARCHED * len(free):
            return None
        anchored = up_to_anchor & ~audited
        moving = reached.some(index).begun_again(rays[index], anchored[index], radius=tracer.sphere_radius)
    found = tracer.resume(asked, rays[index], moving).among(index)
    with torch.no_grad():
        judged = certain & audited
        if memory.audit(*torch.stack([judged.sum(), (judged & _differing(solved, found, judged)).sum()]).tolist()):
            return None
        reached.put_back(index, moving)
        image.marched[index] = torch.where(anchored[index], image.marched[index], image.moved)
    return solved.some((certain & ~audited)[solved.index]).joined(found)


def _look(field: Field, rays: Rays, reached: Reached) -> Float[Tensor, " m"]:
    """The field's values at one place on each of a share of the rays, the same places in each rendering; 0 for NaN."""
    index = torch.arange(0, len(reached.entry), LOOKED, device=reached.entry.device)
    entry, leave = reached.entry[index], reached.leave[index]
    shares = torch.arange(1, len(index) + 1, dtype=entry.dtype, device=entry.device) * GOLDEN % 1
    return field(rays[index].at(entry + shares * (leave - entry))).nan_to_num(0.0)


def _differing(kept: Solved, found: Solved, like: Bool[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Which rays meet a surface elsewhere in one of the two."""

    def met(solved: Solved) -> Float[Tensor, " n"]:
        nowhere = torch.full_like(like, torch.inf, dtype=solved.distance.dtype)
        return nowhere.index_put((solved.index,), solved.distance.detach().where(solved.settled, torch.inf))

    said, seen = met(kept), met(found)
    return ~((said == seen) | ((said - seen).abs() <= APART))


def _largest(values: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """The largest magnitude; 0 of nothing, infinite where one is not finite."""
    return values.abs().nan_to_num(torch.inf).amax() if values.numel() else values.new_zeros(())
