"""Coarse values of a decoder: its hidden layers in bfloat16, where the processor multiplies such numbers faster.

The points and the last layer stay in float32: coordinates need more than bfloat16's 8 bits, and so does a sum that
cancels near the surface.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import linear
from torch.utils.weak import WeakTensorKeyDictionary

from renderers.field import Coarse, Values, points_in_ball

NARROWEST = 256  # neurons a layer: below it, converting features takes what the products save
CHUNK = 2048  # points per pass, as in `mlp`
DRAWN = 2**14  # points in the unit sphere, those near the surface among which are compared
NEAR = 0.05  # largest magnitude of such a point's coarse value: elsewhere no error decides anything
FEWEST = 100  # such points: where there are fewer, all are compared
MARGIN = 2.0  # times the largest error there: between these points, and at other codes, it may be larger

Layer = tuple[Tensor, Tensor]  # weight [out, in] and bias [out]
_errors = WeakTensorKeyDictionary()  # by a network's last weight, which all its codes share: its version, and the error


def coarse_values(hidden: tuple[Layer, ...], last: Layer, skip: int, exact: Values) -> Coarse | None:
    """The coarse values of a network at one code, whose hidden layers are `hidden`; None where they do not pay.

    Args:
        hidden, last, skip: as in `mlp.BoundDecoder`; none needs a gradient.
        exact: the network's values. They are asked once for each state of the last layer, which a network at all its
            codes shares.
    """
    width = max(len(bias) for _, bias in hidden)
    if width < NARROWEST or last[0].dtype != torch.float32 or not multiplies_faster(last[0].device):
        return None
    network = _Network.of(hidden, last, skip)
    known = _errors.get(last[0])
    if known is None or known[0] != last[0]._version:
        known = _errors[last[0]] = last[0]._version, MARGIN * _largest_error(network, exact, last[0])
    return Coarse(network, known[1])


def multiplies_faster(device: torch.device) -> bool:
    """Whether a device multiplies bfloat16 matrices by instructions of its own."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    able = torch.cpu.get_capabilities()
    return device.type == "cpu" and any(able.get(name, False) for name in ("amx_bf16", "avx512_bf16"))


@dataclass(frozen=True)
class _Network:
    """The network; each hidden layer is a function of features and points.

    Args:
        first, last: weight and bias in float32.
        layers: from the second hidden layer on.
    """

    first: Layer
    layers: tuple[Callable[[Tensor, Tensor], Tensor], ...]
    last: Layer

    @staticmethod
    def of(hidden: tuple[Layer, ...], last: Layer, skip: int) -> "_Network":
        layers = [_again(*layer) if at == skip else _plain(*layer) for at, layer in enumerate(hidden[1:], start=1)]
        return _Network(hidden[0], tuple(layers), last)

    def __call__(self, points: Tensor) -> Tensor:
        values = [self._values(some) for some in points.reshape(-1, 3).split(CHUNK)]
        return torch.cat(values).view(points.shape[:-1])

    def _values(self, points: Tensor) -> Tensor:
        features = linear(points, *self.first).relu_().bfloat16()
        for layer in self.layers:
            features = layer(features, points)
        return linear(features.float(), *self.last).squeeze(-1)


def _plain(weight: Tensor, bias: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """A hidden layer of features alone."""
    product = _product(weight, bias, "relu")
    return lambda features, points: product(features)


def _again(weight: Tensor, bias: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """The hidden layer that takes the points again, by the last three columns of its weight."""
    product, of_points = _product(weight[:, :-3], None, "none"), weight[:, -3:]
    return lambda features, points: (product(features) + linear(points, of_points, bias)).relu_().bfloat16()


def _product(weight: Tensor, bias: Tensor | None, activation: str) -> Callable[[Tensor], Tensor]:
    """The layer's features, from those before it, in bfloat16; `activation` is "relu" or "none".

    On a CPU the weight is packed once for oneDNN, by names that are private to torch; where these are missing, or fail,
    `linear` does the same more slowly.
    """
    weight, bias = weight.bfloat16().contiguous(), None if bias is None else bias.bfloat16()
    if weight.device.type == "cpu":
        try:
            packed = torch.ops.mkldnn._reorder_linear_weight(weight, CHUNK)
            multiply = torch.ops.mkldnn._linear_pointwise

            def product(features: Tensor) -> Tensor:
                return multiply(features, packed, bias, activation, [], "")

            product(weight.new_zeros(1, weight.shape[1]))
            return product
        except (AttributeError, RuntimeError, TypeError):
            pass
    if activation == "none":
        return lambda features: linear(features, weight, bias)
    return lambda features: linear(features, weight, bias).relu_()


def _largest_error(network: _Network, exact: Values, like: Tensor) -> float:
    """The largest error of the network's values near its surface, at points that are the same each time."""
    points = points_in_ball(DRAWN).to(like)
    values = network(points)
    near = values.abs() <= NEAR
    near = near | (near.sum() < FEWEST)
    return float((values[near] - exact(points[near])).abs().max())
