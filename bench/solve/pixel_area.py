"""Several rays per pixel: random rays in its area, and what they predict of the pixel."""

from collections.abc import Sequence
from dataclasses import replace
from math import isqrt

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.solve.pixel_draw import generator_of
from renderers.camera import Camera, Rays, stacked
from renderers.rendering import RayObservation, Rendering

SEED_OF_RAYS = 7  # added to seeds, so that the rays of pixels do not follow the draw of the pixels


def random_rays(camera: Camera, count: int, seed: int, iteration: int) -> Rays:
    """The rays [height, width, count] of an iteration: a random one in each of `count` equal cells of each pixel.

    Args:
        count: a square number.
    """
    side, generator = isqrt(count), generator_of(seed + SEED_OF_RAYS, iteration)
    rays = camera.rays(random_offsets((camera.height, camera.width), count, generator).to(camera.intrinsics))
    return replace(rays, cells=camera.resized(camera.height * side, camera.width * side).rays())


def random_offsets(pixels: Sequence[int], count: int, generator: torch.Generator) -> Float[Tensor, "*pixels count 2"]:
    """Offsets from the centres of pixels, right and down, in pixels: a random one in each of `count` equal cells."""
    side = isqrt(count)
    corner = torch.cartesian_prod(torch.arange(side), torch.arange(side))
    return (corner + torch.rand(*pixels, count, 2, generator=generator)) / side - 0.5


def random_rays_of(cameras: Sequence[Camera], count: int, seed: int, iteration: int) -> Rays:
    """`random_rays` [cameras, height, width, count] of cameras with equal numbers of pixels."""
    rays = [random_rays(camera, count, seed + index, iteration) for index, camera in enumerate(cameras)]
    return replace(stacked(rays), cells=stacked([ray.cells for ray in rays]))


def mean_depth(
    rendering: Rendering, cosine: Float[Tensor, "*pixels rays"]
) -> tuple[Float[Tensor, "*pixels"], Bool[Tensor, "*pixels"]]:
    """The mean camera z of each pixel's hits, and whether it has any."""
    count = rendering.hit.sum(-1)
    return (rendering.distance * cosine * rendering.hit).sum(-1) / count.clamp_min(1), count > 0


def observation_of(
    covered: Float[Tensor, "*pixels"], distance: Float[Tensor, "*pixels"], rendering: Rendering
) -> RayObservation:
    """The observation of each ray [*pixels, rays] that changes fewest rays.

    Losses of single rays need a mask. In a pixel that is covered by a fraction k of n rays, k rays are the foreground:
    first rays that hit, in random order, then those whose `closest` is smallest. So the mask has no wrong ray if the
    right number hits.
    """
    rays, closest = rendering.closest.shape[-1], rendering.closest.detach()
    order = torch.where(rendering.hit, closest.min() - 1 - torch.rand_like(closest), closest)
    rank = order.argsort(-1).argsort(-1)
    mask = rank < (covered * rays).round()[..., None]
    return RayObservation(mask, distance[..., None].expand_as(mask), covered)
