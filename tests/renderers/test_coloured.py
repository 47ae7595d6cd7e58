"""Fields with colours: their start, their values, their gradients in float64, and where their colours lead."""

import pytest
import torch
from torch import Tensor

from renderers.field import Coloured, Field, Kind, Meter, autograd_gradients
from renderers.fields.networks import coloured
from renderers.fields.networks.coloured import (
    COLOUR_LOGIT_SCALE,
    LOGIT_WIDTH,
    ColouredDistance,
    ColouredEncoded,
    ColouredGrid,
    ColouredOccupancy,
    positional_encoding,
)
from renderers.fields.networks.encoded import FourierFeatures, HashGrid
from tests.looped import each

EXACT = {"rtol": 1e-10, "atol": 1e-12}


def make(*, directional: bool = True, width: int = 64, octaves: int = 3) -> ColouredDistance:
    torch.manual_seed(0)
    return ColouredDistance(layers=3, width=width, octaves=octaves, radius=0.5, directional=directional).double()


def draw(*shape: int) -> Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@each("layers, width", [(2, 256), (6, 512)])
def test_it_begins_as_a_sphere(layers, width):
    torch.manual_seed(0)
    network = ColouredDistance(layers=layers, width=width, octaves=5, radius=0.5, directional=True)
    points = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    assert isinstance(network.field, Field)
    inside, on, outside = (network.field(radius * points).detach() for radius in (0.25, 0.5, 1.0))
    assert on.mean().item() == pytest.approx(0.0, abs=0.01) and on.std() < 0.06
    assert inside.mean() < -0.15 and outside.mean().item() == pytest.approx(0.5, abs=0.1)
    assert autograd_gradients(network.field, 0.5 * points).norm(dim=-1).mean().item() == pytest.approx(1.0, abs=0.3)


@each(
    "encoding, layers",
    [(HashGrid(1e-4 * torch.ones(2, 64, 2), (4, 16), 1.05), 1), (FourierFeatures(draw(8).float()), 3)],
)
def test_an_encoded_field_begins_as_a_sphere_and_learns_what_it_should(encoding, layers):
    torch.manual_seed(0)
    shape = ColouredEncoded(encoding, layers=layers, width=64, radius=0.5, directional=True).field
    assert isinstance(shape, Coloured)
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    inside, on, outside = (shape(radius * directions).detach() for radius in (0.25, 0.5, 1.0))
    assert on.mean().item() == pytest.approx(0.0, abs=0.02) and on.std() < 0.12
    assert inside.mean() < -0.15 and outside.mean().item() == pytest.approx(0.5, abs=0.1)
    colours = shape.colours(0.5 * directions, directions, directions)
    (shape(0.5 * directions).sum() + colours.sum()).backward()
    learnt = {name: bool(parameter.grad.any()) for name, parameter in shape.named_parameters()}
    assert all(learnt.values()) and ("tables" in learnt) == isinstance(encoding, HashGrid)
    assert not torch.equal(colours, shape.colours(0.5 * directions, directions, -directions))


def test_the_encoding_has_sine_and_cosine_of_each_octave():
    point = torch.tensor([0.1, -0.2, 0.3])
    assert positional_encoding(point, 0).tolist() == point.tolist()
    torch.testing.assert_close(
        positional_encoding(point, 2),
        torch.cat([point, point.sin(), point.cos(), (2 * point).sin(), (2 * point).cos()]),
    )


def test_values_without_a_graph_are_the_same_in_chunks_and_of_any_leading_shape(monkeypatch):
    network, points = make(), draw(3, 20)
    monkeypatch.setattr(coloured, "split_into_passes", lambda some, width: some.split(7))
    with torch.no_grad():
        values = network.field(points)
    torch.testing.assert_close(values, network.field(points).detach(), **EXACT)
    torch.testing.assert_close(values[1], network.field(points[1]).detach(), **EXACT)
    assert values.shape == (3, 20)


@each("directional", [True, False])
def test_colours_follow_the_direction_where_they_may(directional):
    network, points = make(directional=directional), 0.3 * draw(20)
    normals = autograd_gradients(network.field, points)
    first, second = torch.nn.functional.normalize(draw(20), dim=-1), -torch.nn.functional.normalize(draw(20), dim=-1)
    seen = [network.colours(points, normals, directions) for directions in (first, second)]
    assert all(bool(((colours > 0) & (colours < 1)).all()) for colours in seen)
    assert torch.equal(*seen) != directional


def test_colours_lead_to_the_weights_of_the_distance_through_points_normals_and_features():
    network, points = make(), (0.3 * draw(20)).requires_grad_(True)
    directions = torch.nn.functional.normalize(draw(20), dim=-1)
    (normals,) = torch.autograd.grad(network.field(points).sum(), points, create_graph=True)
    sizes = []
    for which in (normals.detach(), normals):
        colours = network.colours(points, which, directions)
        (gradient,) = torch.autograd.grad(colours.sum(), network.hidden[0].weight, retain_graph=True)
        sizes.append(gradient.abs().sum().item())
    assert min(sizes) > 0 and sizes[0] != sizes[1]


def on_sphere(count: int = 500) -> Tensor:
    return torch.nn.functional.normalize(draw(count).float(), dim=-1)


@each("radius", [0.5, 0.8])
@each("width", [128, 255])
def test_an_occupancy_network_begins_as_a_sphere_and_is_negative_inside(width, radius):
    torch.manual_seed(0)
    field, points = ColouredOccupancy(width=width, radius=radius).field, on_sphere()
    assert isinstance(field, Coloured) and field.kind is Kind.LEVEL
    inside, on, outside = (field(share * radius * points).detach() for share in (0.5, 1.0, 1.5))
    assert on.mean().item() == pytest.approx(0.0, abs=0.2) and on.std() < 0.25 * radius / LOGIT_WIDTH
    assert (inside < 0).all() and (outside > 0).all()
    assert inside.mean().item() == pytest.approx(-0.5 * radius / LOGIT_WIDTH, rel=0.1)
    assert field(torch.zeros(3)).item() == pytest.approx(-radius / LOGIT_WIDTH, rel=1e-5)
    assert field(points.view(5, 100, 3)).shape == (5, 100)


def test_colours_of_occupancy_are_those_of_points_and_their_weights_have_a_gradient():
    torch.manual_seed(0)
    network = ColouredOccupancy(width=32, radius=0.5)
    points = 0.5 * on_sphere(20)
    first, second = (network.field.colours(points, inputs, inputs) for inputs in (points, -points))
    assert torch.equal(first, second) and first.shape == (20, 3)
    assert ((first > 0) & (first < 1)).all() and first.std(dim=0).min() > 0
    first.sum().backward()
    assert network.network.texture_head.weight.grad is not None
    assert network.network.texture_head.weight.grad.abs().sum() > 0
    assert network.network.occupancy_head.weight.grad is None
    meter = Meter(network.field)
    meter(points)
    assert meter.counts.value == 20 and network.field.flops.gradient == 2 * network.field.flops.value


def make_grid(samples: int = 9, reach: float = 1.0, radius: float = 0.5) -> ColouredGrid:
    return ColouredGrid(samples=samples, radius=radius, reach=reach)


def test_a_grid_begins_as_a_sphere_of_one_grey():
    grid, points = make_grid(49, 1.05), on_sphere()
    field = grid.field
    assert isinstance(field, Coloured) and field.kind is Kind.DISTANCE
    for radius in (0.3, 0.5, 1.0):
        assert field(radius * points).sub(radius - 0.5).abs().max() < 0.005
    assert torch.equal(field.colours(points, points, points), torch.full((500, 3), 0.5))


def test_a_grids_colours_are_interpolated_linearly_and_kept_outside():
    grid = make_grid()
    axis = torch.linspace(-1, 1, 9)
    x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
    with torch.no_grad():
        grid.logits.copy_(torch.stack([x, 2 * y - 0.3, 0.5 * z + x * y]) / COLOUR_LOGIT_SCALE)
    points = torch.rand(3, 7, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    colours = grid.field.colours(points, points, points)
    u, v, w = points.unbind(-1)
    torch.testing.assert_close(colours[..., 0], u.sigmoid(), rtol=0, atol=1e-5)
    torch.testing.assert_close(colours[..., 1], (2 * v - 0.3).sigmoid(), rtol=0, atol=1e-5)
    torch.testing.assert_close(colours[..., 2], (0.5 * w + u * v).sigmoid(), rtol=0, atol=1e-5)
    outside = grid.field.colours(torch.tensor([[3.0, 0.0, 0.0]]), points[0, :1], points[0, :1])
    assert outside[0, 0].item() == pytest.approx(torch.tensor(1.0).sigmoid().item(), abs=1e-6)
    (gradient,) = torch.autograd.grad(colours[..., 0].sum(), grid.logits)
    assert gradient[0].abs().sum() > 0 and not gradient[1:].any()
