"""The occupancy network against a plain computation in float64, and the logits of fields."""

from itertools import product
from math import log

import pytest
import torch
from torch import Tensor

from renderers.field import Flops, Kind, occupancy_logits
from renderers.fields.analytic import Shape, sphere
from renderers.fields.networks.occupancy import OccupancyField, OccupancyNetwork
from tests.looped import each

LEVEL = Shape(lambda p: p.square().sum(-1) - 0.25, Kind.LEVEL, None)
BOUND = Shape(lambda p: 0.5 * (p.norm(dim=-1) - 0.5), Kind.BOUND, 0.5)


def make(code_length: int = 4, width: int = 8) -> OccupancyNetwork:
    torch.manual_seed(0)
    return OccupancyNetwork(width=width, code_length=code_length).double()


def draw(code_length: int, *shape: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    code = torch.randn(code_length, dtype=torch.float64, generator=generator, requires_grad=True)
    return code, torch.randn(*shape, 3, dtype=torch.float64, generator=generator, requires_grad=True)


def plain(network: OccupancyNetwork, code: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Logits and colours without binding: each point has a copy of the code, and the layers are matrices."""
    weights = dict(network.named_parameters())
    codes = code.expand(*points.shape[:-1], -1)

    def affine(features: Tensor, name: str) -> Tensor:
        return features @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    features = affine(points, "first")
    for index in range(5):
        if network.code_length:
            features = features + codes @ weights[f"shifts.{index}.weight"].T
        inner = affine(features.clamp_min(0), f"blocks.{index}.inner")
        features = features + affine(inner.clamp_min(0), f"blocks.{index}.outer")
    features = features.clamp_min(0)
    return affine(features, "occupancy_head")[..., 0], 1 / (1 + torch.exp(-affine(features, "texture_head")))


def both(network: OccupancyNetwork, code: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    bound = network.at(code)
    return bound.logits(points), bound.colours(points)


@each("code_length", [0, 4])
@each("shape", [(5,), (), (0,), (2, 3)])
def test_a_bound_code_gives_values_and_gradients_of_the_unbound_network(code_length, shape):
    network, (code, points) = make(code_length), draw(code_length, *shape)
    outputs, expected = both(network, code, points), plain(network, code, points)
    assert (outputs[0].shape, outputs[1].shape) == (shape, (*shape, 3))
    torch.testing.assert_close(outputs, expected, rtol=0, atol=1e-13)
    for head, output, reference in zip(("occupancy", "texture"), outputs, expected, strict=True):
        weights = [p for name, p in network.named_parameters() if "head" not in name or head in name]
        wanted = (points, *weights, *([code] if code_length else []))
        gradients, truth = (torch.autograd.grad(x.square().sum(), wanted, retain_graph=True)
                            for x in (output, reference))  # fmt: skip
        torch.testing.assert_close(gradients, truth, rtol=1e-10, atol=1e-13)
        assert shape == (0,) or all(gradient.abs().sum() > 0 for gradient in gradients)


@each("batch", [(3,), (2, 3)])
@each("code_length", [0, 4])
def test_a_batch_of_codes_has_the_outputs_of_each_code(code_length, batch):
    network = make(code_length)
    codes = torch.randn(*batch, code_length, dtype=torch.float64)
    points = torch.randn(*batch, 5, 3, dtype=torch.float64)
    logits, colours = both(network, codes, points)
    assert (logits.shape, colours.shape) == ((*batch, 5), (*batch, 5, 3))
    for index in product(*map(range, batch)):
        expected = plain(network, codes[index], points[index])
        torch.testing.assert_close((logits[index], colours[index]), expected, rtol=0, atol=1e-13)


def test_flops_are_two_per_weight_without_the_code_and_twice_that_for_gradients():
    network = make()
    value = 2 * (3 * 8 + 10 * 8 * 8 + 8)
    assert network.at(torch.zeros(4, dtype=torch.float64)).flops == Flops(value, 2 * value)
    network.requires_grad_(False)
    assert network.at(torch.zeros(4, dtype=torch.float64)).flops == Flops(value, value)


def test_the_field_of_an_occupancy_is_negative_where_the_probability_exceeds_the_threshold():
    def logits(points: Tensor) -> Tensor:
        return torch.tensor([0.1, 0.3, 0.6], dtype=points.dtype).logit()

    low, half = OccupancyField(logits, 0.2), OccupancyField(logits, 0.5)
    points = torch.zeros(3, 3, dtype=torch.float64)
    assert (low(points) < 0).tolist() == [False, True, True]
    assert (half(points) < 0).tolist() == [False, False, True]
    # logit(0.2) = -log 4, logit(0.5) = 0; p = 0.6 is 3 to 2.
    assert low(points)[2].item() == pytest.approx(-log(4) - log(1.5))
    assert half(points)[2].item() == pytest.approx(-log(1.5))
    assert (low.kind, low.lipschitz, low.flops) == (Kind.LEVEL, None, None)


@each("field, factor", [(sphere(0.5), 4.0), (BOUND, 4.0), (LEVEL, 1.0)])
def test_logits_of_a_fields_values_are_positive_inside_and_scaled_by_the_width_of_a_length(field, factor):
    points = torch.tensor([[0.0, 0, 0], [0.25, 0, 0], [2, 0, 0]], dtype=torch.float64, requires_grad=True)
    values = field(points)
    logits = occupancy_logits(field, values, width=0.25)
    assert (logits > 0).tolist() == [True, True, False]
    torch.testing.assert_close(logits, -factor * values, rtol=0, atol=1e-14)
    (gradient,) = torch.autograd.grad(logits.sum(), values)
    assert gradient.tolist() == [-factor] * 3
