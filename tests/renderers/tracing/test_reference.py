"""The slow reference renderer against closed forms, in float64."""

import pytest

from renderers.camera import Rays
from renderers.field import estimate_lipschitz
from renderers.fields.analytic import Shape, box, plane, sphere
from renderers.rendering import Status
from renderers.tracing.reference import trace
from tests.looped import each
from tests.renderers.analytic_cases import CASES, along_z, sphere_hits, vector


def evaluate(field: Shape, rays: Rays, *, lipschitz: float = 1.0, least_step: float = 2e-4):
    return trace(field, rays, lipschitz=lipschitz, least_step=least_step, radius=1.0)


@each("case", CASES)
def test_closed_forms_to_the_last_digits(case):
    rendering = evaluate(case.field(), case.rays())
    assert rendering.status.item() == Status.HIT
    assert rendering.distance.item() == pytest.approx(case.distance, abs=1e-12)
    assert abs(rendering.residual.item()) < 1e-12


def test_grazing_rays_hit_or_miss_as_they_should():
    heights = (0.4999, 0.499999, 0.5000001, 0.501)
    rays = along_z(*heights)
    rendering = evaluate(sphere(0.5), rays, least_step=1e-5)
    distance, hit = sphere_hits(rays, 0.5)
    assert rendering.hit.tolist() == hit.tolist() == [True, True, False, False]
    assert rendering.distance[:2].tolist() == pytest.approx(distance[:2].tolist(), abs=1e-9)


def test_the_step_is_as_short_as_the_lipschitz_constant_requires():
    steep = Shape(lambda p: 4 * box((0.6, 0.6, 5e-3))(p), lipschitz=4.0)
    assert evaluate(steep, along_z(0.0), lipschitz=4.0).hit.all()
    assert not evaluate(steep, along_z(0.0), lipschitz=1.0).hit.any()  # steps of four times the distance


def test_every_ray_has_a_status():
    origins = vector((0, 0, -2, 0, 0.8, -2, 0, 3, -2, 0.1, 0, 0, 0, 0, 2)).view(5, 3)
    rendering = evaluate(sphere(0.5), Rays(origins, vector((0, 0, 1)).expand(5, 3)))
    assert rendering.status.tolist() == [Status.HIT, Status.MISS, Status.MISS, Status.STARTED_INSIDE, Status.MISS]
    assert rendering.distance.isfinite().all() and evaluate(sphere(0.5), along_z()).distance.shape == (0,)
    shaped = evaluate(sphere(0.5), Rays(origins[:4].view(2, 2, 3), vector((0, 0, 1)).expand(2, 2, 3)))
    assert shaped.status.shape == (2, 2)


def test_the_estimated_lipschitz_constant_is_the_longest_gradient_with_a_margin():
    assert estimate_lipschitz(sphere(0.5), radius=1.0) == pytest.approx(1.2)
    assert estimate_lipschitz(plane((0, 1, 0), 0.0), radius=1.0) == pytest.approx(1.2)
    bent = Shape(lambda p: p[..., 0] ** 2)  # 2 |x|, at most 2 in the sphere
    assert estimate_lipschitz(bent, radius=1.0) == pytest.approx(1.2 * 2, abs=0.06)
