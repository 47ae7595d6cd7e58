"""The decoder with its code folded in, against the plain network on concatenated inputs, in float64."""

from itertools import product

import pytest
import torch
from torch import Tensor

from renderers.field import Flops
from renderers.fields import mlp
from renderers.fields.mlp import Decoder
from tests.looped import each
from tests.operations import Operations

NETWORKS = {
    "no-skip": {"layers": 3, "width": 8, "code_length": 4, "skip": 0, "narrow": False},
    "skip": {"layers": 4, "width": 8, "code_length": 4, "skip": 2, "narrow": False},
    "narrow": {"layers": 4, "width": 12, "code_length": 4, "skip": 2, "narrow": True},
    "skip-first": {"layers": 3, "width": 12, "code_length": 4, "skip": 1, "narrow": True},
    "skip-last": {"layers": 3, "width": 8, "code_length": 4, "skip": 2, "narrow": False},
    "one-layer": {"layers": 1, "width": 8, "code_length": 4, "skip": 0, "narrow": False},
    "no-code": {"layers": 3, "width": 8, "code_length": 0, "skip": 0, "narrow": False},
    "no-code-skip": {"layers": 3, "width": 8, "code_length": 0, "skip": 2, "narrow": True},
}


def make(name: str) -> Decoder:
    torch.manual_seed(0)
    return Decoder(**NETWORKS[name]).double()


def in_sevens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mlp, "MIN_POINTS_PER_PASS", 7)
    monkeypatch.setattr(mlp, "CACHE_BYTES_PER_THREAD", 0)


def plain(decoder: Decoder, code: Tensor, points: Tensor) -> Tensor:
    """The network of the paper: code and point, concatenated, are the input of the first layer and of the skip."""
    inputs = torch.cat([code.expand(*points.shape[:-1], -1), points], dim=-1)
    features = inputs
    for index, layer in enumerate(decoder.hidden):
        if index > 0 and index == decoder.skip:
            features = torch.cat([features, inputs], dim=-1)
        features = torch.relu(features @ layer.weight.T + layer.bias)
    return (features @ decoder.last.weight.T + decoder.last.bias)[..., 0]


def draw(decoder: Decoder, *shape: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    code = torch.randn(decoder.code_length, dtype=torch.float64, generator=generator, requires_grad=True)
    points = torch.randn(*shape, 3, dtype=torch.float64, generator=generator, requires_grad=True)
    return code, points


@each("name", NETWORKS)
@each("shape", [(5,), (), (0,), (2, 3)])
def test_values_and_gradients_with_a_folded_code_are_those_of_the_plain_network(name, shape):
    decoder = make(name)
    code, points = draw(decoder, *shape)
    wanted = (points, *decoder.parameters(), *([code] if decoder.code_length else []))
    folded, reference = decoder.at(code)(points), plain(decoder, code, points)
    torch.testing.assert_close(folded, reference, rtol=0, atol=1e-13)
    gradients, expected = (torch.autograd.grad(values.square().sum(), wanted) for values in (folded, reference))
    torch.testing.assert_close(gradients, expected, rtol=1e-11, atol=1e-12)
    assert shape == (0,) or all(gradient.abs().sum() > 0 for gradient in gradients)


@each("name", NETWORKS)
@each("batch", [(3,), (2, 3)])
def test_a_batch_of_codes_has_the_values_of_each_code(name, batch):
    decoder = make(name)
    codes = torch.randn(*batch, decoder.code_length, dtype=torch.float64)
    points = torch.randn(*batch, 5, 3, dtype=torch.float64)
    values = decoder.at(codes)(points)
    assert values.shape == (*batch, 5)
    for index in product(*map(range, batch)):
        torch.testing.assert_close(values[index], plain(decoder, codes[index], points[index]), rtol=0, atol=1e-13)


@pytest.mark.parametrize("count", [0, 7, 20])
def test_chunks_change_nothing_and_bound_a_pass(monkeypatch, count):
    decoder = make("skip")
    code, points = draw(decoder, count)
    unchunked = decoder.at(code)(points)
    sizes = []
    decoder_pass = mlp.BoundDecoder._forward
    monkeypatch.setattr(mlp.BoundDecoder, "_forward", lambda self, p: (sizes.append(len(p)), decoder_pass(self, p))[1])
    in_sevens(monkeypatch)
    chunked = decoder.at(code)(points)
    torch.testing.assert_close(chunked, unchunked, rtol=0, atol=1e-14)
    assert sum(sizes) == count and max(sizes) <= 7
    gradients = [torch.autograd.grad(values.square().sum(), (code, points)) for values in (unchunked, chunked)]
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=1e-13)


def test_a_pass_back_takes_the_memory_of_one_gradient_however_many_chunks_it_has(monkeypatch):
    decoder, points = make("skip").requires_grad_(False), torch.rand(700, 3, dtype=torch.float64, requires_grad=True)
    in_sevens(monkeypatch)
    values = decoder.at(torch.zeros(4, dtype=torch.float64))(points)
    with Operations() as counted:
        values.sum().backward()
    assert counted.made[700 * 3] <= 2  # and the gradient of the leaf


def test_flops_are_two_per_weight_without_the_code():
    # Layers 3 -> 8, 8 -> 8, (8 + 3) -> 8, 8 -> 8, 8 -> 1: 24 + 64 + 88 + 64 + 8 = 248 weights.
    assert make("skip").at(torch.zeros(4, dtype=torch.float64)).flops == Flops(496, 2 * 496)
    frozen = make("skip").requires_grad_(False).at(torch.zeros(4, dtype=torch.float64))
    assert frozen.flops == Flops(496, 496)
    # 3 -> 12, 12 -> 5 (narrowed by 4 + 3), 5 + 3 -> 12, 12 -> 12, 12 -> 1: 36 + 60 + 96 + 144 + 12 = 348.
    assert make("narrow").at(torch.zeros(4, dtype=torch.float64)).flops == Flops(696, 2 * 696)
    # 3 -> 8, 8 -> 5, (5 + 3) -> 8, 8 -> 1: 24 + 40 + 64 + 8 = 136.
    assert make("no-code-skip").at(torch.zeros(0, dtype=torch.float64)).flops == Flops(272, 2 * 272)


def pair(dtype: torch.dtype) -> tuple[Decoder, Decoder]:
    """A decoder with fixed weights, and the same decoder with trainable weights."""
    torch.manual_seed(3)
    frozen = Decoder(layers=4, width=24, code_length=5, skip=2, narrow=True).to(dtype)
    free = Decoder(layers=4, width=24, code_length=5, skip=2, narrow=True).to(dtype)
    free.load_state_dict(frozen.state_dict())
    return frozen.requires_grad_(False), free


def through(decoder: Decoder, upstream: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Values, and their gradients with respect to points and code."""
    generator = torch.Generator().manual_seed(4)
    points = torch.randn(len(upstream), 3, generator=generator).to(dtype).requires_grad_(True)
    code = torch.randn(5, generator=generator).to(dtype).requires_grad_(True)
    values = decoder.at(code)(points)
    return values.detach(), *torch.autograd.grad(values, (points, code), upstream)


@each("dtype, tolerance", [(torch.float32, 1e-5), (torch.float64, 1e-13)])
@each("scale", [1.0, 0.0])
def test_fixed_weights_change_nothing_but_the_cost(monkeypatch, dtype, tolerance, scale):
    in_sevens(monkeypatch)
    upstream = (
        scale * torch.linspace(-1, 2, 50, dtype=dtype) * (torch.arange(50) % 3 > 0)
    )  # a third of them is zero, or all
    for frozen, free in zip(*(through(decoder, upstream, dtype) for decoder in pair(dtype)), strict=True):
        torch.testing.assert_close(frozen, free, rtol=tolerance, atol=tolerance)


def test_a_network_of_fixed_weights_keeps_one_byte_per_neuron():
    kept_bytes = []
    for decoder in pair(torch.float32):
        size = [0]

        def count(tensor: Tensor, size=size) -> Tensor:
            size[0] += tensor.numel() * tensor.element_size()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
            decoder.at(torch.zeros(5, requires_grad=True))(torch.zeros(1000, 3))
        kept_bytes.append(size[0])
    neurons = 24 * 3 + 24 - 8
    assert kept_bytes[0] <= 1000 * neurons + 20_000  # and what the folding of the code keeps
    assert kept_bytes[1] > 3 * kept_bytes[0]


def test_the_slope_of_a_network_of_fixed_weights_has_a_gradient_of_zero():
    # The network is piecewise linear, so its slope is constant within a piece. A smoothness loss may need its gradient.
    decoder, _ = pair(torch.float64)
    code = torch.ones(5, dtype=torch.float64, requires_grad=True)
    points = torch.full((6, 3), 0.3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(decoder.at(code)(points).sum(), points, create_graph=True)
    assert slope.abs().sum() > 0
    loss = slope.square().sum() + code.square().sum()
    (gradient,) = torch.autograd.grad(loss, code)
    torch.testing.assert_close(gradient, 2 * code.detach())
