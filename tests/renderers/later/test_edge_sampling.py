"""Pixels split at the outline: areas, depths and their derivatives against closed forms, with one ray per pixel."""

from dataclasses import replace
from math import pi

import pytest
import torch
from torch import Tensor

from bench.config import load
from bench.solve import pixel_area
from renderers.camera import Rays
from renderers.field import Kind, Meter
from renderers.fields.analytic import Shape, box, plane, sphere
from tests.looped import each
from tests.renderers.analytic_cases import sheet, vector
from tests.solve.test_pixel_area import CAMERA, RADIUS, true_area
from tests.tiny import camera_of

EDGES, BAND = load("renderer", "edge_sampling"), load("renderer", "relaxed_boundary")
SIDE, HALF = 24, 0.8
DRAW = torch.Generator().manual_seed(5)


def shifted_image(side: int = SIDE) -> Rays:
    """An image of rays along z whose pixels are shifted by a random fraction of a pixel."""
    shift = torch.rand(2, 1, generator=DRAW, dtype=torch.float64)
    return sheet(*(HALF * ((torch.arange(side, dtype=torch.float64) + shift) / side * 2 - 1)))


def random_rays(side: int = SIDE) -> Rays:
    """A random ray in each pixel of that image."""
    offset = torch.rand(2, side, side, generator=DRAW, dtype=torch.float64)
    rays = shifted_image(side)
    index = torch.stack(torch.meshgrid(*[torch.arange(side)] * 2, indexing="xy")).double()
    across, down = HALF * ((index + offset) / side * 2 - 1)
    return Rays(torch.stack([across, down, torch.full_like(across, -2.0)], -1), rays.directions)


def area_and_rate(renderer, rays: Rays, shape, parameter: float) -> Tensor:
    """The area that a shape covers, and its derivative with respect to the parameter."""
    leaf = torch.tensor(parameter, dtype=torch.float64, requires_grad=True)
    opacity = renderer.render(shape(leaf), rays).opacity.sum()
    (rate,) = torch.autograd.grad(opacity, leaf)
    return (2 * HALF) ** 2 / rays.shape.numel() * torch.stack([opacity.detach(), rate])


def turned_box(grown: float | Tensor) -> Shape:
    """A box without a face along or across the rays, whose half sides are 0.3, 0.4, 0.25 and `grown` more."""
    return box((0.3 + grown, 0.4 + grown, 0.25 + grown)).rotate(TURN)


TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)).Q
TURN = TURN * torch.linalg.det(TURN)
SHARES = TURN[2].abs()  # of the rays' direction along the axes of the box
BOX_SIDES = vector((0.3, 0.4, 0.25))
BOX_AREA = 4 * sum(SHARES[k] * BOX_SIDES[k - 1] * BOX_SIDES[k - 2] for k in range(3)).item()
BOX_RATE = 4 * sum(SHARES[k] * (BOX_SIDES[k - 1] + BOX_SIDES[k - 2]) for k in range(3)).item()
SHAPES = [(sphere, 0.5, pi / 4, pi), (turned_box, 0.0, BOX_AREA, BOX_RATE)]


@each("shape, parameter, area, rate", SHAPES)
def test_with_a_ray_per_pixel_the_area_and_its_derivative_are_those_of_the_shape(shape, parameter, area, rate):
    """Also of sharp edges. Random rays through a band have no bias either, but five times the noise or more."""
    drawn = torch.stack([area_and_rate(EDGES, shifted_image(), shape, parameter) for _ in range(12)])
    assert (drawn[:, 0] / area - 1).abs().max() < 0.01
    assert drawn[:, 1].mean().item() == pytest.approx(rate, rel=0.04)
    noise = drawn[:, 1].std()
    assert noise < 0.05 * rate
    band = torch.stack([area_and_rate(BAND, random_rays(), shape, parameter) for _ in range(12)])
    assert band[:, 1].std() > 5 * noise


def test_an_image_of_a_camera_has_the_derivative_of_its_covered_pixels():
    radius = torch.tensor(RADIUS, requires_grad=True)
    opacity = EDGES.render(sphere(radius), CAMERA.rays()).opacity.sum()
    expected = (true_area(RADIUS + 1e-3) - true_area(RADIUS - 1e-3)) / 2e-3
    assert opacity.item() == pytest.approx(true_area(RADIUS), rel=0.01)
    assert torch.autograd.grad(opacity, radius)[0].item() == pytest.approx(expected, rel=0.1)


def derivatives_of_area(renderer, count: int, draws: int = 8) -> Tensor:
    """The area of a sphere over the true one, and its derivative over the true one, by draws of random rays."""
    truth = (true_area(RADIUS + 1e-3) - true_area(RADIUS - 1e-3)) / 2e-3
    radius, results = torch.tensor(RADIUS, requires_grad=True), []
    for draw in range(draws):
        rays = pixel_area.random_rays(CAMERA, count, draw, 0)
        opacity = renderer.render(sphere(radius), rays).opacity.sum() / count
        (rate,) = torch.autograd.grad(opacity, radius)
        results.append(torch.stack([opacity.detach() / true_area(RADIUS), rate / truth]))
    return torch.stack(results)


@each("count, error", [(4, 0.03), (16, 0.01)])
def test_several_rays_per_pixel_split_their_cells(count, error):
    """Wherever a ray is in its cell, with less than a fifth of the noise of a band."""
    edges = derivatives_of_area(EDGES, count)
    assert (edges[:, 0] - 1).abs().max() < 0.005
    assert edges[:, 1].mean().item() == pytest.approx(1, rel=error)
    assert derivatives_of_area(BAND, count)[:, 1].std() > 5 * edges[:, 1].std() > 0


def test_views_in_a_batch_are_split_as_alone():
    cameras = [CAMERA, camera_of(24, angles=(40.0, 10.0))]
    batch = pixel_area.random_rays_of(cameras, 4, 0, 0)
    field = sphere(RADIUS) | sphere(0.2).translate((0.4, 0.3, 0.3))
    alone = [EDGES.render(field, pixel_area.random_rays(camera, 4, k, 0)) for k, camera in enumerate(cameras)]
    together = EDGES.render(field, batch)
    assert torch.equal(together.hit, torch.stack([one.hit for one in alone]))
    opacity = torch.stack([one.opacity for one in alone])
    torch.testing.assert_close(together.opacity, opacity, rtol=0, atol=1e-5)
    assert int(((opacity > 0.01) & (opacity < 0.99)).sum()) > 50


@each("count", [2, 16])
def test_cells_of_other_rays_are_refused(count):
    rays = CAMERA.rays(torch.zeros(24, 24, count, 2))
    with pytest.raises(ValueError, match="leave cells out"):
        replace(rays, cells=CAMERA.resized(48, 48).rays())


@each(
    "change, hint", [({"image": True}, "no image"), ({"cells": CAMERA.double().resized(48, 48).rays()}, "one camera")]
)
def test_cells_of_another_kind_are_refused(change, hint):
    rays = pixel_area.random_rays(CAMERA, 4, 0, 0)
    with pytest.raises(ValueError, match=hint):
        replace(rays, **change)


def test_the_surface_behind_an_outline_has_the_rest_of_a_split_pixel():
    """A sphere in front of a wall: the sum of the depths, and its derivative, in closed form."""
    leaf = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    wall = 0.5
    field = Shape(lambda p: torch.minimum(sphere(leaf)(p), plane((0.0, 0.0, -1.0), -wall)(p)), Kind.DISTANCE, 1.0)
    axis = 0.6 * ((torch.arange(40, dtype=torch.float64) + 0.37) / 20 - 1)
    rendering = EDGES.render(field, sheet(axis, axis))
    depths = rendering.volume.weighted_sum(2 + wall - rendering.volume.distance, 1600).sum() * 0.03**2
    torch.testing.assert_close(rendering.opacity, torch.ones(40, 40, dtype=torch.float64))
    assert depths.item() == pytest.approx(pi * 0.09 * wall + 2 / 3 * pi * 0.027, rel=0.01)
    rates = [
        torch.autograd.grad(value, leaf, retain_graph=True)[0].item() for value in (depths, rendering.opacity.sum())
    ]
    assert rates[0] == pytest.approx(2 * pi * 0.3 * wall + 2 * pi * 0.09, rel=0.05)
    assert rates[1] == pytest.approx(0, abs=1e-9)


@each("kind, factor", [(Kind.BOUND, 0.7), (Kind.DISTANCE, 1.0)])
def test_a_bound_splits_pixels_as_its_distance_does(kind, factor):
    rays = shifted_image()
    expected = EDGES.render(sphere(0.5), rays).opacity
    scaled = EDGES.render(Shape(lambda p: factor * sphere(0.5)(p), kind, 1.0), rays).opacity
    torch.testing.assert_close(scaled, expected, atol=1e-3, rtol=0)
    assert ((expected > 0.05) & (expected < 0.45)).sum() > 10 < ((expected > 0.55) & (expected < 0.95)).sum()


def test_rays_that_move_with_the_shape_see_the_same_and_others_its_motion():
    rays = shifted_image()
    origins = rays.origins.clone().requires_grad_(True)
    offset = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    opacity = EDGES.render(sphere(0.5).translate(offset), Rays(origins, rays.directions, image=True)).opacity
    weights = rays.origins[..., 0]
    by_rays, by_shape = torch.autograd.grad((weights * opacity).sum(), (origins, offset))
    torch.testing.assert_close(by_rays.sum((0, 1))[:2], -by_shape[:2], atol=1e-6, rtol=1e-6)
    scale = (SIDE / 2 / HALF) ** 2
    assert by_shape[0].item() == pytest.approx(
        pi * 0.25 * scale, rel=0.06
    )  # the first moment of the area moves with it


def test_rays_that_are_no_image_have_the_derivative_of_a_near_miss_over_the_width():
    leaf = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    rays = Rays(vector((0.304, 0, -2, 0.5, 0, -2)).view(2, 3), vector((0, 0, 1)).expand(2, 3))
    rendering = EDGES.render(sphere(leaf), rays)
    assert rendering.opacity.tolist() == [0, 0]
    (rate,) = torch.autograd.grad(rendering.opacity.sum(), leaf)
    assert rate.item() == pytest.approx(1 / EDGES.width, rel=1e-6)
    flat = Shape(lambda p: 0.7 * sphere(leaf)(p), Kind.BOUND, 0.7)  # its band is 1 / 0.7 times as wide
    (scaled,) = torch.autograd.grad(EDGES.render(flat, rays).opacity.sum(), leaf)
    assert scaled.item() == pytest.approx(0.7 / EDGES.width, rel=1e-3)
    (wider,) = torch.autograd.grad(EDGES.with_blur(0.02).render(sphere(leaf), rays).opacity.sum(), leaf)
    assert wider.item() == pytest.approx(1 / 0.02, rel=1e-6)


def test_edge_points_cost_a_third_of_the_march_or_less():
    counts = {}
    for name, renderer in {"edges": EDGES, "band": BAND}.items():
        leaf = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
        meter = Meter(sphere(leaf))
        renderer.render(meter, shifted_image()).opacity.sum().backward()
        counts[name] = meter.counts.cost
    assert counts["band"] < counts["edges"] < 1.33 * counts["band"]


def test_an_image_of_a_single_row_has_no_pixels_to_split():
    rays = shifted_image()
    row = Rays(rays.origins[:1], rays.directions[:1], image=True)
    flat = replace(row, image=False)
    torch.testing.assert_close(EDGES.render(sphere(0.7), row).opacity, EDGES.render(sphere(0.7), flat).opacity)
