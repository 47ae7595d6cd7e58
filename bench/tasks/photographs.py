"""Photographs with known cameras, and the photometric loss that compares a field with them."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.solve.latent_code import Terms
from bench.solve.optimise import StartSettings
from bench.solve.problem import NotReached, OptimiserSettings
from datasets.shot import Shot
from renderers.boundary import rendered
from renderers.camera import Rays
from renderers.field import Field
from renderers.rendering import Renderer, at_iteration

SURE = 0.999  # least weight of neighbouring pixels on the shape for a depth to be interpolated between them


@runtime_checkable
class PhotometricSettings(Protocol):
    """The settings of a task that the loss reads; see `bench.tasks.multiview.Multiview`."""

    views_per_step: int
    neighbour: int
    visible: float
    photometric_weight: float
    coarse_blur: float
    optimiser: OptimiserSettings
    turns: StartSettings


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
        """The views that an iteration compares, evenly spaced, each paired with its neighbour; they shift by one."""
        count = len(self.cameras)
        views = [(iteration + round(k * count / self.per_step)) % count for k in range(self.per_step)]
        return [(view, (view + self.settings.neighbour) % count) for view in views]

    def compare(self, field: Field, iteration: int) -> Terms:
        """The weighted mean absolute difference of colours over the pixels that both views see (Eq. 6).

        Raises:
            NotReached: where no pixel is seen by both views.
        """
        renderer, pairs = at_iteration(self.renderer, iteration), self.pairs(iteration)
        colours = self.blurred(iteration)
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
        together = torch.cat(differences)
        if not len(together):
            raise NotReached(f"no point of the shape is seen by two neighbouring views at iteration {iteration}")
        return {"photometric": self.settings.photometric_weight * together.mean()}

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

    def blurred(self, iteration: int) -> Float[Tensor, "views height width 3"]:
        """The images at an iteration, blurred at first where `coarse_blur` is set."""
        iterations = self.settings.turns.iterations_of_last(self.settings.optimiser.iterations)
        sigma = self.settings.coarse_blur * self.colours.shape[1] * (1 - 2 * iteration / iterations)
        return self.colours if sigma <= 0 else blurred(self.colours, sigma)


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
