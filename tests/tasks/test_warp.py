"""Projection and sampling between cameras: round trips, and images whose values are known."""

import pytest
import torch

from bench.tasks.photographs import sample
from tests.tiny import camera_of

CAMERA, OTHER = camera_of(12, angles=(20.0, 10.0)), camera_of(9, angles=(-15.0, 25.0))


def test_points_along_a_pixels_ray_are_seen_at_its_centre():
    distance = torch.linspace(1.0, 3.0, 144).view(12, 12)
    pixels, depth = CAMERA.project(CAMERA.rays().at(distance))
    rows, columns = torch.meshgrid(torch.arange(12) + 0.5, torch.arange(12) + 0.5, indexing="ij")
    assert torch.allclose(pixels, torch.stack([columns, rows], dim=-1), atol=1e-4)
    assert torch.allclose(depth, CAMERA.depth(distance), atol=1e-5)


def test_a_point_behind_has_a_depth_below_zero_and_finite_pixels():
    behind = CAMERA.center + (CAMERA.center - torch.zeros(3))
    pixels, depth = CAMERA.project(behind[None])
    assert depth.item() < 0
    assert pixels.isfinite().all()


def test_a_linear_image_is_sampled_exactly_and_nothing_outside_is_read():
    rows, columns = torch.meshgrid(torch.arange(6) + 0.5, torch.arange(8) + 0.5, indexing="ij")
    image = (2 * columns + 3 * rows + 1)[..., None]
    pixels = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([10.0, 8.0]) - 1
    colours, inside = sample(image, pixels)
    assert torch.equal(
        inside, (pixels[:, 0] >= 0.5) & (pixels[:, 0] <= 7.5) & (pixels[:, 1] >= 0.5) & (pixels[:, 1] <= 5.5)
    )
    expected = 2 * pixels[:, 0] + 3 * pixels[:, 1] + 1
    assert torch.allclose(colours[inside, 0], expected[inside], atol=1e-4)
    assert (colours[~inside] == 0).all()


def test_an_image_of_one_pixel_has_one_place():
    colours, inside = sample(torch.full((1, 1, 3), 0.7), torch.tensor([[0.5, 0.5], [0.6, 0.5]]))
    assert inside.tolist() == [True, False]
    assert colours[0].tolist() == pytest.approx([0.7] * 3)


def test_gradients_reach_the_pixels():
    image = torch.rand(5, 5, 2, generator=torch.Generator().manual_seed(1)).double()
    places = (0.7 + 3.5 * torch.rand(20, 2, generator=torch.Generator().manual_seed(2))).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: sample(image, p)[0], places)


def test_not_a_number_is_outside():
    colours, inside = sample(torch.ones(3, 3, 1), torch.tensor([[float("nan"), 1.0]]))
    assert not inside.any()
    assert colours.item() == 0
