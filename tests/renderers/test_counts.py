"""Field evaluations of renderers on planes and spheres, against closed forms and counts by hand."""

from dataclasses import replace
from math import ceil, cos, log, radians, sin

import pytest
import torch

from bench.config import load
from datasets.views import ViewSampler
from renderers.camera import Rays, distance_to_origin
from renderers.field import Field, Meter
from renderers.fields.analytic import plane, sphere
from renderers.rendering import Renderer
from tests.looped import each
from tests.renderers.analytic_cases import sphere_hits, vector

EPSILON = 5e-5
GROUND = plane((0, 1, 0), 0.0)
PLAIN = load("renderer", "dist", alpha=1.0, extra_step_cap=None, coarse_to_fine=False)
FULL = {  # renderers that evaluate the field equally often on each ray that meets the unit sphere
    "naive": (load("renderer", "naive", steps=7), 7),
    "naive-practical": (load("renderer", "naive", steps=7, gradient="practical", n_gradient_samples=1), 7),
    "naive-serial": (load("renderer", "naive", steps=7, serial=True), 7),
    "dist-all-rays": (replace(PLAIN, active_only=False, steps=7), 7),
}


def forward(renderer: Renderer, field: Field, rays: Rays) -> int:
    """The field evaluations of a rendering without gradients."""
    meter = Meter(field)
    with torch.no_grad():
        renderer.render(meter, rays)
    assert meter.counts.gradient == 0
    return meter.counts.value


def down(degrees: float, count: int = 1) -> Rays:
    """Rays towards the origin, at an angle to the normal of the ground. They enter the unit sphere 1 before it."""
    direction = vector((sin(radians(degrees)), -cos(radians(degrees)), 0))
    return Rays((-2 * direction).expand(count, 3), direction.expand(count, 3))


def picture(size: int = 24) -> Rays:
    """The unit sphere and its surroundings, from 2.5 away."""
    camera = ViewSampler(2.5, 60.0, (0.0, 360.0), (15.0, 35.0), size).camera(30.0, 20.0).double()
    return camera.rays()


def plane_evaluations(degrees: float, alpha: float) -> int:
    """One more than the least k with cos |1 - alpha cos|^k < epsilon, for a ray 1 away (DIST, Eqs. 7 and 8)."""
    cosine = cos(radians(degrees))
    rate = abs(1 - alpha * cosine)
    return 1 + ceil((log(EPSILON) - log(cosine)) / log(rate)) if rate > 1e-12 else 2


@each("degrees", [5.0, 33.0, 60.0, 72.0])
@each("alpha", [1.0, 1.5, 1.9])
def test_evaluations_of_dist_on_a_plane_follow_equation_8(degrees, alpha):
    renderer = replace(PLAIN, alpha=alpha, steps=200)
    assert forward(renderer, GROUND, down(degrees, 3)) == 3 * plane_evaluations(degrees, alpha)
    if alpha == 1:
        assert forward(load("renderer", "idr"), GROUND, down(degrees, 3)) == 3 * plane_evaluations(degrees, 1.0)


@each("name", FULL)
def test_renderers_of_all_rays_evaluate_steps_times_the_rays_that_meet_the_sphere(name):
    renderer, steps = FULL[name]
    rays = picture(12)
    meets = int((distance_to_origin(rays) < 1).sum())
    assert 20 < meets < 144 and forward(renderer, sphere(0.5), rays) == steps * meets


@each("samples, refinement", [(2, 8), (16, 0), (33, 8)])
def test_dvr_evaluates_all_samples_of_all_rays_and_refines_each_hit(samples, refinement):
    renderer = load("renderer", "dvr", n_ray_samples=samples, refinement_steps=refinement)
    rays = picture()
    with torch.no_grad():
        hits = int(renderer.render(sphere(0.5), rays).hit.sum())
    meets = int((distance_to_origin(rays) < 1).sum())
    assert forward(renderer, sphere(0.5), rays) == samples * meets + refinement * hits
    if samples > 2:
        assert hits == pytest.approx(int(sphere_hits(rays, 0.5)[1].sum()), abs=8)


@each("samples, samples_to_surface", [(2, 2), (16, 9), (17, 10), (128, 65)])
def test_dvr_with_early_stop_evaluates_up_to_the_surface(samples, samples_to_surface):
    # The ground is half way through the sphere: the first sample beyond it is number floor((n - 1) / 2) + 1, from 0.
    renderer = load("renderer", "dvr", n_ray_samples=samples, early_stop=True)
    ray = down(20.0, 4)
    below = Meter(plane((0, 1, 0), -1e-9))  # a hair lower, so that the half way sample is free
    with torch.no_grad():
        renderer.render(below, ray)
    assert below.counts.value == 4 * (samples_to_surface + renderer.refinement_steps)
    missing_rays = Rays(vector((0, 2, -2)).expand(3, 3), vector((0, 0, 1)).expand(3, 3))
    assert forward(renderer, GROUND, missing_rays) == 0  # the rays miss the sphere
    above = Rays(vector((0, 0.5, -2)).expand(3, 3), vector((0, 0, 1)).expand(3, 3))
    assert forward(renderer, GROUND, above) == 3 * samples  # no surface stops the search


@each("name", ["dist", "idr", "dvr", "naive"])
def test_evaluations_of_the_gradient(name):
    """After the search each ray has one evaluation at its closest sample, and each hit those of the gradient rule."""
    settings = {"coarse_to_fine": False} if name == "dist" else {"steps": 9} if name == "naive" else {}
    renderer, rays = load("renderer", name, **settings), picture()
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    search = forward(renderer, sphere(0.5), rays)
    meter = Meter(sphere(radius))
    rendering = renderer.render(meter, rays)
    meets, hits = int((distance_to_origin(rays) < 1).sum()), int(rendering.hit.sum())
    before = meter.counts.gradient
    extra = {"dist": meets, "idr": meets + hits, "dvr": meets + hits, "naive": 0}[name]
    assert meter.counts.value == search + extra
    assert before == {"dist": 0, "idr": hits, "dvr": hits, "naive": 0}[name]  # the slope along the ray
    rendering.distance[rendering.hit].sum().backward()
    after = meter.counts.gradient - before
    assert after == hits if name != "naive" else hits < after <= 9 * hits
