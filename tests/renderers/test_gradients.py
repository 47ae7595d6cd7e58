"""Gradients in float64: exact rules against closed forms and central differences, inexact ones for their bias."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.config import load
from renderers.camera import Rays
from renderers.fields.analytic import Shape, sphere
from renderers.gradients import attach_approximate_gradient
from renderers.rendering import Status
from tests.looped import each
from tests.renderers.analytic_cases import CASES, Case, ground, vector

NAIVE = load("renderer", "naive", steps=100, epsilon=1e-11, silhouette_average="all")
DIST_PLAIN = load("renderer", "dist", steps=300, epsilon=1e-11, alpha=1.0, extra_step_cap=None, coarse_to_fine=False)
by_case = each("case", CASES)


def render(renderer, case: Case, *, parameter: float | None = None, shift: Tensor | None = None):
    """The rendering of a case, with its parameter and the origins of its ray as leaves; `shift` [n, 3] moves them."""
    leaf = torch.tensor(case.parameter if parameter is None else parameter, dtype=torch.float64, requires_grad=True)
    rays = case.rays()
    origins = (rays.origins + (torch.zeros(3) if shift is None else shift)).requires_grad_(True)
    return renderer.render(case.shape(leaf), Rays(origins, rays.directions.expand_as(origins))), leaf, origins


def rates(renderer, case: Case) -> tuple[float, Tensor]:
    """The derivatives of the distance with respect to the parameter and the origin, by automatic differentiation."""
    rendering, parameter, origins = render(renderer, case)
    assert rendering.status.item() == Status.HIT
    assert rendering.distance.item() == pytest.approx(case.distance, abs=1e-9)
    by_parameter, by_origin = torch.autograd.grad(rendering.distance.sum(), (parameter, origins))
    return by_parameter.item(), by_origin[0]


@by_case
def test_naive_is_exact_towards_the_field_and_the_ray(case):
    by_parameter, by_origin = rates(NAIVE, case)
    assert by_parameter == pytest.approx(case.parameter_rate, rel=1e-7)
    torch.testing.assert_close(by_origin, case.origin_rate, rtol=1e-7, atol=1e-7)
    h = 1e-5
    with torch.no_grad():
        ahead, behind = (render(NAIVE, case, parameter=case.parameter + s)[0].distance.item() for s in (h, -h))
        assert by_parameter == pytest.approx((ahead - behind) / (2 * h), rel=1e-6)
        offsets = h * torch.eye(3, dtype=torch.float64)
        ahead, behind = render(NAIVE, case, shift=torch.cat([offsets, -offsets]))[0].distance.chunk(2)
        torch.testing.assert_close(by_origin, (ahead - behind) / (2 * h), rtol=0, atol=1e-5)


@each("steps", [1, 5])
@each("name", ["plane-oblique", "plane-grazing"])
def test_the_gradient_of_naive_is_low_by_the_stated_factor_with_few_steps(name, steps):
    case = next(case for case in CASES if case.name == name)
    rendering, parameter, _ = render(replace(NAIVE, steps=steps), case)
    (gradient,) = torch.autograd.grad(rendering.distance.sum(), parameter)
    assert rendering.status.item() == Status.OUT_OF_STEPS
    assert gradient.item() == pytest.approx(case.parameter_rate * (1 - (1 - case.cosine) ** steps))


@by_case
@each("alpha, samples", [(1.0, 1), (1.5, 1), (1.5, 3)])
def test_dist_is_biased_by_alpha_samples_and_cosine(case, alpha, samples):
    renderer = replace(DIST_PLAIN, alpha=alpha, n_gradient_samples=samples)
    by_parameter, by_origin = rates(renderer, case)
    bias = alpha * samples * case.cosine  # the kept samples lie so near the hit that their normals are equal
    assert by_parameter == pytest.approx(bias * case.parameter_rate, rel=1e-4)
    torch.testing.assert_close(by_origin, bias * case.origin_rate, rtol=1e-4, atol=1e-4)
    # The direction is right at each pixel.
    assert torch.cosine_similarity(by_origin, case.origin_rate, dim=0).item() == pytest.approx(1, abs=1e-6)


PASSING_RAY = Rays(vector((0.7, 0, -2))[None], vector((0, 0, 1))[None])  # passes a sphere of radius 0.5 by 0.2


@each("alpha", [1.0, 1.5])
def test_the_soft_silhouette_of_dist_moves_as_the_field_does_at_its_fixed_sample(alpha):
    center = vector((0, 0, 0)).requires_grad_(True)
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    shape, points = sphere(radius, center), []
    recording = Shape(lambda p: points.append(p.detach()) or shape(p))
    rendering = replace(DIST_PLAIN, alpha=alpha).render(recording, PASSING_RAY)
    assert rendering.status.item() == Status.MISS
    by_radius, by_center = torch.autograd.grad(rendering.closest.sum(), (radius, center))
    evaluated = torch.cat(points)
    sample = evaluated[shape(evaluated).abs().argmin()]
    assert rendering.closest.item() == pytest.approx(shape(sample).item())
    assert by_radius.item() == pytest.approx(-1)
    torch.testing.assert_close(
        by_center, -sample / sample.norm()
    )  # the derivative with respect to the centre is the negative normal


def test_the_soft_silhouette_of_naive_moves_with_its_sample():
    def closest(radius: Tensor) -> Tensor:
        return NAIVE.render(sphere(radius), PASSING_RAY).closest[0]

    radius, h = torch.tensor(0.5, dtype=torch.float64, requires_grad=True), 1e-6
    (gradient,) = torch.autograd.grad(closest(radius), radius)
    numeric = (closest(radius.detach() + h) - closest(radius.detach() - h)).item() / (2 * h)
    assert gradient.item() == pytest.approx(numeric, rel=1e-6)
    assert gradient.item() < -1  # a fixed sample would give -1


@each("renderer", [NAIVE, DIST_PLAIN, replace(DIST_PLAIN, coarse_to_fine=True)])
def test_the_closest_value_of_rays_that_miss_the_unit_sphere_moves_the_camera(renderer):
    # DIST, A.3: the distance from the origin to the ray, less the radius.
    origin = vector((1.5, 0.5, -2)).requires_grad_(True)
    rays = Rays(origin.expand(4, 4, 3), vector((0, 0, 1)).expand(4, 4, 3), image=True)
    rendering = renderer.render(sphere(0.5), rays)
    offset = (1.5**2 + 0.5**2) ** 0.5
    assert (rendering.status == Status.MISS).all()
    torch.testing.assert_close(rendering.closest, torch.full((4, 4), offset - 1, dtype=torch.float64))
    (gradient,) = torch.autograd.grad(rendering.closest[0, 0], origin)
    torch.testing.assert_close(gradient, vector((1.5, 0.5, 0)) / offset)


def test_the_approximate_rule_counts_the_samples_that_exist():
    # Three rays go down to the ground y = h. They have 2, 1 and no samples, and alpha is 1.5.
    offset = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    rays = Rays(vector((0, 2, 0)).expand(3, 3), vector((0, -1, 0)).expand(3, 3))
    sample_distance = vector((1.5, 1.0, 1.75, 9, 9, 9)).view(3, 2)
    values = vector((0.5, 1.0, 0.25, torch.inf, torch.inf, torch.inf)).view(3, 2)
    distance, closest = attach_approximate_gradient(
        ground(offset), rays, vector((1.9, 1.8, 1.7)), alpha=1.5, sample_distance=sample_distance, sample_value=values
    )
    assert distance.tolist() == [1.9, 1.8, 1.7] and closest.tolist() == [0.5, 0.25, 0]
    slopes = [torch.autograd.grad(ray_distance, offset, retain_graph=True)[0].item() for ray_distance in distance]
    assert slopes == [-3, -1.5, 0] and torch.autograd.grad(closest[0], offset)[0].item() == -1
