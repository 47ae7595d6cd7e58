"""Photographs with known cameras: their loss, and what is held out of them where a field has no prior."""

from copy import copy
from dataclasses import dataclass, replace
from math import nan
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.ladder.held_out import HeldOutError
from bench.starts import StartSettings
from bench.tasks.code import Terms
from bench.tasks.problem import NotReached
from bench.thickness import finest
from bench.warp import project, sample
from datasets.photographs import Photograph
from renderers.camera import Rays
from renderers.field import Field
from renderers.rendering import Renderer, at_iteration

SURE = 0.999  # of the weight of a pixel's neighbours must be on the shape for a depth between them
HELD_OUT_EVERY = 6  # photographs, where a field has no prior: a pair of them


@runtime_checkable
class PhotometricSettings(Protocol):
    """What the loss reads of a task's settings; see `bench.tasks.multiview.Multiview`."""

    @property
    def views_per_step(self) -> int: ...

    @property
    def neighbour(self) -> int: ...

    @property
    def visible(self) -> float: ...

    @property
    def photometric_weight(self) -> float: ...

    @property
    def coarse_blur(self) -> float: ...

    @property
    def iterations(self) -> int: ...

    @property
    def turns(self) -> StartSettings: ...


class GivenPhotographs:
    """The photographs; `compare` renders a field's depths and warps by them."""

    def __init__(
        self, settings: PhotometricSettings, renderer: Renderer, photographs: list[Photograph], device: torch.device
    ):
        self.settings, self.renderer = settings, renderer
        self.cameras = [photograph.view.camera.to(device) for photograph in photographs]
        self.rays = [camera.rays() for camera in self.cameras]
        self.colours = torch.stack([photograph.colours for photograph in photographs]).to(device)
        self.per_step = min(settings.views_per_step, len(photographs))

    def pairs(self, iteration: int) -> list[tuple[int, int]]:
        """The views that an iteration compares, each with its neighbour."""
        return spaced(neighbours(len(self.cameras), self.settings.neighbour), self.per_step, iteration)

    def compare(self, field: Field, iteration: int, pairs: list[tuple[int, int]] | None = None) -> Terms:
        """The weighted mean absolute difference of colours over the pixels that both views see (Eq. 6).

        Args:
            field: of the shape.
            iteration: at which it is compared.
            pairs: of views; None for those of the iteration.

        Raises:
            NotReached: where there is no such pixel.
        """
        renderer, pairs = at_iteration(self.renderer, iteration), self.pairs(iteration) if pairs is None else pairs
        together = torch.cat(self.differences(field, renderer, pairs, self._blurred(iteration)))
        if not len(together):
            raise NotReached(f"no point of the shape is seen by two neighbouring views at iteration {iteration}")
        return {"photometric": self.settings.photometric_weight * together.mean()}

    def differences(
        self,
        field: Field,
        renderer: Renderer,
        pairs: list[tuple[int, int]],
        colours: Float[Tensor, "views height width 3"],
    ) -> list[Float[Tensor, "_"]]:
        """Absolute differences of colours, of each pair over the pixels that both views see."""
        mine = renderer.render(field, self._together([pair[0] for pair in pairs]))
        with torch.no_grad():
            others = renderer.render(field, self._together([pair[1] for pair in pairs]))
        differences = []
        for k, (view, other) in enumerate(pairs):
            pixels, depth = project(self.cameras[other], mine.points[k])
            with torch.no_grad():
                there = self.cameras[other].depth(others.distance[k])
                seen = mine.hit[k] & self._sees(there, others.hit[k], pixels, depth)
            warped, _ = sample(colours[other], pixels[seen])
            differences.append((warped - colours[view][seen]).abs().mean(-1))
        return differences

    def _sees(
        self,
        depth: Float[Tensor, "height width"],
        hit: Bool[Tensor, "height width"],
        pixels: Float[Tensor, "height width 2"],
        expected: Float[Tensor, "height width"],
    ) -> Bool[Tensor, "height width"]:
        """Where a view's own depth agrees with that of the points that fall on `pixels` (DIST, B.3)."""
        both = torch.stack([depth * hit, hit.to(depth.dtype)], dim=-1)
        known, inside = sample(both, pixels)
        close = (known[..., 0] - expected).square() < self.settings.visible
        return inside & close & (known[..., 1] > SURE)

    def _together(self, views: list[int]) -> Rays:
        chosen = [self.rays[view] for view in views]
        origins = torch.stack([rays.origins for rays in chosen])
        return Rays(origins, torch.stack([rays.directions for rays in chosen]), image=True)

    def _blurred(self, iteration: int) -> Float[Tensor, "views height width 3"]:
        """The images at an iteration: coarse ones first, where that is asked for."""
        own = self.settings.turns.own(self.settings.iterations)
        sigma = self.settings.coarse_blur * self.colours.shape[1] * (1 - 2 * iteration / own)
        return self.colours if sigma <= 0 else blurred(self.colours, sigma)


@dataclass(frozen=True)
class PhotographObservations:
    """Photographs of which some are held out; see `bench.ladder.observations.Observations`.

    Errors are differences of colours, which no pixel's footprint bounds.

    Args:
        given: all photographs.
        fitted, held_out: pairs of neighbours, of which no photograph is in both.
    """

    given: GivenPhotographs
    fitted: list[tuple[int, int]]
    held_out: list[tuple[int, int]]

    footprint: ClassVar[float] = 0.0

    @staticmethod
    def of(given: GivenPhotographs) -> "PhotographObservations":
        """Holds out every so many pairs.

        Raises:
            ValueError: where there are too few photographs.
        """
        count = len(given.cameras)
        fitted, held_out = split_pairs(count, neighbour=given.settings.neighbour)
        if len(held_out) < 2 or not fitted:
            least = 2 * HELD_OUT_EVERY
            raise ValueError(
                f"{count} photographs leave no pairs to hold out where no prior is used: task.images.views={least}, "
                "with task.neighbour=1, or field=prior"
            )
        return PhotographObservations(given, fitted, held_out)

    @property
    def renderer(self) -> Renderer:
        """Through which photographs are compared."""
        return self.given.renderer

    @property
    def rays(self) -> int:
        """Of both views of each pair."""
        return (
            2 * min(self.given.per_step, len(self.fitted)) * self.given.colours.shape[1] * self.given.colours.shape[2]
        )

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """None are known."""
        return self.given.colours.new_zeros(0, 3)

    @property
    def free(self) -> Float[Tensor, "n 3"]:
        """None are known."""
        return self.points

    def through(self, renderer: Renderer) -> "PhotographObservations":
        """The same, compared through another renderer."""
        given = copy(self.given)
        given.renderer = renderer
        return replace(self, given=given)

    def left(self, terms: Terms) -> float:
        """A difference of colours is no length."""
        return nan

    def terms(self, field: Field, iteration: int, share: float) -> Terms:
        """The photometric loss of an iteration's pairs.

        Raises:
            NotReached: where no point is seen by two views.
        """
        return self.given.compare(field, iteration, spaced(self.fitted, self.given.per_step, iteration))

    @torch.no_grad()
    def error(self, field: Field) -> HeldOutError:
        """Of the pairs that are held out."""
        return photographic_error(
            self.given.differences(field, finest(self.renderer), self.held_out, self.given.colours)
        )


def photographic_error(differences: list[Float[Tensor, "_"]]) -> HeldOutError:
    """The mean over pairs of the mean difference of colours; 1, the largest, where two photographs share no point."""
    rows = [[float(found.mean()), 1, 0, 1] if len(found) else [0, 0, 1, 1] for found in differences]
    return HeldOutError(np.array(rows, dtype=np.float64), 1.0)


def neighbours(count: int, apart: int) -> list[tuple[int, int]]:
    """Each of so many views on a circle with one of its neighbours."""
    return [(view, (view + apart) % count) for view in range(count)]


def spaced(pairs: list[tuple[int, int]], most: int, iteration: int) -> list[tuple[int, int]]:
    """The pairs of an iteration, evenly spaced; they move on by one with each."""
    count = min(most, len(pairs))
    return [pairs[(iteration + round(k * len(pairs) / count)) % len(pairs)] for k in range(count)]


def split_pairs(count: int, *, neighbour: int) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Pairs of neighbouring views that a field is fitted to, and pairs that judge it; no view is in both."""
    pairs = neighbours(count, neighbour)
    held_out = [pair for pair in pairs[::HELD_OUT_EVERY] if max(pair) < count - 1 or min(pair) > 0]
    hidden = {view for pair in held_out for view in pair}
    return [pair for pair in pairs if not hidden & set(pair)], held_out


def blurred(images: Float[Tensor, "views height width 3"], sigma: float) -> Float[Tensor, "views height width 3"]:
    """Images under a Gaussian whose standard deviation is in pixels; at their edges they are mirrored."""
    reach = min(int(3 * sigma) + 1, images.shape[1] - 1, images.shape[2] - 1)
    offsets = torch.arange(-reach, reach + 1, dtype=images.dtype, device=images.device)
    weights = torch.softmax(-0.5 * (offsets / sigma).square(), dim=0)
    flat = images.permute(0, 3, 1, 2).reshape(-1, 1, *images.shape[1:3])
    padded = torch.nn.functional.pad(flat, (reach, reach, reach, reach), mode="reflect")
    across = torch.nn.functional.conv2d(padded, weights.view(1, 1, 1, -1))
    both = torch.nn.functional.conv2d(across, weights.view(1, 1, -1, 1))
    return both.view(len(images), 3, *images.shape[1:3]).permute(0, 2, 3, 1)
