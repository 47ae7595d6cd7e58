"""A scene whose rays can be followed: its fields, its camera, the truth on a ray, and where a renderer is wrong."""

from dataclasses import dataclass
from functools import cached_property
from math import ceil

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.evaluate.along_ray import TrueRay, true_ray
from bench.evaluate.ray_derivatives import Parameters
from bench.evaluate.reference import RADIUS, trace_exactly
from renderers.boundary import render_checked
from renderers.camera import Camera, Rays, sphere_span
from renderers.field import Field, estimate_lipschitz
from renderers.rendering import Renderer

MAX_SEARCHED_PIXELS = 64  # per side; of a larger image, every second pixel or fewer are searched
TOLERANCE_PIXELS = 0.1  # a hit is right within so many widths of a pixel at the true hit
MIN_SPACING_PER_SIDE = 1 / 16  # from one of the most wrong pixels to the next
Pixel = tuple[int, int]  # column and row


@dataclass(frozen=True)
class Search:
    """The errors of a renderer in an image, on a grid of searched pixels.

    Args:
        stride: one pixel in stride x stride is searched.
        error: in scene units; -1 where a ray misses the unit sphere. A ray without a hit ends where it leaves it.
        tolerance: the error up to which a hit is right, in scene units.
        hit, reference_hit: of the renderer and of the reference.
    """

    stride: int
    error: Float[Tensor, "rows columns"]
    tolerance: Float[Tensor, "rows columns"]
    hit: Bool[Tensor, "rows columns"]
    reference_hit: Bool[Tensor, "rows columns"]

    def worst(self, count: int) -> list[tuple[Pixel, float]]:
        """The pixels with the largest ratios of error to tolerance, in that order and apart; with their errors."""
        ratio, spacing = self.error / self.tolerance, max(1, ceil(max(self.error.shape) * MIN_SPACING_PER_SIDE))
        pixels = list[tuple[Pixel, float]]()
        while len(pixels) < count and float(ratio.max()) >= 0:
            row, column = divmod(int(ratio.argmax()), ratio.shape[1])
            pixels.append(((self._full(column), self._full(row)), float(self.error[row, column])))
            rows, columns = (slice(max(0, middle - spacing + 1), middle + spacing) for middle in (row, column))
            ratio[rows, columns] = -1.0
        return pixels

    def _full(self, index: int) -> int:
        return self.stride // 2 + self.stride * index

    @property
    def summary(self) -> str:
        """The error of the most wrong pixel and the number of searched pixels, in words."""
        searched = "all pixels" if self.stride == 1 else f"one pixel in {self.stride} x {self.stride}"
        return f"by {self.worst(1)[0][1]:.2g} scene units, {searched} searched"


@dataclass(frozen=True)
class RayScene:
    """A scene: the field that renderers get, the field of the true surface in float64, and a camera.

    Args:
        parameters: the numbers to which the distances of hits have derivatives.
    """

    name: str
    field: Field
    exact: Field
    camera: Camera
    parameters: Parameters

    @cached_property
    def lipschitz(self) -> float:
        """An estimate of the Lipschitz constant of `exact`."""
        return estimate_lipschitz(self.exact, radius=RADIUS)

    def ray(self, pixel: Pixel, camera: Camera) -> Rays:
        """The ray of a pixel, [1, 3], of the scene's camera in float32 or float64.

        Raises:
            ValueError: if the pixel is outside the image, or its ray misses the unit sphere.
        """
        (column, row), height, width = pixel, camera.height, camera.width
        name, remedy = f"pixel={column},{row}", f"the middle is pixel={width // 2},{height // 2}"
        if column >= width or row >= height:
            size = f"{width} columns and {height} rows, which count from 0"
            raise ValueError(f"{name} is outside the image of {size}: {remedy}")
        rays = camera.rays()
        ray = Rays(rays.origins[row, column][None], rays.directions[row, column][None])
        if not bool(sphere_span(ray, RADIUS)[2]):
            raise ValueError(f"the ray of {name} misses the unit sphere that contains the scene: {remedy}")
        return ray

    @property
    def tolerance(self) -> float:
        """The error up to which a hit is right, as a fraction of the true distance."""
        return TOLERANCE_PIXELS / float(self.camera.intrinsics[0, 0])

    def true_ray(self, pixel: Pixel) -> TrueRay:
        ray = self.ray(pixel, self.camera.double())
        return true_ray(self.exact, ray, lipschitz=self.lipschitz, tolerance=self.tolerance)

    def search(self, renderer: Renderer) -> Search:
        """The errors of a renderer. No ray uses the coarse rays of an image."""
        stride = ceil(max(self.camera.height, self.camera.width) / MAX_SEARCHED_PIXELS)
        cut = (slice(stride // 2, None, stride),) * 2
        images = [camera.rays() for camera in (self.camera, self.camera.double())]
        rays, exact_rays = (Rays(image.origins[cut], image.directions[cut]) for image in images)
        with torch.no_grad():
            rendering = render_checked(renderer, self.field, rays.flat())
        reference = trace_exactly(self.exact, exact_rays.flat(), self.lipschitz)
        _, leave, in_sphere = sphere_span(exact_rays.flat(), RADIUS)
        ends = [torch.where(each.hit, each.distance.double(), leave) for each in (rendering, reference)]
        error = torch.where(in_sphere, (ends[0] - ends[1]).abs(), -1.0)
        tolerance = self.tolerance * ends[1].clamp_min(torch.finfo(torch.float32).eps)
        images = error, tolerance, rendering.hit, reference.hit
        return Search(stride, *(image.view(rays.shape) for image in images))
