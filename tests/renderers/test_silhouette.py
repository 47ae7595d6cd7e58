"""Silhouette losses: DIST's, Eq. 11, against values worked out by hand, and all of them with every renderer."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch

from bench.config import load
from bench.tables import names
from renderers.boundary import BrokenContract
from renderers.camera import Rays
from renderers.fields.analytic import sphere
from renderers.rendering import Capabilities, RayObservation, Renderer, at_iteration
from renderers.silhouette import AVERAGES, Hinge, SilhouetteLoss
from tests.looped import each

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


def test_a_background_ray_just_inside_is_pushed_out_with_its_sign_and_deeper_without():
    def slope(signed: bool) -> float:
        closest = torch.tensor([-0.04], dtype=torch.float64, requires_grad=True)
        loss(NONE[:1], signed=signed, closest=closest).backward()
        return closest.grad.item()

    assert slope(signed=True) == -1  # descent raises the field's value: out of the shape
    assert slope(signed=False) == 1  # descent lowers it: deeper


@each("average", AVERAGES)
def test_no_rays_cost_nothing(average):
    assert loss(ALL[:0], average=average, closest=CLOSEST[:0]).item() == 0


LOSSES = names("silhouette")
# Along z past a sphere of radius .5: through the middle, just inside of the edge, just outside, far outside, no sphere.
HEIGHTS = torch.tensor([0.0, 0.495, 0.505, 0.9, 1.2], dtype=torch.float64)


def of_sphere(renderer: Renderer, loss: SilhouetteLoss, mask: list[bool]) -> tuple[float, float]:
    """The loss of a sphere of radius .5, and its slope towards the radius."""
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
def test_the_loss_of_a_paper_is_that_of_its_renderer_to_the_last_digit(renderer, loss):
    mine, own, named = load("renderer", renderer), load("silhouette", "own"), load("silhouette", loss)
    for mask in ([True] * 4 + [False], [False] * 5, [True, False, True, False, False]):
        assert of_sphere(mine, named, mask) == of_sphere(mine, own, mask)


@each("loss", LOSSES)
@each("renderer", ["dist", "dvr_64", "idr", "naive", "newton"])
def test_every_loss_grows_a_sphere_that_is_too_small_and_shrinks_one_that_is_too_large(renderer, loss):
    mine, given = load("renderer", renderer), load("silhouette", loss)
    small, large = of_sphere(mine, given, [True] * 4 + [False]), of_sphere(mine, given, [False] * 5)
    assert small[0] > 0
    assert large[0] > 0
    assert small[1] < 0 < large[1]


@each("renderer", ["dist", "dvr_64", "idr", "naive", "newton"])
def test_under_one_loss_renderers_differ_by_what_they_see_alone(renderer):
    hinge, mask = load("silhouette", "hinge"), [True] * 4 + [False]
    expected = of_sphere(load("renderer", "idr", steps=500), hinge, mask)
    assert of_sphere(load("renderer", renderer), hinge, mask) == pytest.approx(expected, rel=0.05)


@each(
    "loss, values, message",
    [
        ("hinge", {"average": "some"}, "average must be one of all, violating, missed_plus_spurious, not 'some'"),
        ("cross_entropy", {"sharpness": -1.0}, "sharpness must be positive, not -1.0"),
        ("occupancy", {"weight": -1.0}, "weight must be at least 0, not -1.0"),
        ("occupancy", {"occupied_at": "hull"}, "occupied_at must be one of random, depth, not 'hull'"),
    ],
)
def test_what_cannot_be_is_told(loss, values, message):
    with pytest.raises(ValueError, match=message):
        load("silhouette", loss, **values)


def test_a_right_hit_costs_nothing_whatever_the_renderers_own_threshold():
    """A hit within a threshold of .05 has a value far above the loss's; a missed ray must weigh no less for it."""
    rough = load("renderer", "idr", epsilon=0.05)  # hits what is .005 outside as well
    assert of_sphere(rough, load("silhouette", "hinge"), [True] * 3 + [False] * 2)[0] == 0
    assert of_sphere(rough, load("silhouette", "hinge"), [True] * 2 + [False] * 3) == (5e-5, 1.0)


@each("name", ["neus", "volsdf", "unisurf"])
def test_every_hit_on_the_background_shrinks_the_shape_whatever_its_least_value(name):
    """The least value that a volume renderer knows may be in front of the surface: at a hit it would cost nothing."""
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    side = torch.linspace(-0.45, 0.45, 12, dtype=torch.float64)
    x, y = torch.meshgrid(side, side, indexing="xy")
    origins = torch.stack([x, y, torch.full_like(x, -2.0)], dim=-1)
    rays = Rays(origins, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(origins))
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
def test_a_renderer_whose_closest_values_lack_the_gradient_that_it_claims_is_told(loss):
    with pytest.raises(BrokenContract, match="its closest field values carry no gradient towards the field's param"):
        of_sphere(Detached(), load("silhouette", loss), [True] * 4 + [False])
