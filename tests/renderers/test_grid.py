"""Trilinear fields and moved shapes, against shapes with closed-form distances."""

import math

import pytest
import torch

from renderers.camera import rigid
from renderers.field import Kind, Moved, autograd_gradients
from renderers.fields.analytic import box, sphere
from renderers.fields.grid import Grid
from tests.looped import each

REACH = 1.05


def grid_of(shape, samples: int) -> Grid:
    axis = torch.linspace(-REACH, REACH, samples)
    return Grid(shape(torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)), REACH)


def points(count: int, reach: float) -> torch.Tensor:
    return reach * (2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 1)


@each("samples", [17, 33])
def test_the_error_inside_falls_with_the_square_of_the_spacing(samples):
    near = points(2000, 0.9)
    near = near[(near.norm(dim=-1) - 0.6).abs() < 0.2]
    spacing = 2 * REACH / (samples - 1)
    worst = (grid_of(sphere(0.6), samples)(near) - sphere(0.6)(near)).abs().max()
    assert worst < 0.4 * spacing**2 / 0.4  # 3/8 of the square, times the curvature 1 / 0.4 at the innermost point


def test_linear_distances_are_exact():
    flat = grid_of(lambda p: p[..., 0] - 0.5 * p[..., 1] + 0.25 * p[..., 2] - 0.1, 5)
    inside = points(100, REACH)
    expected = inside @ torch.tensor([1.0, -0.5, 0.25]) - 0.1
    assert torch.allclose(flat(inside), expected, atol=1e-6)
    assert torch.allclose(autograd_gradients(flat, inside), torch.tensor([1.0, -0.5, 0.25]).expand(100, 3), atol=1e-5)


def test_the_field_outside_is_a_continuous_bound_of_the_distance():
    shape = box((0.4, 0.3, 0.2))
    field = grid_of(shape, 65)
    far = points(4000, 3.0)
    assert (field(far) <= shape(far) + REACH / 64).all()  # half a spacing
    assert (field(far)[far.abs().amax(-1) > REACH] > 0).all()
    edge = torch.tensor([[REACH, 0.1, -0.2]])
    assert field(edge * 1.0001).item() == pytest.approx(field(edge).item(), abs=1e-3)


SIMILARITY = torch.tensor([0.1, -0.2, 0.05, 0.3, 0.2, -0.4, math.log(1.25)])


def test_a_moved_shape_has_true_distances():
    moved = Moved(sphere(0.5, (0.2, 0.0, 0.0)), SIMILARITY.double())
    locations = points(200, 1.0).double()
    motion = rigid(SIMILARITY[:6].double())
    centre = 1.25 * motion[:3, :3] @ torch.tensor([0.2, 0.0, 0.0]).double() + motion[:3, 3]
    assert torch.allclose(moved(locations), (locations - centre).norm(dim=-1) - 0.625)
    assert moved.kind is Kind.DISTANCE


def test_gradients_flow_to_all_seven_numbers():
    free = SIMILARITY.double().requires_grad_()
    locations = points(50, 1.0).double()
    assert torch.autograd.gradcheck(lambda s: Moved(box((0.4, 0.3, 0.2)), s)(locations), free)
