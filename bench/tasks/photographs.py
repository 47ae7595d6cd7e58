"""Photographs with known cameras: the photometric loss, and held-out pairs for fields without a prior."""

from copy import copy
from dataclasses import dataclass, replace
from math import nan
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.models.held_out import HeldOutError
from bench.solve.latent_code import Terms
from bench.solve.optimise import StartSettings
from bench.solve.problem import NotReached, OptimiserSettings
from datasets.shot import Shot
from renderers.adaptive_samples import at_max_samples
from renderers.boundary import rendered
from renderers.camera import Rays
from renderers.checks import BadInput
from renderers.field import Field
from renderers.rendering import Renderer, at_iteration

SURE = 0.999  # least weight of neighbouring pixels on the shape for a depth to be interpolated between them
HELD_OUT_EVERY = 6  # every sixth pair of photographs is held out, where a field has no prior


@runtime_checkable
class PhotometricSettings(Protocol):
    """The settings of a task that the loss reads; see `bench.tasks.multiview.Multiview`."""

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
    def optimiser(self) -> OptimiserSettings: ...

    @property
    def turns(self) -> StartSettings: ...


class GivenPhotographs:
    """The given photographs; `compare` renders a field's depths and warps the photographs by them."""

    def __init__(
        self, settings: PhotometricSettings, renderer: Renderer, photographs: list[Shot], device: torch.device
    ):
        self.settings, self.renderer = settings, renderer
        self.cameras = [photograph.camera.to(device) for photograph in photographs]
        self.rays = [camera.rays() for camera in self.cameras]
        self.colours = torch.stack([photograph.colours for photograph in photographs]).to(device)
        self.per_step = min(settings.views_per_step, len(photographs))

    def pairs(self, iteration: int) -> list[tuple[int, int]]:
        """The views that an iteration compares, each paired with its neighbour."""
        return spaced(neighbours(len(self.cameras), self.settings.neighbour), self.per_step, iteration)

    def compare(self, field: Field, iteration: int, pairs: list[tuple[int, int]] | None = None) -> Terms:
        """The weighted mean absolute difference of colours over the pixels that both views see (Eq. 6).

        Args:
            field: field of the shape.
            iteration: current iteration.
            pairs: pairs of views; None for those of the iteration.

        Raises:
            NotReached: where no pixel is seen by both views.
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
    ) -> list[Float[Tensor, " _"]]:
        """Absolute differences of colours for each pair, over the pixels that both views see."""
        mine = rendered(renderer, field, self._together([pair[0] for pair in pairs]))
        with torch.no_grad():
            others = rendered(renderer, field, self._together([pair[1] for pair in pairs]))
        differences = []
        for k, (view, other) in enumerate(pairs):
            pixels, depth = self.cameras[other].project(mine.points[k])
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
        """Where a view's depth agrees with that of points of another view that project to `pixels` (DIST, B.3)."""
        both = torch.stack([depth * hit, hit.to(depth.dtype)], dim=-1)
        known, inside = sample(both, pixels)
        close = (known[..., 0] - expected).square() < self.settings.visible
        return inside & close & (known[..., 1] > SURE)

    def _together(self, views: list[int]) -> Rays:
        chosen = [self.rays[view] for view in views]
        origins = torch.stack([rays.origins for rays in chosen])
        return Rays(origins, torch.stack([rays.directions for rays in chosen]), image=True)

    def _blurred(self, iteration: int) -> Float[Tensor, "views height width 3"]:
        """The images at an iteration, blurred at first where `coarse_blur` is set."""
        iterations = self.settings.turns.iterations_of_last(self.settings.optimiser.iterations)
        sigma = self.settings.coarse_blur * self.colours.shape[1] * (1 - 2 * iteration / iterations)
        return self.colours if sigma <= 0 else blurred(self.colours, sigma)


@dataclass(frozen=True)
class PhotographObservations:
    """Photographs of which some are held out; see `bench.models.observations.Observations`.

    Errors are differences of colours, so no pixel footprint applies: `footprint` is 0.

    Args:
        given: all photographs.
        fitted, held_out: pairs of neighbours; no photograph is in both lists.
    """

    given: GivenPhotographs
    fitted: list[tuple[int, int]]
    held_out: list[tuple[int, int]]

    footprint: ClassVar[float] = 0.0

    @staticmethod
    def of(given: GivenPhotographs) -> "PhotographObservations":
        """Holds out one of every `HELD_OUT_EVERY` pairs.

        Raises:
            BadInput: where there are too few photographs.
        """
        count = len(given.cameras)
        fitted, held_out = split_pairs(count, neighbour=given.settings.neighbour)
        if len(held_out) < 2 or not fitted:
            least = 2 * HELD_OUT_EVERY
            raise BadInput(
                f"{count} photographs leave no pairs to hold out where no prior is used: task.images.views={least}, "
                "with task.neighbour=1, or field=prior"
            )
        return PhotographObservations(given, fitted, held_out)

    @property
    def renderer(self) -> Renderer:
        """The renderer with which photographs are compared."""
        return self.given.renderer

    @property
    def rays(self) -> int:
        """Rays per iteration, of both views of each pair."""
        return (
            2 * min(self.given.per_step, len(self.fitted)) * self.given.colours.shape[1] * self.given.colours.shape[2]
        )

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """Known points of the surface: none."""
        return self.given.colours.new_zeros(0, 3)

    @property
    def free(self) -> Float[Tensor, "n 3"]:
        """Known points in free space: none."""
        return self.points

    def through(self, renderer: Renderer) -> "PhotographObservations":
        """The same observations, compared with another renderer."""
        given = copy(self.given)
        given.renderer = renderer
        return replace(self, given=given)

    def depth_error(self, terms: Terms) -> float:
        """Not a number: differences of colours give no error of depth."""
        return nan

    def terms(self, field: Field, iteration: int, share: float) -> Terms:
        """The photometric loss of an iteration's pairs.

        Raises:
            NotReached: where no point is seen by two views.
        """
        return self.given.compare(field, iteration, spaced(self.fitted, self.given.per_step, iteration))

    @torch.no_grad()
    def error(self, field: Field) -> HeldOutError:
        """The error of the held-out pairs."""
        return photographic_error(
            self.given.differences(field, at_max_samples(self.renderer), self.held_out, self.given.colours)
        )


def photographic_error(differences: list[Float[Tensor, " _"]]) -> HeldOutError:
    """The mean over pairs of the mean difference of colours; 1, the largest, where two photographs share no point."""
    rows = [[float(found.mean()), 1, 0, 1] if len(found) else [0, 0, 1, 1] for found in differences]
    return HeldOutError(np.array(rows, dtype=np.float64), 1.0)


def neighbours(count: int, apart: int) -> list[tuple[int, int]]:
    """Pairs of each of `count` views on a circle with the one that is `apart` views further."""
    return [(view, (view + apart) % count) for view in range(count)]


def spaced(pairs: list[tuple[int, int]], most: int, iteration: int) -> list[tuple[int, int]]:
    """The pairs of an iteration, at most `most`, evenly spaced; they shift by one with each iteration."""
    count = min(most, len(pairs))
    return [pairs[(iteration + round(k * len(pairs) / count)) % len(pairs)] for k in range(count)]


def split_pairs(count: int, *, neighbour: int) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Pairs of neighbouring views that a field is fitted to, and held-out pairs; no view is in both lists."""
    pairs = neighbours(count, neighbour)
    held_out = [pair for pair in pairs[::HELD_OUT_EVERY] if max(pair) < count - 1 or min(pair) > 0]
    hidden = {view for pair in held_out for view in pair}
    return [pair for pair in pairs if not hidden & set(pair)], held_out


def blurred(images: Float[Tensor, "views height width 3"], sigma: float) -> Float[Tensor, "views height width 3"]:
    """Images convolved with a Gaussian of standard deviation `sigma` in pixels; mirrored at their edges."""
    reach = min(int(3 * sigma) + 1, images.shape[1] - 1, images.shape[2] - 1)
    offsets = torch.arange(-reach, reach + 1, dtype=images.dtype, device=images.device)
    weights = torch.softmax(-0.5 * (offsets / sigma).square(), dim=0)
    flat = images.permute(0, 3, 1, 2).reshape(-1, 1, *images.shape[1:3])
    padded = torch.nn.functional.pad(flat, (reach, reach, reach, reach), mode="reflect")
    across = torch.nn.functional.conv2d(padded, weights.view(1, 1, 1, -1))
    both = torch.nn.functional.conv2d(across, weights.view(1, 1, -1, 1))
    return both.view(len(images), 3, *images.shape[1:3]).permute(0, 2, 3, 1)


def sample(
    image: Float[Tensor, "height width channels"], pixels: Float[Tensor, "*batch 2"]
) -> tuple[Float[Tensor, "*batch channels"], Bool[Tensor, "*batch"]]:
    """Interpolates an image bilinearly between the centres of its pixels.

    Returns:
        colours: 0 where `pixels` lie beyond the outermost centres, so that nothing is extrapolated.
        inside: false there.
    """
    height, width, _ = image.shape
    inside = (pixels >= 0.5).all(-1) & (pixels[..., 0] <= width - 0.5) & (pixels[..., 1] <= height - 0.5)
    place = torch.where(inside[..., None], pixels, 0.5) - 0.5
    last = torch.tensor([max(width - 2, 0), max(height - 2, 0)], dtype=place.dtype, device=place.device)
    low = torch.minimum(place.detach().floor(), last)
    across, down = (place - low)[..., :1], (place - low)[..., 1:]
    column, row = low.long().unbind(-1)
    right, below = (column + 1).clamp_max(width - 1), (row + 1).clamp_max(height - 1)
    upper = image[row, column] * (1 - across) + image[row, right] * across
    lower = image[below, column] * (1 - across) + image[below, right] * across
    return (upper * (1 - down) + lower * down) * inside[..., None], inside
