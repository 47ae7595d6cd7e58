"""The DeepSDF decoder: a network of points and a shape code, bound to one code before rendering.

Its coarse values have the hidden layers in bfloat16, where the processor multiplies such numbers faster. The points and
the last layer stay in float32: coordinates need more than bfloat16's 8 bits, and so does a sum that cancels near the
surface.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear
from torch.utils.weak import WeakTensorKeyDictionary

from renderers.checks import check_at_least
from renderers.field import Coarse, Flops, Kind, PointFunction, points_in_sphere
from renderers.fields.affine import segment_bounds
from renderers.kernels.decoder import CompiledDecoder, compiled

CACHED = 2**20  # bytes of a layer's features per pass and thread of a CPU: caches hold those of two layers
AT_ONCE = 2**27  # of the same on a GPU, where each pass is a row of launches
FEWEST_AT_ONCE = 256  # points per pass
PACKED_FOR = 1024  # points for which oneDNN packs weights
NARROWEST = 256  # neurons a layer: below it, converting features takes what the products save
DRAWN = 2**14  # points in the unit sphere, those near the surface among which are compared
NEAR = 0.05  # largest magnitude of such a point's coarse value: elsewhere no error decides anything
FEWEST = 100  # such points: where there are fewer, all are compared
MARGIN = 2.0  # times the largest error there: between these points, and at other codes, it may be larger

Layer = tuple[Tensor, Tensor]  # weight [out, in] and bias [out]
_errors = WeakTensorKeyDictionary()  # by a network's last weight, which all its codes share: its version, and the error


class Decoder(nn.Module):
    """Fully connected ReLU layers of points and a code, with one skip that feeds both in again.

    Source: DeepSDF (Park et al. 2019), the network of DIST, B.1, with 8 hidden layers of 512, code length 256, skip 4.
    Deviates: no weight normalisation, no dropout, no final tanh.

    Args:
        layers: hidden layers, at least 1.
        width: neurons per hidden layer.
        code_length: numbers in a shape's code; 0 for a network of one shape.
        skip: index of the hidden layer whose input also takes the code and the point; 0 for no skip.
        narrow: make the layer before the skip narrower, so that its output and the second input have `width` together,
            as DeepSDF does. False keeps its width.
        outputs: numbers per point; more than one is read by `BoundDecoder.outputs`.
    """

    def __init__(self, *, layers: int, width: int, code_length: int, skip: int, narrow: bool, outputs: int = 1) -> None:
        super().__init__()
        check_at_least("layers", layers, 1, "DeepSDF has 8")
        check_at_least("width", width, 1, "DeepSDF has 512")
        check_at_least("code_length", code_length, 0, "DeepSDF has 256")
        if not 0 <= skip < layers:
            raise ValueError(f"skip must lie between 0 (none) and layers - 1 = {layers - 1}, not {skip}")
        again = code_length + 3
        if skip and narrow and width <= again:
            raise ValueError(
                f"width must exceed code_length + 3 = {again} for a narrowed skip, not {width}: set narrow=false"
            )
        self.code_length, self.skip, self.width, self.placed = code_length, skip, width, False
        self.kind: Kind = Kind.DISTANCE
        self.lipschitz: float | None = None
        inputs, sizes = [again] + [width] * (layers - 1), [width] * layers
        if skip and narrow:
            sizes[skip - 1] -= again
        elif skip:
            inputs[skip] += again
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(inputs, sizes, strict=True))
        self.last = nn.Linear(width, outputs)

    def at(self, code: Float[Tensor, "*shapes code_length"]) -> "BoundDecoder":
        """The field of one code, or of a batch of codes.

        The code's part of every affine layer is a constant for all points, so it is folded into the biases here, once.
        """
        if code.shape[-1] != self.code_length:
            raise ValueError(f"code must end in {self.code_length} numbers, not {code.shape[-1]}")
        layers = []
        for index, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            weight, bias = layer.weight, layer.bias
            takes_code = index == 0 or (index == self.skip and self.skip > 0)
            if takes_code and self.code_length:
                # Columns: what comes from the layer before, then the code, then the point.
                before = weight.shape[1] - self.code_length - 3
                bias = bias + code @ weight[:, before : before + self.code_length].T
                weight = torch.cat([weight[:, :before], weight[:, -3:]], dim=1)
            layers.append((weight, bias))
        return BoundDecoder(tuple(layers), (self.last.weight, self.last.bias), self.skip, self.kind, self.lipschitz)

    @staticmethod
    def of(layers: Sequence[Layer], *, code_length: int, skip: int) -> "Decoder":
        """The decoder with these weights and biases, of which the last is the output's; widths may differ.

        Without a code, its code is the place of the shape: three numbers by which it is moved.
        """
        *hidden, last = layers
        made = Decoder(layers=len(hidden), width=1, code_length=code_length or 3, skip=skip, narrow=False)
        made.width, made.placed = max(len(bias) for _, bias in hidden), code_length == 0
        for index, (weight, bias) in enumerate(hidden):
            if not code_length and index in (0, skip):
                weight = torch.cat([weight[:, :-3], -weight[:, -3:], weight[:, -3:]], dim=1)
            made.hidden[index] = _linear(weight, bias)
        made.last = _linear(*last)
        return made


def _linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], len(weight), dtype=weight.dtype)
    layer.weight, layer.bias = nn.Parameter(weight.clone()), nn.Parameter(bias.clone())
    return layer


@dataclass(frozen=True)
class BoundDecoder:
    """A decoder at one code: a Field that approximates a distance, with no known Lipschitz bound."""

    hidden: tuple[Layer, ...]
    last: Layer
    skip: int
    kind: Kind = Kind.DISTANCE
    lipschitz: float | None = None

    @property
    def flops(self) -> Flops:
        """A multiplication and an addition per weight; as much again towards points and code, twice towards weights."""
        value = 2 * sum(weight.numel() for weight, _ in (*self.hidden, self.last))
        return Flops(value, value if self._frozen else 2 * value)

    @property
    def _frozen(self) -> bool:
        tensors = (*(weight for weight, _ in self.hidden), *self.last)
        return not any(tensor.requires_grad for tensor in tensors)

    @cached_property
    def coarse(self) -> Coarse | None:
        """Values by hidden layers in bfloat16, for one code and weights that stay; None where they do not pay."""
        if not self._frozen or self.hidden[0][1].dim() > 1:
            return None
        with torch.no_grad():
            return coarse_values(self.hidden, self.last, self.skip, self)

    def bounds(
        self, middle: Float[Tensor, "n 3"], half: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Bounds of the values on segments, for one code; see `affine.segment_bounds`."""
        return segment_bounds(self.hidden, self.last, self.skip, middle, half)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The values; for a batch of codes [*shapes, code_length], of points [*shapes, n, 3]."""
        if self.hidden[0][1].dim() > 1:
            return self._forward(points)
        flat = points.reshape(-1, 3)
        wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (flat, *self._tensors))
        if wanted and self._frozen:
            values = _FrozenDecoder.apply(self, flat, *(bias for _, bias in self.hidden))
            assert isinstance(values, Tensor)
            return values.view(points.shape[:-1])
        forward = self._forward if wanted else self._quickest(flat)
        chunks = [forward(chunk) for chunk in passes(flat, self._width)]
        values = torch.cat(chunks) if len(chunks) != 1 else chunks[0]
        return values.view(points.shape[:-1])

    def outputs(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch outputs"]:
        """The numbers of a decoder with several per point, with a graph."""
        return self._forward(points)

    @cached_property
    def _width(self) -> int:
        return max(len(weight) for weight, _ in self.hidden)

    @cached_property
    def _tensors(self) -> tuple[Tensor, ...]:
        return tuple(tensor for layer in (*self.hidden, self.last) for tensor in layer)

    @cached_property
    def _copies(self) -> dict[int, CompiledDecoder | None]:
        return {}

    def _compiled(self) -> CompiledDecoder | None:
        """The compiled network, which has copies of the weights: made anew where these have changed meanwhile."""
        state = sum(0 if tensor.is_inference() else tensor._version for tensor in self._tensors)
        if state not in self._copies:
            self._copies.clear()
            self._copies[state] = compiled(self.hidden, self.last, self.skip)
        return self._copies[state]

    def _quickest(self, points: Tensor) -> PointFunction:
        """The values without a graph: by compiled code where there is some, which is that of one thread."""
        suits = points.dtype == torch.float32 and points.device.type == "cpu" and torch.get_num_threads() == 1
        network = self._compiled() if suits else None
        return self._forward if network is None else network.values

    def _forward(self, points: Tensor, gates: tuple[Tensor, ...] = ()) -> Tensor:
        """The values; fills `gates`, where given, with True where a ReLU is open."""
        features = points
        for index, (weight, bias) in enumerate(self.hidden):
            if index == self.skip and index:
                features = torch.cat([features, points], dim=-1)
            features = _affine(features, weight, bias).relu_()
            if gates:
                torch.gt(features, 0, out=gates[index])
        return _affine(features, *self.last).squeeze(-1)

    def _backward(self, gradient: Tensor, gates: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """From the gradient [n] of values to those of points [n, 3] and hidden biases [n, width]."""
        towards_points = torch.zeros_like(gradient)[:, None]
        towards_biases = []
        features = gradient[:, None] * self.last[0]
        for index in range(len(self.hidden) - 1, -1, -1):
            features = features.mul_(gates[index])
            towards_biases.insert(0, features)
            features = features @ self.hidden[index][0]
            if index == self.skip and index:
                features, again = features[:, :-3], features[:, -3:]
                towards_points = towards_points + again
        return towards_points + features, towards_biases


class _FrozenDecoder(torch.autograd.Function):
    """A decoder whose weights need no gradient, in less memory and time than a graph takes.

    The backward pass needs to know only which ReLUs were open: one byte per neuron. It works chunk by chunk, and only
    on the points whose value has a gradient other than zero.
    """

    @staticmethod
    def forward(ctx: Any, field: BoundDecoder, points: Tensor, *biases: Tensor) -> Tensor:
        ctx.field = field
        gates = [torch.empty(len(points), len(b), dtype=torch.bool, device=points.device) for b in biases]
        values = points.new_empty(len(points))
        size = points_at_once(field._width, points.dtype, points.device)
        for start in range(0, len(points), size):
            part = slice(start, start + size)
            values[part] = field._forward(points[part], tuple(gate[part] for gate in gates))
        ctx.save_for_backward(*gates)
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = gradients
        towards_points = gradient.new_zeros(len(gradient), 3)
        towards_biases = [gradient.new_zeros(gate.shape[1]) for gate in ctx.saved_tensors]
        size = points_at_once(ctx.field._width, gradient.dtype, gradient.device)
        for rows in gradient.nonzero().squeeze(-1).split(size):
            gates = [gate[rows] for gate in ctx.saved_tensors]
            some, biases = ctx.field._backward(gradient[rows], gates)
            towards_points.index_put_((rows,), some)
            for total, part in zip(towards_biases, biases, strict=True):
                total += part.sum(0)
        return None, towards_points, *towards_biases


def flops_of(network: nn.Module) -> Flops:
    """A multiplication and an addition per weight of matrices; as much again towards points, twice with weights."""
    value = 2 * sum(weight.numel() for weight in network.parameters() if weight.dim() > 1)
    trained = any(weight.requires_grad for weight in network.parameters())
    return Flops(value, 2 * value if trained else value)


def passes(
    points: Float[Tensor, "n 3"], width: int, dtype: torch.dtype | None = None
) -> Sequence[Float[Tensor, "some 3"]]:
    """The points in parts, of as many as `points_at_once` says; `dtype` of the features is that of the points."""
    if len(points) <= FEWEST_AT_ONCE:
        return (points,)
    return points.split(points_at_once(width, dtype or points.dtype, points.device))


def points_at_once(width: int, dtype: torch.dtype, device: torch.device) -> int:
    """Points per pass through a network whose layers have `width` neurons, in `dtype`: many, but within the caches.

    It changes sums by their rounding alone. Measured on CPUs: at 4 layers of 128, 65,536 points take 1.3 times as long
    each as 2,048, which these bytes are there; 256 take 1.1 times as long.
    """
    room = CACHED * torch.get_num_threads() if device.type == "cpu" else AT_ONCE
    return max(room // (width * dtype.itemsize), FEWEST_AT_ONCE)


def _affine(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    if bias.dim() == 1:
        return linear(features, weight, bias)
    return features @ weight.T + bias[..., None, :]


def coarse_values(hidden: tuple[Layer, ...], last: Layer, skip: int, exact: PointFunction) -> Coarse | None:
    """The coarse values of a network at one code, whose hidden layers are `hidden`; None where they do not pay.

    Args:
        hidden, last, skip: as in `BoundDecoder`; none needs a gradient.
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


@cache
def multiplies_faster(device: torch.device) -> bool:
    """Whether a device multiplies bfloat16 matrices by instructions of its own, and a CPU does so in less time."""
    if device.type != "cpu":
        return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    if hasattr(torch.cpu, "get_capabilities"):
        able = [torch.cpu.get_capabilities().get(name, False) for name in ("amx_bf16", "avx512_bf16")]
    else:  # PyTorch before 2.11
        able = [getattr(torch.cpu, f"_is_{name}_supported")() for name in ("amx_tile", "avx512_bf16")]
    return any(able) and _product_seconds(torch.bfloat16) < _product_seconds(torch.float32)


def _product_seconds(dtype: torch.dtype) -> float:
    """The least time of some products of matrices, of the size of a layer of the papers' networks."""
    features, weight, taken = torch.ones(2048, 512, dtype=dtype), torch.ones(512, 512, dtype=dtype), []
    for _ in range(5):
        started = time.perf_counter()
        linear(features, weight)
        taken.append(time.perf_counter() - started)
    return min(taken)


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
        values = [self._values(some) for some in passes(points.reshape(-1, 3), len(self.first[1]), torch.bfloat16)]
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
            packed = torch.ops.mkldnn._reorder_linear_weight(weight, PACKED_FOR)
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


def _largest_error(network: _Network, exact: PointFunction, like: Tensor) -> float:
    """The largest error of the network's values near its surface, at points that are the same each time."""
    points = points_in_sphere(DRAWN, like)
    values = network(points)
    near = values.abs() <= NEAR
    near = near | (near.sum() < FEWEST)
    return float((values[near] - exact(points[near])).abs().max())
