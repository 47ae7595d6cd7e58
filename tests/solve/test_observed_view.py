"""The loss of the normals: its value against closed forms, its gradient against differences in float64."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from bench.config import load
from bench.solve.observed_view import ObservedView, normal_error, observed_hits
from bench.tasks.capacity.observations import concatenate_views
from datasets.scene import View
from renderers.field import central_differences, gradients_at
from renderers.fields.analytic import Shape, sphere
from renderers.fields.mlp import Decoder
from renderers.silhouette import Own
from tests.looped import each
from tests.tiny import CPU, camera_of

WEIGHTS = SimpleNamespace(depth_loss="depth", depth_weight=0.0, silhouette=Own(), silhouette_weight=0.0)
RENDERERS = {
    "idr": load("renderer", "idr", steps=300, epsilon=1e-11),
    "newton": load("renderer", "newton", warm=False, march_epsilon=1e-6),
}
CAMERA = camera_of(6, field_of_view=18.0).double()  # all rays hit, away from the outline, also after a step
WIDTH = 1e-4  # scene units: its square is about the error of the slopes
FACTORS, OFFSET = torch.tensor([0.7, 0.5, 0.6]).double(), torch.tensor([0.03, -0.02, 0.05]).double()


def ellipsoid(factors: Tensor, offset: Tensor) -> Shape:
    return sphere(1.0).stretch(factors).translate(offset)


def normals_of(points: Tensor, factors: Tensor, offset: Tensor) -> Tensor:
    return torch.nn.functional.normalize((points - offset) / factors**2, dim=-1)


def hits(factors: Tensor, offset: Tensor) -> Tensor:
    """The first hits of the rays of the camera on the ellipsoid, by the quadratic equation."""
    rays = CAMERA.rays()
    start, along = (rays.origins - offset) / factors, rays.directions / factors
    a, b, c = (along * along).sum(-1), (along * start).sum(-1), (start * start).sum(-1) - 1
    return rays.at((-b - (b * b - a * c).sqrt()) / a)


def observed_view(normals: Tensor, observed: Tensor, renderer: str = "idr", weight: float = 2.0) -> ObservedView:
    blank = torch.zeros(6, 6, dtype=torch.float64)
    view = View(CAMERA, blank, blank[..., None].expand(-1, -1, 3), torch.ones(6, 6, dtype=torch.bool))
    base = ObservedView.of(view, WEIGHTS, RENDERERS[renderer], observed=observed, mask=None, device=CPU)
    return replace(base, normals=normals, normal_weight=weight, normal_width=WIDTH)


ALL = torch.ones(6, 6, dtype=torch.bool)
SOME = torch.arange(36).view(6, 6) % 3 == 0
OTHER = normals_of(hits(FACTORS, OFFSET), FACTORS, OFFSET).roll(1, 0)  # the normals of the pixels above


@each("observed", [ALL, SOME])
def test_the_term_is_one_less_the_cosine_over_observed_pixels(observed):
    normals = normals_of(hits(FACTORS, OFFSET), FACTORS, OFFSET)
    expected = 2.0 * (1 - (normals * OTHER).sum(-1))[observed].mean()
    assert expected > 0.01
    terms = observed_view(OTHER, observed).compare(ellipsoid(FACTORS, OFFSET), 0)
    torch.testing.assert_close(terms["normals"], expected, rtol=1e-5, atol=0)
    exact = observed_view(normals, observed).compare(ellipsoid(FACTORS, OFFSET), 0)
    assert abs(exact["normals"].item()) < 1e-9
    shape, points = ellipsoid(FACTORS, OFFSET), hits(FACTORS, OFFSET).view(-1, 3)
    at_points = torch.nn.functional.normalize(gradients_at(shape, points).detach(), dim=-1)  # as in reconstruction
    same = normal_error(at_points, OTHER.view(-1, 3))
    torch.testing.assert_close(same, (1 - (normals * OTHER).sum(-1)).mean(), rtol=1e-9, atol=0)


def test_rays_without_a_hit_have_no_loss():
    far = torch.tensor([0.0, 3.0, 0.0]).double()
    leaves = FACTORS.clone().requires_grad_()
    terms = observed_view(OTHER, ALL).compare(ellipsoid(leaves, far), 0)
    assert terms["normals"].item() == 0
    half = torch.tensor([-0.72, 0.0, 0.0]).double()  # some of the rays hit it
    points = hits(FACTORS, half)
    hit = points.isfinite().all(-1)
    assert 6 <= int(hit.sum()) <= 30
    expected = 2.0 * (1 - (normals_of(points, FACTORS, half) * OTHER).sum(-1))[hit].mean()
    loss = observed_view(OTHER, ALL).compare(ellipsoid(FACTORS, half), 0)["normals"]
    torch.testing.assert_close(loss, expected, rtol=1e-5, atol=0)


@each("renderer", RENDERERS)
def test_the_gradient_agrees_with_differences(renderer):
    """The gradient depends on the field gradient at a point and on the point, which moves along its ray."""
    view = observed_view(OTHER, SOME, renderer)

    def loss(numbers: Tensor) -> Tensor:
        return view.compare(ellipsoid(numbers[:3], numbers[3:]), 0)["normals"]

    start = torch.cat([FACTORS, OFFSET]).requires_grad_()
    (gradient,) = torch.autograd.grad(loss(start), start)
    step = 1e-5
    shifts = step * torch.eye(6, dtype=torch.float64)
    with torch.no_grad():
        ends = [[loss(start + sign * shift) for sign in (1, -1)] for shift in shifts]
    expected = torch.stack([(up - down) / (2 * step) for up, down in ends])
    assert expected.abs().min() > 1e-3
    torch.testing.assert_close(gradient, expected, rtol=1e-4 if renderer == "newton" else 1e-6, atol=1e-8)


def test_slopes_over_a_width_have_a_gradient_to_the_code_and_slopes_at_a_point_have_none():
    """The gradient of a ReLU network is piecewise constant."""
    torch.manual_seed(0)
    decoder = Decoder(layers=3, width=64, code_length=8, skip=1, narrow=False).double()
    code = torch.zeros(8, dtype=torch.float64, requires_grad=True)
    points, given_normals = 0.3 * torch.randn(40, 3).double(), torch.nn.functional.normalize(torch.randn(40, 3), dim=1)

    def error(slopes: Tensor) -> Tensor:
        return normal_error(torch.nn.functional.normalize(slopes, dim=-1), given_normals.double())

    (at_a_point,) = torch.autograd.grad(error(gradients_at(decoder.at(code), points)), code)
    (over_a_width,) = torch.autograd.grad(error(central_differences(decoder.at(code), points, 0.05)), code)
    assert not at_a_point.any() and over_a_width.norm() > 1e-4


def test_views_without_normals_have_no_normal_loss_and_selections_keep_normals():
    view = observed_view(OTHER, ALL)
    flat = concatenate_views([view])
    subset = flat.select(torch.tensor([0, 7]))
    assert torch.equal(subset.normals, OTHER.flatten(0, 1)[[0, 7]])
    assert set(subset.compare(ellipsoid(FACTORS, OFFSET), 0)) == {"depth", "normals"}
    plain = ObservedView(WEIGHTS, RENDERERS["idr"], CAMERA.rays(), view.depth, view.depth_per_distance, ALL, None)
    assert set(plain.compare(ellipsoid(FACTORS, OFFSET), 0)) == {"depth"}
    assert concatenate_views([plain]).normals is None


def test_the_depth_of_drawn_rays_has_the_weight_that_it_has_among_all():
    """The mean over many draws, most of which have no observed ray, is the error of all observed rays."""
    generator = torch.Generator().manual_seed(0)
    observed, error = torch.zeros(400, dtype=torch.bool), torch.rand(400, generator=generator)
    observed[:12] = True
    hit = torch.ones_like(observed)
    whole = (error * (hit & observed)).sum() / observed_hits(hit, observed)
    draws = [torch.randperm(400, generator=generator)[:25] for _ in range(4000)]
    parts = [
        (error[rays] * (hit & observed)[rays]).sum() / observed_hits(hit[rays], observed[rays], 12 * 25 / 400)
        for rays in draws
    ]
    assert sum(part == 0 for part in parts) > 0.4 * len(parts)
    assert torch.stack(parts).mean().item() == pytest.approx(whole.item(), rel=0.1)
    assert observed_hits(hit & False, observed) == 1 == observed_hits(hit & False, observed, 0.5)
