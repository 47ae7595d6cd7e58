"""Several rays per pixel: where they lie, what is observed of a pixel, and the gradient of the covered area."""

from dataclasses import replace
from math import pi, sqrt
from types import SimpleNamespace

import pytest
import torch
import trimesh

from bench.config import load
from bench.solve.observed_view import ObservedView
from bench.solve.pixel_area import mean_depth, observation_of, random_rays
from bench.solve.pixel_draw import PixelDraw
from datasets.mesh import Mesh
from datasets.scene import Truth, see_area
from renderers.fields.analytic import sphere
from renderers.rendering import RayObservation, Unsupported
from renderers.silhouette import Area
from tests.looped import each
from tests.tiny import CPU, camera_of, icosphere, scene_of

RADIUS = 0.5
CAMERA = camera_of(24, field_of_view=40.0)
DISTANCE = float(CAMERA.center.norm())


def true_area(radius: float) -> float:
    """The area of a sphere's outline in pixels, for a camera that looks at its centre."""
    focal = CAMERA.intrinsics[0, 0].item()
    return pi * (focal * radius / sqrt(DISTANCE**2 - radius**2)) ** 2


@each("count", [4, 16])
def test_a_ray_lies_in_each_square_of_each_pixel_and_moves_with_the_iteration(count):
    rays, side = random_rays(CAMERA, count, 3, 0), round(sqrt(count))
    pixels, _ = CAMERA.project(rays.at(torch.ones(rays.shape)))
    rows, columns = torch.meshgrid(torch.arange(24), torch.arange(24), indexing="ij")
    corner = torch.stack([columns, rows], dim=-1)[:, :, None]
    cells = ((pixels - corner) * side).clamp(0, side - 1e-4).floor().long()
    assert float((pixels - corner).min()) > -1e-3 and float((pixels - corner).max()) < 1 + 1e-3
    assert ((cells[..., 0] * side + cells[..., 1]).sort(-1).values == torch.arange(count)).float().mean() > 0.999
    assert torch.equal(rays.directions, random_rays(CAMERA, count, 3, 0).directions)
    assert not torch.equal(rays.directions, random_rays(CAMERA, count, 3, 1).directions)


def test_true_fractions_sum_to_the_area_of_a_sphere_and_depths_are_of_the_covered_part():
    ball = trimesh.creation.icosphere(5, RADIUS)
    covered, depth = see_area(Truth(Mesh(ball.vertices, ball.faces)), CAMERA)
    assert float(covered.sum()) == pytest.approx(true_area(RADIUS), rel=0.01)
    assert ((covered > 0) & (covered < 1)).any()
    assert (depth[covered > 0] > DISTANCE - RADIUS - 1e-3).all() and (depth[covered > 0] < DISTANCE).all()
    assert (depth[covered == 0] == 0).all()


def test_a_mask_of_single_rays_changes_as_few_rays_as_the_fraction_allows():
    rays = random_rays(CAMERA, 16, 0, 0)
    rendering = load("renderer", "dist").render(sphere(RADIUS), rays)
    share = rendering.hit.float().mean(-1)
    right = observation_of(share, torch.zeros(24, 24), rendering)
    assert torch.equal(right.mask, rendering.hit)
    more = observation_of((share + 2 / 16).clamp_max(1), torch.zeros(24, 24), rendering).mask
    assert (more | ~rendering.hit).all()  # no hit is taken away
    added = more & ~rendering.hit
    left = ~more
    nearest = torch.where(added, rendering.closest, -torch.inf).amax(-1)
    assert (nearest <= torch.where(left, rendering.closest, torch.inf).amin(-1)).all()


def test_surplus_hits_are_taken_from_all_parts_of_a_pixel():
    rays = random_rays(CAMERA, 16, 0, 0)
    rendering = load("renderer", "dist").render(sphere(RADIUS), rays)
    torch.manual_seed(0)
    fewer = (rendering.hit.float().mean(-1) - 4 / 16).clamp_min(0)
    mask = observation_of(fewer, torch.zeros(24, 24), rendering).mask
    assert torch.equal(mask.sum(-1), (fewer * 16).round().long())
    assert not bool((mask & ~rendering.hit).any())
    taken = (rendering.hit & ~mask).view(24, 24, 4, 4).sum((0, 1))  # of the columns, then the rows of a pixel
    assert taken.sum(0).float().std() < 0.2 * taken.sum(0).float().mean()
    assert taken.sum(1).float().std() < 0.2 * taken.sum(1).float().mean()


@each("name", ["relaxed_boundary", "neus"])
def test_the_gradient_of_the_area_is_that_of_the_outline_with_16_rays(name):
    renderer = load("renderer", name).with_blur(0.02)
    radius = torch.tensor(RADIUS, requires_grad=True)
    slopes = []
    for iteration in range(4):
        rays = random_rays(CAMERA, 16, 0, iteration)
        opacity = renderer.render(sphere(radius), rays).opacity.mean(-1)
        slopes.append(torch.autograd.grad(opacity.sum(), radius)[0])
    expected = (true_area(RADIUS + 1e-3) - true_area(RADIUS - 1e-3)) / 2e-3
    assert float(torch.stack(slopes).mean()) == pytest.approx(expected, rel=0.1)


def test_with_a_ray_per_pixel_the_band_is_mostly_missed_and_the_area_has_no_gradient():
    radius = torch.tensor(RADIUS, requires_grad=True)
    opacity = load("renderer", "relaxed_boundary").render(sphere(radius), CAMERA.rays()).opacity
    expected = (true_area(RADIUS + 1e-3) - true_area(RADIUS - 1e-3)) / 2e-3
    assert abs(torch.autograd.grad(opacity.sum(), radius)[0].item()) < 0.1 * expected


def test_the_area_loss_falls_to_zero_at_the_true_fraction_and_needs_an_opacity():
    rays = random_rays(CAMERA, 4, 0, 0)
    rendering = load("renderer", "relaxed_boundary").render(sphere(RADIUS), rays)
    covered = rendering.hit.float().mean(-1)
    observed = RayObservation(rendering.hit, None, covered)
    loss = Area(2.0)(load("renderer", "relaxed_boundary"), sphere(RADIUS), rays, rendering, observed)
    assert float(loss) == pytest.approx(0, abs=1e-12)
    wrong = RayObservation(rendering.hit, None, covered + 0.5)
    assert float(
        Area(2.0)(load("renderer", "relaxed_boundary"), sphere(RADIUS), rays, rendering, wrong)
    ) == pytest.approx(0.5)
    dist = load("renderer", "dist")
    with pytest.raises(Unsupported, match="DIST has no opacity"):
        Area(1.0)(dist, sphere(RADIUS), rays, dist.render(sphere(RADIUS), rays), observed)


def test_a_pixels_depth_is_the_mean_of_its_hits():
    rays = random_rays(CAMERA, 4, 0, 0)
    rendering = load("renderer", "dist").render(sphere(RADIUS), rays)
    depth, hit = mean_depth(rendering, CAMERA.cosine(rays))
    pixel = (rendering.hit.sum(-1) == 3).nonzero()[0]
    expected = CAMERA.project(rendering.points[tuple(pixel)])[1][rendering.hit[tuple(pixel)]].mean()
    assert float(depth[tuple(pixel)]) == pytest.approx(float(expected), rel=1e-5)
    assert torch.equal(hit, rendering.hit.any(-1))


@each("silhouette", ["area", "hinge", "own"])
def test_a_view_of_several_rays_compares_areas_and_has_no_loss_at_the_truth(silhouette):
    loss = load("silhouette", silhouette)
    scene = replace(scene_of(icosphere(RADIUS), CAMERA), rays_per_pixel=16)
    settings = SimpleNamespace(depth_loss="depth", depth_weight=1.0, silhouette=loss, silhouette_weight=1.0)
    name = "relaxed_boundary"
    view = ObservedView.of(
        scene.view, settings, load("renderer", name), observed=scene.view.mask, mask=scene.view.mask, device=CPU
    ).with_area(scene, CAMERA, 0)
    assert torch.equal(view.covered, see_area(scene.raycaster, CAMERA)[0])
    draw = PixelDraw(scene.view.mask, 2, 0)
    compared = {}
    for radius in (RADIUS, 0.8 * RADIUS):
        field = sphere(torch.tensor(radius, requires_grad=True))
        compared[radius] = view.compare_drawn(draw, field, 1)
        assert compared[radius]["silhouette"].isfinite()
    true, wrong = compared[RADIUS], compared[0.8 * RADIUS]
    assert true["depth"].item() < 0.1 * wrong["depth"].item()
    assert true["silhouette"].item() < 0.3 * wrong["silhouette"].item()


def test_fractions_are_an_option_of_one_and_of_several_rays():
    scene = scene_of(icosphere(RADIUS), CAMERA)
    settings = SimpleNamespace(depth_loss="depth", depth_weight=1.0, silhouette=None, silhouette_weight=0.0)
    base = ObservedView.of(
        scene.view, settings, load("renderer", "dist"), observed=scene.view.mask, mask=scene.view.mask, device=CPU
    )
    assert base.with_area(scene, CAMERA, 0) is base
    assert base.with_area(scene, CAMERA, 0, fractions=True).rays.shape == (24, 24, 1)
    several = base.with_area(replace(scene, rays_per_pixel=4), CAMERA, 0, fractions=False)
    assert several.rays.shape == (24, 24, 4) and torch.equal(several.covered, scene.view.mask.float())
