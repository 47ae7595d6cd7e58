"""Noise on the points at which a field is evaluated while it is learnt: stochastic preconditioning."""

from dataclasses import dataclass, replace

import torch

from bench.solve.pixel_draw import generator_of
from bench.tasks.reconstruction.pixels import Pixels
from renderers.camera import Rays
from renderers.checks import check_at_least, check_fraction
from renderers.schedule import schedule_position

BLUR_SHARE = 0.5
SEED_OF_NOISE = 11  # added to seeds, so that the noise does not follow the draw of the pixels


@dataclass(frozen=True)
class PointBlur:
    """Moves the points of each ray by one draw of Gaussian noise.

    The mean of the field over the noise is its convolution with a Gaussian. The points of a ray move together. So along
    a ray there is no noise, every renderer finds a root, and a distance stays a distance.

    Source: "Stochastic Preconditioning for Neural Field Optimization" (Ling et al., SIGGRAPH 2025).
    Deviates: a linear fall; one draw per ray, not per point. With a draw per point and a deviation of 0.02, sphere
        tracing loses 93 % of its hits on a sphere of radius 0.6, and NeuS's hits lie 0.022 in front of it.

    Args:
        start: standard deviation of each coordinate at the first iteration, in scene units; 0 moves no points.
        share: of the iterations, after which the deviation is 0.
    """

    start: float = 0.0
    share: float = BLUR_SHARE

    def __post_init__(self) -> None:
        check_at_least("task.blur_points", self.start, 0, "0.02 is half a pixel at 40 x 40, 0 is no noise")
        check_fraction("task.blur_share", self.share, "0.5 leaves half of the iterations to details")

    def deviation(self, iteration: int, iterations: int) -> float:
        """The standard deviation at an iteration, in scene units; it falls linearly."""
        return self.start * max(1 - schedule_position(iteration) / (self.share * iterations), 0.0)

    def apply(self, pixels: Pixels, iteration: int, iterations: int, seed: int) -> Pixels:
        """The pixels with moved rays; what was observed there stays the same."""
        deviation = self.deviation(iteration, iterations)
        if not deviation:
            return pixels
        origins = pixels.rays.origins
        noise = torch.randn(origins.shape, generator=generator_of(seed + SEED_OF_NOISE, iteration)).to(origins)
        return replace(pixels, rays=Rays(origins + deviation * noise, pixels.rays.directions))
