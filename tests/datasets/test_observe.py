"""Which pixels' depth is given."""

import pytest
import torch

from datasets.scene import View
from datasets.views import ViewSampler, observed_pixels
from tests.looped import each

FOREGROUND = 200


@pytest.fixture(scope="module")
def view() -> View:
    """A foreground of 200 scattered pixels in an image of 400."""
    sampler = ViewSampler(distance=2.5, field_of_view=50.0, azimuth=(0.0, 0.0), elevation=(0.0, 0.0), resolution=20)
    mask = torch.zeros(400, dtype=torch.bool)
    mask[torch.randperm(400, generator=torch.Generator().manual_seed(3))[:FOREGROUND]] = True
    mask = mask.view(20, 20)
    return View(sampler.camera(0.0, 0.0), mask.float(), torch.zeros(20, 20, 3), mask)


@each(
    "points, count",
    [
        ("dense", 200),
        ("100%", 200),
        ("10%", 20),
        ("2.5%", 5),
        ("0.01%", 1),
        ("100", 100),
        (7, 7),
        (" 7 ", 7),
        (200, 200),
    ],
)
def test_an_amount_gives_so_many_pixels_of_the_foreground(view, points, count):
    observed = observed_pixels(view.mask, points, seed=0)
    assert observed.shape == (20, 20)
    assert observed.dtype == torch.bool
    assert observed.sum() == count
    assert not (observed & ~view.mask).any()


def test_draws_follow_the_seed_and_leave_other_draws_alone(view):
    before = torch.random.get_rng_state()
    first = observed_pixels(view.mask, 50, seed=1)
    assert torch.equal(first, observed_pixels(view.mask, 50, seed=1))
    assert not torch.equal(first, observed_pixels(view.mask, 50, seed=2))
    assert torch.equal(before, torch.random.get_rng_state())


def test_every_pixel_of_the_foreground_can_be_drawn(view):
    times = torch.stack([observed_pixels(view.mask, "20%", seed=seed) for seed in range(60)]).sum(0)[view.mask]
    assert times.min() > 0
    assert times.max() < 30  # 12 on average


@each(
    "points, rule",
    [
        (0, "must be positive, not '0'"),
        ("0%", "must be positive, not '0%'"),
        (-5, "must be positive, not '-5'"),
        ("-5%", "must be positive, not '-5%'"),
        ("101%", "must be at most 100%, not '101%'"),
        ("abc", "must be an amount, not 'abc'"),
        ("", "must be an amount, not ''"),
        ("5.5", "must be an amount, not '5.5'"),
        ("Dense", "must be an amount, not 'Dense'"),
        ("nan%", "must be .*, not 'nan%'"),
    ],
)
def test_an_invalid_amount_is_an_error_with_a_remedy(view, points, rule):
    with pytest.raises(ValueError, match=f'points {rule}: write "dense", a share such as "10%", or a number'):
        observed_pixels(view.mask, points, seed=0)


def test_more_points_than_the_shape_has_pixels_are_refused(view):
    with pytest.raises(ValueError, match="at most the 200 pixels of the shape, not 201: give fewer"):
        observed_pixels(view.mask, 201, seed=0)
