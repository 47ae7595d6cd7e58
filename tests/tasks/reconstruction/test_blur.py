"""Moved points: the noise has the stated deviation, falls to nothing, and leaves each ray a field without noise."""

from dataclasses import replace

import pytest
import torch

from bench.config import load
from bench.tasks.reconstruction.blur import PointBlur
from bench.tasks.reconstruction.pixels import Pixels
from renderers.camera import Rays
from renderers.field import Kind
from renderers.fields.analytic import Shape, sphere
from renderers.schedule import Iteration
from tests.looped import each

BLUR = PointBlur(0.1, 0.5)
COUNT = 4000


def pixels_of(count: int = COUNT) -> Pixels:
    """Equal rays towards the origin."""
    rays = Rays(torch.tensor([0.0, 0.0, -2.0]).expand(count, 3), torch.tensor([0.0, 0.0, 1.0]).expand(count, 3))
    return Pixels(rays, torch.zeros(count, 3), torch.ones(count), None, None, None, None)


def test_the_deviation_falls_linearly_over_the_share_of_the_iterations_or_of_the_budget():
    assert [BLUR.deviation(iteration, 40) for iteration in (0, 10, 20, 39)] == pytest.approx([0.1, 0.05, 0, 0])
    assert BLUR.deviation(Iteration(200, 10), 40) == pytest.approx(0.05)  # of a loop that a budget ends


def test_points_move_by_noise_of_the_deviation_which_differs_between_iterations_and_seeds():
    pixels = pixels_of()
    moves = [
        BLUR.apply(pixels, *draw).rays.origins - pixels.rays.origins for draw in ((10, 40, 0), (11, 40, 0), (10, 40, 1))
    ]
    assert moves[0].std(0).tolist() == pytest.approx([0.05] * 3, rel=0.05)
    assert moves[0].mean(0).abs().max() < 0.003
    assert moves[0].T.corrcoef().fill_diagonal_(0).abs().max() < 0.06
    assert not torch.equal(moves[0], moves[2]) and (moves[0] / moves[1] - 1 / 0.9).abs().min() > 0
    assert torch.equal(BLUR.apply(pixels, 10, 40, 0).rays.directions, pixels.rays.directions)


@each("blur, iteration", [(PointBlur(), 0), (BLUR, 20), (BLUR, 39)])
def test_without_noise_the_pixels_stay_the_same(blur, iteration):
    pixels = pixels_of(4)
    assert blur.apply(pixels, iteration, 40, 0) is pixels


def test_the_noise_draws_from_no_generator_of_the_run():
    state = torch.get_rng_state()
    BLUR.apply(pixels_of(4), 0, 40, 0)
    assert torch.equal(torch.get_rng_state(), state)


@each("name", ["newton", "idr", "dist", "dvr", "naive", "neus"])
def test_each_ray_hits_the_surface_that_its_points_see(name):
    """The distance to a sphere along each moved ray, in closed form: a renderer sees no noise along a ray."""
    moved = BLUR.apply(pixels_of(100), 0, 40, 0).rays
    rendering = load("renderer", name).render(sphere(0.6), moved)
    across = moved.origins[:, :2].square().sum(-1)
    depth = (0.36 - across).clamp_min(0).sqrt()
    clear = depth > 0.3
    assert clear.sum() > 80 and rendering.hit[clear].all()
    expected = -moved.origins[:, 2] - depth
    torch.testing.assert_close(rendering.distance[clear], expected[clear], atol=5e-3, rtol=0)


@each("name, hits", [("idr", 0.2), ("newton", 0.8)])
def test_with_a_draw_per_point_a_march_would_lose_hits(name, hits):
    torch.manual_seed(0)
    field = Shape(lambda points: sphere(0.6)(points + 0.02 * torch.randn_like(points)), Kind.DISTANCE, 1.0)
    assert load("renderer", name).render(field, pixels_of(200).rays).hit.float().mean() < hits


def test_wrong_settings_are_named():
    with pytest.raises(ValueError, match=r"task\.blur_points must be at least 0"):
        PointBlur(-0.1)
    with pytest.raises(ValueError, match=r"task\.blur_share must be above 0"):
        replace(BLUR, share=0.0)
