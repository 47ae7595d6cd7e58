"""The distance network with colours: its start, its values, its gradients in float64, and where its colours lead."""

import pytest
import torch
from torch import Tensor, nn

from renderers.field import Field, Meter, autograd_gradients
from renderers.fields.coloured import CHUNK, ColouredDistance, encoded

EXACT = {"rtol": 1e-10, "atol": 1e-12}


def make(*, directional: bool = True, width: int = 64, octaves: int = 3) -> ColouredDistance:
    torch.manual_seed(0)
    return ColouredDistance(layers=3, width=width, octaves=octaves, radius=0.5, directional=directional).double()


def draw(*shape: int) -> Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.mark.parametrize(("layers", "width"), [(2, 256), (4, 256), (6, 512)])
def test_it_begins_as_a_sphere(layers, width):
    torch.manual_seed(0)
    network = ColouredDistance(layers=layers, width=width, octaves=5, radius=0.5, directional=True)
    points = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    assert isinstance(network.field, Field)
    inside, on, outside = (network.field(radius * points).detach() for radius in (0.25, 0.5, 1.0))
    assert on.mean().item() == pytest.approx(0.0, abs=0.01) and on.std() < 0.06
    assert inside.mean() < -0.15 and outside.mean().item() == pytest.approx(0.5, abs=0.1)
    assert autograd_gradients(network.field, 0.5 * points).norm(dim=-1).mean().item() == pytest.approx(1.0, abs=0.3)


def test_the_encoding_has_sine_and_cosine_of_each_octave():
    point = torch.tensor([0.1, -0.2, 0.3])
    assert encoded(point, 0).tolist() == point.tolist()
    torch.testing.assert_close(
        encoded(point, 2), torch.cat([point, point.sin(), point.cos(), (2 * point).sin(), (2 * point).cos()])
    )


def test_values_without_a_graph_are_the_same_in_chunks_and_of_any_leading_shape():
    network, points = make(), draw(3, CHUNK)
    with torch.no_grad():
        values = network.field(points)
    torch.testing.assert_close(values, network.field(points).detach(), **EXACT)
    torch.testing.assert_close(values[1], network.field(points[1]).detach(), **EXACT)
    assert values.shape == (3, CHUNK)


def test_its_gradients_are_those_of_differences():
    network, points = make(width=8), 0.4 * draw(3)
    points.requires_grad_(True)
    nn.init.normal_(network.hidden[0].weight, 0.0, 0.3)  # else softplus is a ReLU to the step of the differences

    def image(points: Tensor, weight: Tensor) -> Tensor:
        names = dict(network.named_parameters()) | {"hidden.0.weight": weight}

        def seen(points: Tensor) -> Tensor:
            normals = torch.autograd.grad(network.field(points).sum(), points, create_graph=True)[0]
            return network.colours(points, normals, directions)

        return torch.func.functional_call(_Call(network, seen), {f"network.{k}": v for k, v in names.items()}, points)

    directions = torch.nn.functional.normalize(draw(3), dim=-1)
    assert torch.autograd.gradcheck(image, (points, network.hidden[0].weight), eps=1e-7, atol=1e-4, rtol=1e-3)


class _Call(nn.Module):
    """A function of a network as a module, whose weights can be replaced."""

    def __init__(self, network: nn.Module, function) -> None:
        super().__init__()
        self.network, self.function = network, function

    def forward(self, points: Tensor) -> Tensor:
        return self.function(points)


@pytest.mark.parametrize("directional", [True, False])
def test_colours_follow_the_direction_where_they_may(directional):
    network, points = make(directional=directional), 0.3 * draw(20)
    normals = autograd_gradients(network.field, points)
    one, other = torch.nn.functional.normalize(draw(20), dim=-1), -torch.nn.functional.normalize(draw(20), dim=-1)
    found = [network.colours(points, normals, directions) for directions in (one, other)]
    assert all(bool(((colours > 0) & (colours < 1)).all()) for colours in found)
    assert torch.equal(*found) != directional


def test_colours_have_a_gradient_towards_the_weights_of_the_distance_through_points_normals_and_features():
    network, points = make(), (0.3 * draw(20)).requires_grad_(True)
    directions = torch.nn.functional.normalize(draw(20), dim=-1)
    (normals,) = torch.autograd.grad(network.field(points).sum(), points, create_graph=True)
    sizes = []
    for which in (
        (points, normals.detach()),
        (points.detach(), normals),
    ):
        (gradient,) = torch.autograd.grad(
            network.colours(*which, directions).sum(), network.hidden[0].weight, retain_graph=True
        )
        sizes.append(gradient.abs().sum().item())
    assert min(sizes) > 0 and sizes[0] != sizes[1]


def test_its_operations_are_counted():
    network, meter = make(width=16, octaves=1), None
    value = 2 * (9 * 16 + 2 * 16 * 16 + 16)
    assert (network.field.flops.value, network.field.flops.gradient) == (value, 2 * value)
    assert network.requires_grad_(False).field.flops.gradient == value
    meter = Meter(network.field)
    meter(draw(5))
    assert meter.counts.value == 5


@pytest.mark.parametrize(
    ("setting", "value", "remedy"),
    [("layers", 0, "4 suit"), ("width", 4, "128 suit"), ("octaves", -1, "5 follow"), ("radius", 0.0, "0.5 lies")],
)
def test_settings_that_cannot_be_are_refused(setting, value, remedy):
    good = {"layers": 2, "width": 16, "octaves": 2, "radius": 0.5, "directional": True}
    with pytest.raises(ValueError, match=f"{setting} must be .*{remedy}"):
        ColouredDistance(**good | {setting: value})
