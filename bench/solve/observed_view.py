"""The observations of a view or of some rays, depths and a mask, and the loss that compares a field with them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bench.solve.latent_code import Terms
from datasets.scene import View
from renderers.boundary import render_checked
from renderers.camera import Rays
from renderers.field import Field, Meter
from renderers.fields.coloured import TexturedShape
from renderers.rendering import RayObservation, Renderer, Rendering, at_iteration
from renderers.silhouette import SilhouetteLoss

DEPTH, POINTS = "depth", "points"  # what a depth loss takes the mean of; see `bench.tasks.completion.Completion`
DEPTH_LOSSES = (DEPTH, POINTS)


def depth_error(
    loss: str, found: Float[Tensor, "*rays"], given: Float[Tensor, "*rays"], at_one: Float[Tensor, "*rays"]
) -> Float[Tensor, "*rays"]:
    """The error of each ray's depth or of its point, as `loss` says; `at_one` is the depth at distance 1."""
    error = (found - given).abs()
    return error / at_one if loss == POINTS else error


def normal_error(found: Float[Tensor, "n 3"], given: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """1 less the cosine between unit normals and given ones, the mean over those that are not 0 (DIST, B.3)."""
    known = given.square().sum(-1) > 0
    cosine = (found * given).sum(-1)[known]
    return (1 - cosine).sum() / known.sum().clamp_min(1)


def slopes_at(field: Field, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """The field's gradients at points, with a graph towards its parameters and the points."""
    points = points if points.requires_grad else points.detach().requires_grad_(True)
    with torch.enable_grad():  # also where only the loss is wanted
        return torch.autograd.grad(field(points).sum(), points, create_graph=True)[0]


def slopes_over(field: Field, points: Float[Tensor, "n 3"], width: float) -> Float[Tensor, "n 3"]:
    """The field's differences along the axes between points that are `width` apart, about the given ones, over it.

    The gradient at a point of a ReLU network is the same for all codes that open the same ReLUs, so that it has no
    derivative towards the code; these slopes have one, by the ReLUs that lie between.
    """
    moves = width / 2 * torch.eye(3, dtype=points.dtype, device=points.device)
    around = points[:, None, None] + torch.stack([moves, -moves])
    ahead, behind = field(around).unbind(dim=1)
    return (ahead - behind) / width


@runtime_checkable
class Weights(Protocol):
    """The terms of a view's loss and their weights."""

    depth_loss: str
    depth_weight: float
    silhouette_weight: float
    silhouette: SilhouetteLoss


@dataclass(frozen=True)
class GivenView:
    """The observations of a view, or of rays of any leading shape; `compare` renders a field and compares it."""

    settings: Weights
    renderer: Renderer
    rays: Rays
    depth: Float[Tensor, "*rays"]
    depth_of_distance: Float[Tensor, "*rays"]  # depth at distance 1, the cosine of DIST, Eq. 2
    observed: Bool[Tensor, "*rays"]
    mask: Bool[Tensor, "*rays"] | None
    normals: Float[Tensor, "*rays 3"] | None = None  # unit, in world coordinates; None where they are not given
    normal_weight: float = 0.0  # of 1 less their cosine with those of the rendered surface, where observed and hit
    normal_width: float = 0.0  # scene units, see `slopes_over`
    colours: Float[Tensor, "*rays 3"] | None = None  # of an image; NaN where it does not show the shape
    colour_weight: float = 0.0  # of the mean absolute error of a `TexturedShape`'s

    @staticmethod
    def of(
        view: View,
        settings: Weights,
        renderer: Renderer,
        *,
        observed: Bool[Tensor, "height width"],
        mask: Bool[Tensor, "height width"] | None,
        device: torch.device,
    ) -> "GivenView":
        """The observations that `observed` and `mask` select from a view, on a device."""
        return GivenView(
            settings=settings,
            renderer=renderer,
            rays=view.camera.rays(),
            depth=view.depth,
            depth_of_distance=view.camera.depth(torch.ones(view.depth.shape)),
            observed=observed,
            mask=mask,
        ).to(device)

    def to(self, device: torch.device) -> "GivenView":
        """The same on a device."""
        return self._changed(lambda part: part.to(device))

    def some(self, rays: Int[Tensor, " n"]) -> "GivenView":
        """The observations of some rays of one row."""
        return self._changed(lambda part: part[rays])

    def compare(self, field: Field, iteration: int) -> Terms:
        """The weighted terms of DIST, Eq. 5."""
        renderer = at_iteration(self.renderer, iteration)
        rendering = render_checked(renderer, field, self.rays)
        compared = self.observed & rendering.hit
        found = rendering.distance * self.depth_of_distance
        error = depth_error(self.settings.depth_loss, found, self.depth, self.depth_of_distance)
        terms = {"depth": self.settings.depth_weight * (error * compared).sum() / compared.sum().clamp_min(1)}
        if self.normals is not None:
            slopes = slopes_over(field, rendering.points[compared], self.normal_width)
            off = normal_error(torch.nn.functional.normalize(slopes, dim=-1), self.normals[compared])
            terms["normals"] = self.normal_weight * off
        if self.colours is not None:
            terms["colour"] = self.colour_weight * self._colour_error(field, rendering)
        if self.mask is not None:
            given = torch.where(self.observed, self.depth / self.depth_of_distance, torch.nan)
            silhouette = self.settings.silhouette(
                renderer, field, self.rays, rendering, RayObservation(self.mask, given)
            )
            terms["silhouette"] = self.settings.silhouette_weight * silhouette
        return terms

    def _colour_error(self, field: Field, rendering: Rendering) -> Float[Tensor, ""]:
        """The mean absolute error of colours where the shape is hit and shown (DIST, B.3)."""
        shape: TexturedShape = field.inner if isinstance(field, Meter) else field
        seen = rendering.hit & ~self.colours.isnan().any(-1)
        error = (shape.paint(rendering.points[seen]) - self.colours[seen]).abs()
        return error.sum() / (3 * seen.sum().clamp_min(1))

    def _changed(self, change: Callable[[Any], Any]) -> "GivenView":
        """The same with each part changed that there is."""
        names = ("rays", "depth", "depth_of_distance", "observed", "mask", "normals", "colours")
        return replace(self, **{name: change(part) for name in names if (part := getattr(self, name)) is not None})
