"""Silhouette losses: that of DIST, Eq. 11, against values by hand, and all losses with several renderers."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch

from bench.config import load
from bench.tables import names
from renderers.boundary import BrokenContract
from renderers.camera import Rays
from renderers.fields.analytic import sphere
from renderers.rendering import Capabilities, RayObservation, Renderer, Unsupported, at_iteration
from renderers.silhouette import Hinge, SilhouetteLoss
from tests.looped import each
from tests.renderers.analytic_cases import sheet

# Threshold 0.1. Soft silhouettes |closest| - 0.1: 0.4, -0.07, 0.2, -0.06.
CLOSEST = torch.tensor([0.5, 0.03, -0.3, -0.04], dtype=torch.float64)
ALL, NONE = torch.ones(4, dtype=torch.bool), torch.zeros(4, dtype=torch.bool)


def loss(mask, *, signed=False, average="all", closest=CLOSEST):
    return Hinge(0.1, signed, average).of(closest, mask)


@each(
    "mask, signed, average, expected",
    [
        # Foreground should be below 0: 0.4 and 0.2 are not. Background should be above: -0.07 and -0.06 are not.
        (ALL, False, "all", (0.4 + 0.2) / 4),
        (NONE, False, "all", (0.07 + 0.06) / 4),
        (ALL, False, "violating", (0.4 + 0.2) / 2),
        (NONE, False, "violating", (0.07 + 0.06) / 2),
        (torch.tensor([True, True, False, False]), False, "all", (0.4 + 0.06) / 4),
        (torch.tensor([True, True, False, False]), False, "violating", (0.4 + 0.06) / 2),
        # With its sign, the soft silhouette is 0.4, -0.07, -0.4, -0.14.
        (ALL, True, "all", 0.4 / 4),
        (ALL, True, "violating", 0.4),
        (NONE, True, "all", (0.07 + 0.4 + 0.14) / 4),
        (NONE, True, "violating", (0.07 + 0.4 + 0.14) / 3),
        (torch.tensor([False, True, True, True]), True, "violating", 0),  # nothing violates
        (torch.tensor([False, True, False, True]), False, "all", 0),
        (torch.tensor([True, True, False, False]), False, "missed_plus_spurious", 0.4 + 0.06),
        (torch.tensor([True, True, False, False]), True, "missed_plus_spurious", 0.4 + (0.4 + 0.14) / 2),
        (ALL, False, "missed_plus_spurious", (0.4 + 0.2) / 2),
    ],
)
def test_values_worked_out_by_hand(mask, signed, average, expected):
    assert loss(mask, signed=signed, average=average).item() == pytest.approx(expected)


LOSSES = names("silhouette")
# Rays along z at a sphere of radius 0.5: the middle, just inside the edge, just outside, far outside, no unit sphere.
HEIGHTS = torch.tensor([0.0, 0.495, 0.505, 0.9, 1.2], dtype=torch.float64)


def of_sphere(renderer: Renderer, loss: SilhouetteLoss, mask: list[bool]) -> tuple[float, float]:
    """The loss of a sphere of radius 0.5, and its derivative with respect to the radius."""
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    origins = torch.stack([HEIGHTS, torch.zeros_like(HEIGHTS), torch.full_like(HEIGHTS, -2.0)], dim=-1)
    rays = Rays(origins, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(5, 3))
    torch.manual_seed(0)  # some losses draw points
    value = loss(
        renderer, sphere(radius), rays, renderer.render(sphere(radius), rays), RayObservation(torch.tensor(mask))
    )
    slope = torch.autograd.grad(value, radius, allow_unused=True)[0] if value.requires_grad else None
    return value.item(), 0.0 if slope is None else slope.item()


@each("renderer, loss", [("dist", "hinge"), ("naive", "hinge"), ("idr", "cross_entropy"), ("dvr", "occupancy")])
def test_the_loss_of_a_paper_equals_that_of_its_renderer(renderer, loss):
    instance, renderer_loss, chosen_loss = (
        load("renderer", renderer),
        load("silhouette", "own"),
        load("silhouette", loss),
    )
    for mask in ([True] * 4 + [False], [False] * 5, [True, False, True, False, False]):
        assert of_sphere(instance, chosen_loss, mask) == of_sphere(instance, renderer_loss, mask)


@each("renderer, loss, weight", [("neus", "area", 10), ("relaxed_boundary", "area", 10), ("dist", "hinge", 1)])
def test_area_or_hinge_is_the_area_loss_of_renderers_with_opacities(renderer, loss, weight):
    instance, mask = at_iteration(load("renderer", renderer), 0), [True] * 4 + [False]
    expected = [weight * number for number in of_sphere(instance, load("silhouette", loss), mask)]
    assert of_sphere(instance, load("silhouette", "area_or_hinge"), mask) == pytest.approx(expected)


@each("loss", LOSSES)
@each("renderer", ["dist", "dvr_64", "idr", "naive", "newton"])
def test_every_loss_grows_a_sphere_that_is_too_small_and_shrinks_one_that_is_too_large(renderer, loss):
    instance, silhouette_loss = load("renderer", renderer), load("silhouette", loss)
    if loss == "area":  # its gradient is tested with the renderers that have one
        with pytest.raises(Unsupported):
            of_sphere(instance, silhouette_loss, [False] * 5)
        return
    small, large = (
        of_sphere(instance, silhouette_loss, [True] * 4 + [False]),
        of_sphere(instance, silhouette_loss, [False] * 5),
    )
    assert small[0] > 0 and large[0] > 0 and small[1] < 0 < large[1]


@each("renderer", ["dist", "dvr_64", "idr", "naive", "newton"])
def test_under_one_loss_renderers_agree(renderer):
    hinge, mask = load("silhouette", "hinge"), [True] * 4 + [False]
    expected = of_sphere(load("renderer", "idr", steps=500), hinge, mask)
    assert of_sphere(load("renderer", renderer), hinge, mask) == pytest.approx(expected, rel=0.05)


def test_a_correct_hit_costs_nothing_for_any_threshold_of_the_renderer():
    """A hit may have a value far above the threshold of the loss. The weight of a spurious hit must not change."""
    rough = load("renderer", "idr", epsilon=0.05)  # also rays that pass the sphere by 0.005 are hits
    assert of_sphere(rough, load("silhouette", "hinge"), [True] * 3 + [False] * 2)[0] == 0
    assert of_sphere(rough, load("silhouette", "hinge"), [True] * 2 + [False] * 3) == (5e-5, 1.0)


@each("name", ["neus", "opaque", "volsdf", "unisurf"])
def test_each_spurious_hit_shrinks_the_shape_whatever_its_closest_value(name):
    """The least value of a volume renderer may lie in front of the surface, and would cost nothing at a hit."""
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    rays = sheet(*[torch.linspace(-0.45, 0.45, 12, dtype=torch.float64)] * 2)
    rendering = at_iteration(load("renderer", name), 0).render(sphere(radius), rays)
    assert (rendering.hit & (rendering.closest > 5e-5)).sum() > 10
    loss = Hinge(5e-5, signed=True, average="all").of_rendering(
        sphere(radius), rays, rendering, torch.zeros_like(rendering.hit)
    )
    (slope,) = torch.autograd.grad(loss, radius)
    assert slope.item() >= rendering.hit.double().mean().item() * 0.999
    assert loss.item() >= 5e-5 * rendering.hit.double().mean().item() * 0.999


@dataclass(frozen=True)
class Detached:
    """IDR, whose closest values carry no gradient, although it claims one."""

    capabilities: ClassVar[Capabilities] = load("renderer", "idr").capabilities

    def render(self, field, rays):
        rendering = load("renderer", "idr").render(field, rays)
        return replace(rendering, closest=rendering.closest.detach())

    def silhouette_loss(self, field, rays, rendering, mask):
        raise AssertionError("another loss was chosen")


@each("loss", ["hinge", "cross_entropy"])
def test_closest_values_without_the_claimed_gradient_are_an_error(loss):
    with pytest.raises(BrokenContract, match="its closest field values carry no gradient towards the field's param"):
        of_sphere(Detached(), load("silhouette", loss), [True] * 4 + [False])
