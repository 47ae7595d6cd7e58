"""The observed depths and mask of a view or of rays, and the loss that compares a field with them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.solve.latent_code import Terms
from bench.solve.pixel_area import mean_depth, observation_of, random_rays
from bench.solve.pixel_draw import PixelDraw
from datasets.scene import Scene, View, see_area
from renderers.boundary import render_checked
from renderers.camera import Camera, Rays
from renderers.field import Field, Meter, central_differences
from renderers.rendering import RayObservation, Renderer, Rendering, at_iteration
from renderers.silhouette import SilhouetteLoss

DEPTH, POINTS = "depth", "points"  # errors averaged by a depth loss; see `bench.tasks.completion.Completion`
DEPTH_LOSSES = (DEPTH, POINTS)


def depth_error(
    loss: str, predicted: Float[Tensor, "*rays"], observed: Float[Tensor, "*rays"], per_distance: Float[Tensor, "*rays"]
) -> Float[Tensor, "*rays"]:
    """The error of each ray's depth, or of its point for "points"; `per_distance` is the depth at distance 1."""
    error = (predicted - observed).abs()
    return error / per_distance if loss == POINTS else error


def normal_error(predicted: Float[Tensor, "n 3"], observed: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """The mean of 1 minus the cosine between predicted and observed unit normals, if these are not 0 (DIST, B.3)."""
    has_normal = observed.square().sum(-1) > 0
    cosine = (predicted * observed).sum(-1)[has_normal]
    return (1 - cosine).sum() / has_normal.sum().clamp_min(1)


def expected_in_draw(observed: Bool[Tensor, "*rays"], count: int) -> float:
    """The mean number of observed rays in a draw of `count` rays, the `expected` of `observed_hits`."""
    return float(observed.sum()) * count / observed.numel()


def observed_hits(
    hit: Bool[Tensor, "*rays"], observed: Bool[Tensor, "*rays"], expected: float | None = None
) -> Float[Tensor, ""]:
    """The number of observed rays that hit, which a sum of their errors is divided by; 1 if there are none.

    Args:
        expected: the mean number of observed rays in a draw, if the rays are drawn. It replaces their number in this
            draw, so that the errors have the same weight on average as among all rays.
    """
    hits = (hit & observed).sum().to(torch.float32)
    count = hits if expected is None else expected * hits / observed.sum().clamp_min(1)
    return torch.where(hits > 0, count, 1.0)


@runtime_checkable
class ViewLossSettings(Protocol):
    """The settings of a view's loss: its terms and their weights."""

    depth_loss: str
    depth_weight: float
    silhouette_weight: float
    silhouette: SilhouetteLoss


@dataclass(frozen=True)
class ObservedView:
    """The observations of a view, or of rays of any leading shape; `compare` renders a field and compares it.

    With several rays per pixel, the rays have one more dimension than the observations, which are of pixels.
    """

    settings: ViewLossSettings
    renderer: Renderer
    rays: Rays
    depth: Float[Tensor, "*rays"]
    depth_per_distance: Float[Tensor, "*rays"]  # depth at distance 1, the cosine of DIST, Eq. 2
    observed: Bool[Tensor, "*rays"]
    mask: Bool[Tensor, "*rays"] | None
    normals: Float[Tensor, "*rays 3"] | None = None  # unit, in world coordinates; None if not observed
    normal_weight: float = 0.0  # of `normal_error` at observed hits
    normal_width: float = 0.0  # scene units, see `central_differences`
    colours: Float[Tensor, "*rays 3"] | None = None  # of an image; NaN outside of the shape
    colour_weight: float = 0.0  # of the mean absolute error of colours; the field then has `paint`
    expected_observed: float | None = None  # of drawn rays, see `observed_hits`
    covered: Float[Tensor, "*rays"] | None = None  # fraction of each pixel; None with one ray per pixel
    camera: Camera | None = None  # of several rays per pixel
    rays_at: Callable[[int], Rays] | None = None  # several rays [height, width, n] of each pixel, by iteration

    @staticmethod
    def of(
        view: View,
        settings: ViewLossSettings,
        renderer: Renderer,
        *,
        observed: Bool[Tensor, "height width"],
        mask: Bool[Tensor, "height width"] | None,
        device: torch.device,
    ) -> "ObservedView":
        """The observations that `observed` and `mask` select from a view, on a device."""
        return ObservedView(
            settings=settings,
            renderer=renderer,
            rays=view.camera.rays(),
            depth=view.depth,
            depth_per_distance=view.camera.depth(torch.ones(view.depth.shape)),
            observed=observed,
            mask=mask,
        ).to(device)

    def with_area(self, scene: Scene, camera: Camera, seed: int, fractions: bool | None = None) -> "ObservedView":
        """The observations of the area of pixels, of the scene's true mesh, if the scene has several rays per pixel.

        Args:
            fractions: whether a pixel's observation is the fraction that the shape covers, or 0 or 1 by its centre.
                None: with several rays per pixel.
        """
        if scene.rays_per_pixel == 1 and not fractions:
            return self
        device = self.depth.device
        covered, depth = (image.to(device) for image in see_area(scene.raycaster, camera))
        covered = scene.view.mask.to(covered) if fractions is False else covered
        camera = camera.to(device)
        rays_at = partial(random_rays, camera, scene.rays_per_pixel, seed)
        area = replace(self, depth=torch.where(self.observed, depth, 0.0), covered=covered)
        return replace(area, camera=camera, rays=rays_at(-1), rays_at=rays_at)

    def to(self, device: torch.device) -> "ObservedView":
        """The same observations on a device."""
        return self._map_tensors(lambda tensor: tensor.to(device))

    def flat(self) -> "ObservedView":
        """The same observations, flattened."""
        return self._map_tensors(
            lambda each: (
                Rays(each.origins.flatten(0, 1), each.directions.flatten(0, 1))
                if isinstance(each, Rays)
                else each.flatten(0, 1)
            )
        )

    def select(self, rays: Int[Tensor, " n"]) -> "ObservedView":
        """The observations of the rays with these indices, for flattened rays."""
        return self._map_tensors(lambda tensor: tensor[rays])

    def drawn(self, rays: Int[Tensor, " n"]) -> "ObservedView":
        """The observations of drawn flattened rays; terms have the same weights on average as among all rays."""
        return replace(self.select(rays), expected_observed=expected_in_draw(self.observed, len(rays)))

    def compare_drawn(self, draw: PixelDraw, field: Field, iteration: int) -> Terms:
        """The terms of `compare`, of the pixels that an iteration draws."""
        pixels = draw.pixels(iteration)
        view = self if self.rays_at is None else replace(self, rays=self.rays_at(iteration))
        drawn = view if pixels is None else view.flat().drawn(pixels.to(self.observed.device))
        return drawn.compare(field, iteration)

    def compare(self, field: Field, iteration: int) -> Terms:
        """The weighted loss terms of DIST, Eq. 5."""
        renderer = at_iteration(self.renderer, iteration)
        rendering = render_checked(renderer, field, self.rays)
        depth, compared = self.depth_term(rendering)
        terms = {"depth": depth}
        if self.normals is not None:
            gradients = central_differences(field, rendering.points[compared], self.normal_width)
            error = normal_error(torch.nn.functional.normalize(gradients, dim=-1), self.normals[compared])
            terms["normals"] = self.normal_weight * error
        if self.colours is not None:
            terms["colour"] = self.colour_weight * self._colour_error(field, rendering)
        if self.mask is not None:
            terms["silhouette"] = self.silhouette_term(renderer, field, rendering)
        return terms

    def depth_term(self, rendering: Rendering) -> tuple[Float[Tensor, ""], Bool[Tensor, "*rays"]]:
        """The weighted mean error of depths, and the observed rays that hit, over which it is the mean."""
        if self.camera is None:
            depth, hit = rendering.distance * self.depth_per_distance, rendering.hit
        else:
            depth, hit = mean_depth(rendering, self.camera.cosine(self.rays))
        compared = self.observed & hit
        error = depth_error(self.settings.depth_loss, depth, self.depth, self.depth_per_distance)
        count = observed_hits(hit, self.observed, self.expected_observed)
        return self.settings.depth_weight * (error * compared).sum() / count, compared

    def silhouette_term(self, renderer: Renderer, field: Field, rendering: Rendering) -> Float[Tensor, ""]:
        """The weighted silhouette loss."""
        distance = torch.where(self.observed, self.depth / self.depth_per_distance, torch.nan)
        if self.covered is None:
            observation = RayObservation(self.mask, distance)
        else:
            observation = observation_of(self.covered, distance, rendering)
        loss = self.settings.silhouette(renderer, field, self.rays, rendering, observation)
        return self.settings.silhouette_weight * loss

    def _colour_error(self, field: Field, rendering: Rendering) -> Float[Tensor, ""]:
        """The mean absolute error of colours over hits on pixels that show the shape (DIST, B.3)."""
        shape: Any = field.inner if isinstance(field, Meter) else field
        shown = rendering.hit & ~self.colours.isnan().any(-1)
        error = (shape.paint(rendering.points[shown]) - self.colours[shown]).abs()
        return error.sum() / (3 * shown.sum().clamp_min(1))

    def _map_tensors(self, change: Callable[[Any], Any]) -> "ObservedView":
        """Applies a function to the rays and to each tensor that is not None."""
        names = ("rays", "depth", "depth_per_distance", "observed", "mask", "normals", "colours", "covered")
        return replace(self, **{name: change(tensor) for name in names if (tensor := getattr(self, name)) is not None})
