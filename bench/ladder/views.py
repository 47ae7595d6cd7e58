"""The views that the capacity of fields is judged by: all around a shape, some of them held out."""

from dataclasses import dataclass
from math import asin, degrees, radians, sin, sqrt

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from bench.auto import footprint
from bench.ladder.held_out import HeldOut
from bench.ladder.observations import Holdout, RayObservations, held, hold_out, together
from bench.ladder.settings import ViewSettings
from bench.tasks.given import GivenView, Weights
from datasets.scene import see
from datasets.truth import Truth
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.rendering import Renderer

GOLDEN = 180 * (3 - sqrt(5))  # degrees: from a camera to the next, of any number that are spread over a sphere


@dataclass(frozen=True)
class Views:
    """Sees a shape from all around.

    Args:
        truth: of the shape.
        sampler: the distance, angle of view and resolution of the cameras.
        settings: how many.
        weights: of a view's loss.
        renderer: through which it is compared.
        device: of the rays.
    """

    truth: Truth
    sampler: ViewSampler
    settings: ViewSettings
    weights: Weights
    renderer: Renderer
    device: torch.device

    @property
    def footprint(self) -> float:
        """Half a pixel where the shape may be nearest (DIST, Eq. 10), in scene units."""
        return footprint(self.sampler.focal_length, self.sampler.distance)

    def observations(self, seed: int) -> RayObservations:
        """Evenly spread views to fit and, between them, views to hold out."""
        settings = self.settings
        turn = float(np.random.default_rng([seed, 2]).uniform(0, 360))
        cameras = [*self._spread(settings.fitted, turn), *self._spread(settings.held_out, turn + GOLDEN / 2)]
        held = tuple(range(settings.fitted, len(cameras)))
        return hold_out(*self._seen(cameras), Holdout(settings.share, held, self.footprint, seed), rays=settings.rays)

    def further(self, count: int, seed: int) -> HeldOut:
        """So many views more, that no choice has seen, each drawn at random."""
        draw, highest = np.random.default_rng([seed, 3]), sin(radians(self.settings.elevation))
        angles = [(draw.uniform(0, 360), degrees(asin(draw.uniform(-highest, highest)))) for _ in range(count)]
        view, group = self._seen([self.sampler.camera(*pair) for pair in angles])
        return held(view, torch.ones_like(view.observed), group, self.footprint)

    def _spread(self, count: int, turn: float) -> list[Camera]:
        """Cameras of even spacing over the belt of a sphere between the largest elevations (Fibonacci's lattice)."""
        highest = sin(radians(self.settings.elevation))
        heights = [highest * (1 - (2 * place + 1) / count) for place in range(count)]
        return [
            self.sampler.camera((turn + place * GOLDEN) % 360, degrees(asin(height)))
            for place, height in enumerate(heights)
        ]

    def _seen(self, cameras: list[Camera]) -> tuple[GivenView, Int[Tensor, " n"]]:
        views = [see(self.truth, camera) for camera in cameras]
        given = [
            GivenView.of(view, self.weights, self.renderer, observed=view.mask, mask=view.mask, device=self.device)
            for view in views
        ]
        pixels = views[0].mask.numel()
        return together(given), torch.arange(len(cameras)).repeat_interleave(pixels)
