"""Poses of sampled cameras, against a worked example, and the pixels with observed depths."""

from dataclasses import replace
from math import atan2, cos, pi, radians, sin

import numpy as np
import pytest
import torch

from datasets.views import ViewSampler, observed_pixels, pixel_of_each_block
from tests.looped import each

VIEWS = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 360.0), elevation=(15.0, 35.0), resolution=33)

MASK = torch.zeros(400, dtype=torch.bool)  # 200 scattered pixels in an image of 400
MASK[torch.randperm(400, generator=torch.Generator().manual_seed(3))[:200]] = True
MASK = MASK.view(20, 20)


def project(camera, point):
    """Column and row of a world point, in pixels."""
    inside = camera.world_to_camera @ torch.tensor([*point, 1.0])
    pixel = camera.intrinsics @ inside[:3]
    return (pixel[:2] / pixel[2]).tolist()


@each("azimuth, elevation", [(90.0, 0.0), (0.0, 30.0), (200.0, -40.0), (355.0, 89.0)])
def test_angles_place_the_camera(azimuth, elevation):
    across, up = radians(azimuth), radians(elevation)
    eye = [2.5 * cos(up) * sin(across), 2.5 * sin(up), 2.5 * cos(up) * cos(across)]
    assert VIEWS.camera(azimuth, elevation).center.tolist() == pytest.approx(eye, abs=1e-5)


@each("seed", range(8))
def test_the_image_has_the_origin_in_its_middle_and_world_y_up(seed):
    camera = VIEWS.draw(seed)
    assert project(camera, (0, 0, 0)) == pytest.approx([16.5, 16.5], abs=1e-4)
    column, row = project(camera, (0, 0.5, 0))
    assert column == pytest.approx(16.5, abs=1e-4)
    assert row < 16.5 - 3  # rows grow downward
    middle = camera.rays().directions[16, 16]
    assert torch.allclose(middle, -camera.center / 2.5, atol=1e-5)


def test_the_whole_unit_sphere_is_in_the_image():
    rays = VIEWS.camera(37.0, 20.0).rays()
    least = torch.linalg.cross(rays.origins, rays.directions).norm(dim=-1)
    border = torch.cat([least[0], least[-1], least[:, 0], least[:, -1]])
    assert border.min() > 1.0


def test_draws_follow_the_seed_and_stay_in_range():
    def angles(camera):
        x, y, z = (camera.center / 2.5).double()
        return float(torch.rad2deg(torch.atan2(x, z)) % 360), float(torch.rad2deg(torch.asin(y)))

    assert torch.equal(VIEWS.draw(5).world_to_camera, VIEWS.draw(5).world_to_camera)
    narrow = replace(VIEWS, azimuth=(100.0, 140.0), elevation=(-20.0, 10.0))
    drawn = torch.tensor([angles(narrow.draw(seed)) for seed in range(200)])
    for values, low, high in ((drawn[:, 0], 100, 140), (drawn[:, 1], -20, 10)):
        assert low - 0.01 <= values.min() < low + 0.1 * (high - low)
        assert high + 0.01 >= values.max() > high - 0.1 * (high - low)
    assert len(drawn.unique(dim=0)) == 200


def test_the_view_of_a_shape_is_not_drawn_as_the_shape_is():
    # Shapes draw their parameters from the same seed. Equal draws would show all narrow shapes from one side.
    views = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), 8)
    turns = []
    for seed in range(40):
        x, _, z = views.draw(seed).center.tolist()
        turns.append((atan2(x, z) / (2 * pi)) % 1)
    shapes = [np.random.default_rng(seed).random() for seed in range(40)]
    assert abs(np.corrcoef(turns, shapes)[0, 1]) < 0.5


TILT = (0.0, cos(pi / 180), sin(pi / 180))  # straight above, but for a degree


@each("direction, expected", [
    *((direction, direction) for direction in ((0.3, -0.4, 0.5), (0.0, 0.0, -2.0), (-1.0, 0.2, 0.0))),
    ((0.0, 1.0, 0.0), TILT),
])  # fmt: skip
def test_the_camera_towards_a_direction_stands_in_it(direction, expected):
    camera = VIEWS.towards(torch.tensor(direction))
    assert camera.center.numpy() == pytest.approx(2.5 * np.array(expected) / np.linalg.norm(expected), abs=1e-5)
    assert project(camera, (0.0, 0.0, 0.0)) == pytest.approx([16.5, 16.5], abs=1e-4)


@each("points, count", [("dense", 200), ("2.5%", 5), ("0.01%", 1), (7, 7), (" 7 ", 7)])
def test_an_amount_gives_this_number_of_foreground_pixels(points, count):
    observed = observed_pixels(MASK, points, seed=0)
    assert observed.dtype == torch.bool and observed.sum() == count
    assert not (observed & ~MASK).any()


def test_draws_follow_the_seed_and_leave_other_draws_alone():
    before = torch.random.get_rng_state()
    first = observed_pixels(MASK, 50, seed=1)
    assert torch.equal(first, observed_pixels(MASK, 50, seed=1))
    assert not torch.equal(first, observed_pixels(MASK, 50, seed=2))
    assert torch.equal(before, torch.random.get_rng_state())


def test_every_pixel_of_the_foreground_can_be_drawn():
    times = torch.stack([observed_pixels(MASK, "20%", seed=seed) for seed in range(60)]).sum(0)[MASK]
    assert times.min() > 0
    assert times.max() < 30  # 12 on average


@each("height, width, side", [(8, 12, 4), (7, 5, 3), (4, 4, 1), (3, 2, 8)])
def test_each_block_of_an_image_gives_a_random_pixel(height, width, side):
    blocks = (torch.arange(height) // side)[:, None] * 100 + torch.arange(width) // side
    expected, seen = blocks.unique().tolist(), set()
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        pixels = pixel_of_each_block(height, width, side, generator)
        assert sorted(blocks.flatten()[pixels].tolist()) == expected
        seen |= {*pixels.tolist()}
    assert seen == {*range(height * width)}
