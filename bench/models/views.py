"""The views of a known shape that candidates are fitted to and evaluated on, all around the shape."""

from dataclasses import dataclass
from math import asin, degrees, radians, sin, sqrt

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from bench.models.held_out import HeldOut
from bench.models.observations import Holdout, RayObservations, held, hold_out, together
from bench.setup.auto import footprint
from bench.setup.fields import ViewSettings
from bench.solve.observed_view import GivenView, Weights
from datasets.scene import see
from datasets.truth import Truth
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.rendering import Renderer

GOLDEN = 180 * (3 - sqrt(5))  # degrees: the golden angle, from one camera of a Fibonacci lattice to the next


@dataclass(frozen=True)
class Views:
    """Makes views of a shape from all around.

    Args:
        truth: of the shape.
        sampler: the distance, field of view and resolution of the cameras.
        settings: numbers of views and rays.
        weights: of a view's loss.
        renderer: compares fields with the views.
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
        """Evenly spaced views to fit and, between them, held-out views."""
        settings = self.settings
        turn = float(np.random.default_rng([seed, 2]).uniform(0, 360))
        cameras = [*self._spread(settings.fitted, turn), *self._spread(settings.held_out, turn + GOLDEN / 2)]
        held = tuple(range(settings.fitted, len(cameras)))
        return hold_out(*self._seen(cameras), Holdout(settings.share, held, self.footprint, seed), rays=settings.rays)

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

    def _seen(self, cameras: list[Camera]) -> tuple[GivenView, Int[Tensor, " n"]]:
        views = [see(self.truth, camera) for camera in cameras]
        given = [
            GivenView.of(view, self.weights, self.renderer, observed=view.mask, mask=view.mask, device=self.device)
            for view in views
        ]
        pixels = views[0].mask.numel()
        return together(given), torch.arange(len(cameras)).repeat_interleave(pixels)
