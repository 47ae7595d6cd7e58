"""The check of what a renderer returns: a broken rendering is an error, and a valid one costs no evaluations."""

from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch

from bench.config import load
from renderers.boundary import BrokenContract, check_gradients, render_checked, silhouette_loss
from renderers.camera import Rays
from renderers.field import Kind
from renderers.fields.analytic import Shape, sphere
from renderers.rendering import Capabilities, RayObservation, Rendering
from tests.looped import each
from tests.tiny import camera_of

IDR = load("renderer", "idr")
RAYS = camera_of(8).rays()
MASK = torch.ones(RAYS.shape, dtype=torch.bool)
OBSERVATION = RayObservation(MASK)
BOTH_GRADIENTS = Capabilities((Kind.DISTANCE,), field_gradient=True, ray_gradient=True)
NO_GRADIENT = Capabilities((Kind.DISTANCE,), field_gradient=False, ray_gradient=False)


def changed(rendering: Any, **attributes: Any) -> Any:
    """A copy with other attributes, set without the type checks that only tests have."""
    copy = replace(rendering)
    for name, value in attributes.items():
        object.__setattr__(copy, name, value)
    return copy


def unchanged(returned: Any) -> Any:
    return returned


@dataclass
class Mine:
    """IDR, with `change` applied to its rendering and `loss` to its silhouette loss."""

    change: Any = unchanged
    loss: Any = unchanged
    capabilities: Capabilities = BOTH_GRADIENTS

    def render(self, field, rays):
        return self.change(IDR.render(field, rays))

    def silhouette_loss(self, field, rays, rendering, mask):
        return self.loss(IDR.silhouette_loss(field, rays, rendering, mask))


def ball(radius: float = 0.5, *, free: bool = False) -> Shape:
    """A sphere whose radius may be a free parameter."""
    return sphere(torch.tensor(radius, requires_grad=True) if free else radius)


def detached(rendering: Rendering) -> Rendering:
    return replace(rendering, distance=rendering.distance.detach())


def free_rays() -> Rays:
    return Rays(RAYS.origins.clone().requires_grad_(), RAYS.directions)


BROKEN = {
    "nothing": (lambda r: None, "Mine.render must return a Rendering, not None: see "),
    "short": (
        lambda r: changed(r, distance=r.distance[:-1]),
        r"Mine.render: distance must have the shape \[8, 8\], not \[7, 8\]: return one answer per ray"),
    "flat points": (
        lambda r: changed(r, points=r.points[..., :2]),
        r"points must have the shape \[8, 8, 3\], not \[8, 8, 2\]: return points of shape \[\*rays, 3\]"),
    "double": (
        lambda r: changed(r, residual=r.residual.double()),
        r"residual must be float32, as the rays are, not float64: convert it with .to\(torch.float32\)"),
    "long status": (
        lambda r: changed(r, status=r.status.long()),
        r"status must be int8, a Status per ray, not int64: convert it with .to\(torch.int8\)"),
    "no tensor": (lambda r: changed(r, closest=None), "closest must be a tensor, not a NoneType"),
    "elsewhere": (
        lambda r: changed(r, closest=r.closest.detach().to("meta")),
        "closest must be on cpu, not on meta: create tensors with device=rays.origins.device"),
}  # fmt: skip


@each("name", BROKEN)
def test_a_broken_rendering_is_an_error_that_names_the_renderer_and_the_attribute(name):
    change, message = BROKEN[name]
    with pytest.raises(BrokenContract, match=message):
        render_checked(Mine(change), ball(), RAYS)


def test_a_graph_while_gradients_are_off_is_an_error():
    bound = Mine(lambda r: changed(r, residual=r.residual.clone().requires_grad_()))
    render_checked(bound, ball(), RAYS)
    with torch.no_grad(), pytest.raises(BrokenContract, match="residual has a graph although gradients are off"):
        render_checked(bound, ball(), RAYS)


def test_a_claimed_gradient_that_is_missing_is_an_error():
    towards_field = r"Mine\.capabilities\.field_gradient is True, but the distances of its hits carry no gradient "
    with pytest.raises(BrokenContract, match=towards_field + "towards the field's parameters: attach one .*=False"):
        render_checked(Mine(detached), ball(free=True), RAYS)
    with pytest.raises(BrokenContract, match=r"ray_gradient is True, .* towards the rays"):
        render_checked(Mine(detached), ball(), free_rays())


@each("renderer, field, rays", [
    (Mine(detached, capabilities=NO_GRADIENT), ball(free=True), RAYS),  # the renderer claims no gradient
    (Mine(detached, capabilities=NO_GRADIENT), ball(), free_rays()),
    (Mine(detached), ball(), RAYS),  # nothing requires a gradient
    (Mine(detached), ball(0.001, free=True).translate((0.0, 0.9, 0.0)), RAYS),  # nothing is hit
    (Mine(), ball(free=True), free_rays()),  # the gradient exists
])  # fmt: skip
def test_a_gradient_that_is_not_needed_may_be_missing(renderer, field, rays):
    render_checked(renderer, field, rays)


LOSSES = {
    "nothing": (lambda loss: None, r"Mine.silhouette_loss must return a tensor with one number, not None: return the"),
    "per ray": (lambda loss: loss.expand(64), r"of shape \[\], not float32 of shape \[64\]: take its mean"),
    "detached": (lambda loss: loss.detach() + 1, "but its silhouette loss carries no gradient towards the field's"),
}


@each("name", LOSSES)
def test_a_broken_silhouette_loss_is_an_error(name):
    change, message = LOSSES[name]
    field = ball(free=True)
    rendering = IDR.render(field, RAYS)
    with pytest.raises(BrokenContract, match=message):
        silhouette_loss(Mine(loss=change), field, RAYS, rendering, OBSERVATION)
    assert silhouette_loss(Mine(loss=lambda loss: torch.zeros(())), field, RAYS, rendering, OBSERVATION) == 0


@dataclass
class TakesDistances(Mine):
    """IDR, with the mean of the observed distances as its loss."""

    def observed_loss(self, field, rays, rendering, observed):
        return self.loss(observed.distance.mean())


def test_observed_distances_reach_only_a_renderer_that_takes_them():
    field, observation = ball(), RayObservation(MASK, torch.full(RAYS.shape, 1.25))
    rendering = IDR.render(field, RAYS)
    assert silhouette_loss(TakesDistances(), field, RAYS, rendering, observation) == 1.25
    assert silhouette_loss(Mine(), field, RAYS, rendering, observation) == IDR.silhouette_loss(
        field, RAYS, rendering, MASK
    )
    with pytest.raises(BrokenContract, match=r"TakesDistances\.observed_loss must return a tensor .*, not None"):
        silhouette_loss(TakesDistances(loss=lambda loss: None), field, RAYS, rendering, observation)


def test_missing_gradients_of_a_hit_are_errors_if_they_are_claimed():
    gradient = torch.ones(2)
    check_gradients(Mine(), gradient, gradient)
    check_gradients(Mine(capabilities=NO_GRADIENT), None, None)
    with pytest.raises(BrokenContract, match="field_gradient is True"):
        check_gradients(Mine(), None, gradient)
    with pytest.raises(BrokenContract, match="ray_gradient is True"):
        check_gradients(Mine(), gradient, None)
