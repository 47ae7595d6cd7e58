"""The DeepSDF decoder: a network of points and a shape code, bound to one code before rendering.

Coarse values have hidden layers in bfloat16, if the processor multiplies such matrices faster. The points and the last
layer stay in float32: coordinates, and sums that cancel near the surface, need more than the 8 bits of bfloat16.
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
from renderers.kernels.decoder import CompiledDecoder, compile_decoder

CACHE_BYTES_PER_THREAD = 2**20  # for the features of one layer on a CPU: caches hold those of two layers
GPU_BYTES_PER_PASS = 2**27  # for the features of one layer; larger than on a CPU, as every pass launches many kernels
MIN_POINTS_PER_PASS = 256
ONEDNN_PACKING_POINTS = 1024  # the batch size for which oneDNN packs weights
MIN_COARSE_WIDTH = 256  # neurons per layer: below it, converting features takes the time that the products save
# The coarse error is measured at points of the unit sphere with a small coarse value, since elsewhere it has no effect;
# with too few of them, at all points. The factor allows for larger errors between the points, and at other codes.
ERROR_SAMPLE_POINTS, MIN_NEAR_SURFACE_POINTS = 2**14, 100
NEAR_SURFACE_VALUE, COARSE_ERROR_FACTOR = 0.05, 2.0

Layer = tuple[Tensor, Tensor]  # weight [out, in] and bias [out]
_errors = WeakTensorKeyDictionary()  # from a network's last weight, shared by all codes, to its version and the error


class Decoder(nn.Module):
    """Fully connected ReLU layers of points and a code, with one skip connection that feeds both in again.

    Source: DeepSDF (Park et al. 2019), the network of DIST, B.1, with 8 hidden layers of 512, code length 256, skip 4.
    Deviates: no weight normalisation, no dropout, no final tanh.

    Args:
        layers: hidden layers, at least 1.
        width: neurons per hidden layer.
        code_length: numbers in a shape's code; 0 for a network of one shape.
        skip: index of the hidden layer whose input also takes the code and the point; 0 for no skip.
        narrow: whether the layer before the skip is narrower, as in DeepSDF: with the input it has `width` numbers.
        outputs: numbers per point; `BoundDecoder.outputs` returns more than one.
    """

    def __init__(self, *, layers: int, width: int, code_length: int, skip: int, narrow: bool, outputs: int = 1) -> None:
        super().__init__()
        check_at_least("layers", layers, 1, "DeepSDF has 8")
        check_at_least("width", width, 1, "DeepSDF has 512")
        check_at_least("code_length", code_length, 0, "DeepSDF has 256")
        if not 0 <= skip < layers:
            raise ValueError(f"skip must lie between 0 (none) and layers - 1 = {layers - 1}, not {skip}")
        skip_inputs = code_length + 3
        if skip and narrow and width <= skip_inputs:
            raise ValueError(
                f"width must exceed code_length + 3 = {skip_inputs} for a narrowed skip, not {width}: set narrow=false"
            )
        self.code_length, self.skip, self.width, self.code_is_position = code_length, skip, width, False
        self.kind: Kind = Kind.DISTANCE
        self.lipschitz: float | None = None
        inputs, sizes = [skip_inputs] + [width] * (layers - 1), [width] * layers
        if skip and narrow:
            sizes[skip - 1] -= skip_inputs
        elif skip:
            inputs[skip] += skip_inputs
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(inputs, sizes, strict=True))
        self.last = nn.Linear(width, outputs)

    def at(self, code: Float[Tensor, "*shapes code_length"]) -> "BoundDecoder":
        """The field of one code, or of a batch of codes.

        The product of the code with its weights is the same for all points, so it is added to the biases here, once.
        """
        if code.shape[-1] != self.code_length:
            raise ValueError(f"code must end in {self.code_length} numbers, not {code.shape[-1]}")
        layers = []
        for index, layer in enumerate(self.hidden):
            assert isinstance(layer, nn.Linear)
            weight, bias = layer.weight, layer.bias
            takes_code = index == 0 or (index == self.skip and self.skip > 0)
            if takes_code and self.code_length:
                # Columns: the features of the layer before, then the code, then the point.
                before = weight.shape[1] - self.code_length - 3
                bias = bias + code @ weight[:, before : before + self.code_length].T
                weight = torch.cat([weight[:, :before], weight[:, -3:]], dim=1)
            layers.append((weight, bias))
        return BoundDecoder(tuple(layers), (self.last.weight, self.last.bias), self.skip, self.kind, self.lipschitz)


@dataclass(frozen=True)
class BoundDecoder:
    """A decoder at one code: a Field that approximates a distance, without a Lipschitz constant."""

    hidden: tuple[Layer, ...]
    last: Layer
    skip: int
    kind: Kind = Kind.DISTANCE
    lipschitz: float | None = None

    @property
    def flops(self) -> Flops:
        """A multiplication and an addition per weight; the gradient costs as much, or twice as much with weights."""
        value = 2 * sum(weight.numel() for weight, _ in (*self.hidden, self.last))
        return Flops(value, value if self._frozen else 2 * value)

    @property
    def _frozen(self) -> bool:
        tensors = (*(weight for weight, _ in self.hidden), *self.last)
        return not any(tensor.requires_grad for tensor in tensors)

    @cached_property
    def coarse(self) -> Coarse | None:
        """Coarse values for one code and frozen weights; None if they would not be faster."""
        if not self._frozen or self.hidden[0][1].dim() > 1:
            return None
        with torch.no_grad():
            return coarse_values(self.hidden, self.last, self.skip, self)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The values; a batch of codes [*shapes, code_length] takes points [*shapes, n, 3]."""
        if self.hidden[0][1].dim() > 1:
            return self._forward(points)
        flat = points.reshape(-1, 3)
        needs_graph = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (flat, *self._tensors))
        if needs_graph and self._frozen:
            values = _FrozenDecoder.apply(self, flat, *(bias for _, bias in self.hidden))
            assert isinstance(values, Tensor)
            return values.view(points.shape[:-1])
        compiled = None if needs_graph else self._compiled_for(flat)
        if compiled is not None:
            return compiled.values(flat).view(points.shape[:-1])
        chunks = [self._forward(chunk) for chunk in split_into_passes(flat, self._width)]
        values = torch.cat(chunks) if len(chunks) != 1 else chunks[0]
        return values.view(points.shape[:-1])

    def outputs(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch outputs"]:
        """The outputs of a decoder with several numbers per point, with a graph."""
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
        """The compiled decoder. It copies the weights, so it is built again after they have changed."""
        state = sum(0 if tensor.is_inference() else tensor._version for tensor in self._tensors)
        if state not in self._copies:
            self._copies.clear()
            self._copies[state] = compile_decoder(self.hidden, self.last, self.skip)
        return self._copies[state]

    def _compiled_for(self, points: Tensor) -> CompiledDecoder | None:
        """The compiled decoder, if there is one for these points: float32 on a CPU with one thread."""
        is_supported = points.dtype == torch.float32 and points.device.type == "cpu" and torch.get_num_threads() == 1
        return self._compiled() if is_supported else None

    def _forward(self, points: Tensor, gates: tuple[Tensor, ...] = ()) -> Tensor:
        """The values. Sets `gates`, unless empty, to True where a ReLU's output is positive."""
        features = points
        for index, (weight, bias) in enumerate(self.hidden):
            if index == self.skip and index:
                features = torch.cat([features, points], dim=-1)
            features = _affine(features, weight, bias).relu_()
            if gates:
                torch.gt(features, 0, out=gates[index])
        return _affine(features, *self.last).squeeze(-1)

    def _backward(self, gradient: Tensor, gates: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """Maps the gradient [n] of values to the gradients of points [n, 3] and of hidden biases [n, width]."""
        towards_points = torch.zeros_like(gradient)[:, None]
        towards_biases = []
        features = gradient[:, None] * self.last[0]
        for index in range(len(self.hidden) - 1, -1, -1):
            features = features.mul_(gates[index])
            towards_biases.insert(0, features)
            features = features @ self.hidden[index][0]
            if index == self.skip and index:
                features, skip_gradient = features[:, :-3], features[:, -3:]
                towards_points = towards_points + skip_gradient
        return towards_points + features, towards_biases


class _FrozenDecoder(torch.autograd.Function):
    """A decoder whose weights need no gradient, with less memory and time than autograd.

    Compiled code computes the features again in the backward pass. Without it, the forward pass keeps the signs of the
    ReLUs' inputs, one byte per neuron. Both skip points whose value has a zero gradient. The gradients depend on
    those of the values alone: the second derivatives of a ReLU network are 0 almost everywhere.
    """

    @staticmethod
    def forward(ctx: Any, field: BoundDecoder, points: Tensor, *biases: Tensor) -> Tensor:
        ctx.field, ctx.compiled = field, field._compiled_for(points)
        if ctx.compiled is not None:
            ctx.points = points.detach().clone()  # which may be changed, or be of inference mode
            return ctx.compiled.values(points)
        values, gates = _values_and_gates(field, points)
        ctx.save_for_backward(*gates)
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = gradients
        if ctx.compiled is not None and not gradient.requires_grad:
            to_points, to_biases = ctx.compiled.gradients(ctx.points, gradient, ctx.needs_input_grad[2:])
            return None, to_points, *to_biases
        all_gates = ctx.saved_tensors if ctx.compiled is None else _values_and_gates(ctx.field, ctx.points)[1]
        towards_points = gradient.new_zeros(len(gradient), 3)
        towards_biases = [gradient.new_zeros(gate.shape[1]) for gate in all_gates]
        size = points_per_pass(ctx.field._width, gradient.dtype, gradient.device)
        for rows in gradient.nonzero().squeeze(-1).split(size):
            gates = [gate[rows] for gate in all_gates]
            point_gradient, bias_gradients = ctx.field._backward(gradient[rows], gates)
            towards_points.index_put_((rows,), point_gradient)
            for sum_of_gradients, bias_gradient in zip(towards_biases, bias_gradients, strict=True):
                sum_of_gradients += bias_gradient.sum(0)
        return None, towards_points, *towards_biases


@torch.no_grad()
def _values_and_gates(field: BoundDecoder, points: Tensor) -> tuple[Tensor, list[Tensor]]:
    """The values, and whether each ReLU's input is positive [points, width], for each hidden layer."""
    gates = [torch.empty(len(points), len(b), dtype=torch.bool, device=points.device) for _, b in field.hidden]
    values = points.new_empty(len(points))
    size = points_per_pass(field._width, points.dtype, points.device)
    for start in range(0, len(points), size):
        batch = slice(start, start + size)
        values[batch] = field._forward(points[batch], tuple(gate[batch] for gate in gates))
    return values, gates


def split_into_passes(
    points: Float[Tensor, "n 3"], width: int, dtype: torch.dtype | None = None
) -> Sequence[Float[Tensor, "chunk 3"]]:
    """The points in chunks of `points_per_pass`; `dtype` is that of the features, by default that of the points."""
    if len(points) <= MIN_POINTS_PER_PASS:
        return (points,)
    return points.split(points_per_pass(width, dtype or points.dtype, points.device))


def points_per_pass(width: int, dtype: torch.dtype, device: torch.device) -> int:
    """Points per pass through a network whose layers have `width` neurons in `dtype`: many, but within the caches.

    The number changes values by rounding only. Measured on CPUs with 4 layers of 128, where it is 2,048: per point,
    passes of 65,536 take 1.3 times as long, and passes of 256 take 1.1 times as long.
    """
    feature_bytes = CACHE_BYTES_PER_THREAD * torch.get_num_threads() if device.type == "cpu" else GPU_BYTES_PER_PASS
    return max(feature_bytes // (width * dtype.itemsize), MIN_POINTS_PER_PASS)


def _affine(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    if bias.dim() == 1:
        return linear(features, weight, bias)
    return features @ weight.T + bias[..., None, :]


def coarse_values(hidden: tuple[Layer, ...], last: Layer, skip: int, exact: PointFunction) -> Coarse | None:
    """The coarse values of a network at one code; None if they would not be faster.

    Args:
        hidden, last, skip: as in `BoundDecoder`; none needs a gradient.
        exact: the network's values. The error is measured once per state of the last layer, which all codes share.
    """
    width = max(len(bias) for _, bias in hidden)
    if width < MIN_COARSE_WIDTH or last[0].dtype != torch.float32 or not bfloat16_is_faster(last[0].device):
        return None
    network = _Bfloat16Decoder.of(hidden, last, skip)
    version, error = _errors.get(last[0]) or (None, 0.0)
    if version != last[0]._version:
        error = COARSE_ERROR_FACTOR * _largest_error(network, exact, last[0])
        _errors[last[0]] = last[0]._version, error
    return Coarse(network, error)


@cache
def bfloat16_is_faster(device: torch.device) -> bool:
    """Whether a device has instructions for products of bfloat16 matrices, and on a CPU whether they save time."""
    if device.type != "cpu":
        return device.type == "cuda" and torch.cuda.is_bf16_supported(including_emulation=False)
    if hasattr(torch.cpu, "get_capabilities"):
        supported = [torch.cpu.get_capabilities().get(name, False) for name in ("amx_bf16", "avx512_bf16")]
    else:  # PyTorch before 2.11
        supported = [getattr(torch.cpu, f"_is_{name}_supported")() for name in ("amx_tile", "avx512_bf16")]
    return any(supported) and _product_seconds(torch.bfloat16) < _product_seconds(torch.float32)


def _product_seconds(dtype: torch.dtype) -> float:
    """The shortest time of five matrix products, as large as a layer of the papers' networks."""
    features, weight, seconds = torch.ones(2048, 512, dtype=dtype), torch.ones(512, 512, dtype=dtype), []
    for _ in range(5):
        started = time.perf_counter()
        linear(features, weight)
        seconds.append(time.perf_counter() - started)
    return min(seconds)


@dataclass(frozen=True)
class _Bfloat16Decoder:
    """The decoder with hidden layers in bfloat16; each is a function of features and points.

    Args:
        first, last: weight and bias in float32.
        layers: from the second hidden layer on.
    """

    first: Layer
    layers: tuple[Callable[[Tensor, Tensor], Tensor], ...]
    last: Layer

    @staticmethod
    def of(hidden: tuple[Layer, ...], last: Layer, skip: int) -> "_Bfloat16Decoder":
        kinds = (_skip_layer if index == skip else _feature_layer for index in range(1, len(hidden)))
        layers = tuple(kind(*layer) for kind, layer in zip(kinds, hidden[1:], strict=True))
        return _Bfloat16Decoder(hidden[0], layers, last)

    def __call__(self, points: Tensor) -> Tensor:
        chunks = split_into_passes(points.reshape(-1, 3), len(self.first[1]), torch.bfloat16)
        return torch.cat([self._values(chunk) for chunk in chunks]).view(points.shape[:-1])

    def _values(self, points: Tensor) -> Tensor:
        features = linear(points, *self.first).relu_().bfloat16()
        for layer in self.layers:
            features = layer(features, points)
        return linear(features.float(), *self.last).squeeze(-1)


def _feature_layer(weight: Tensor, bias: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """A hidden layer that takes features only."""
    product = _product(weight, bias, "relu")
    return lambda features, points: product(features)


def _skip_layer(weight: Tensor, bias: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """The hidden layer that also takes the points, by the last three columns of its weight."""
    product, point_weight = _product(weight[:, :-3], None, "none"), weight[:, -3:]
    return lambda features, points: (product(features) + linear(points, point_weight, bias)).relu_().bfloat16()


def _product(weight: Tensor, bias: Tensor | None, activation: str) -> Callable[[Tensor], Tensor]:
    """A function from the features of the layer before to those of this one, in bfloat16.

    On a CPU the weight is packed once for oneDNN, by private operations of torch; if these fail, the slower `linear` is
    used. `activation` is "relu" or "none".
    """
    weight, bias = weight.bfloat16().contiguous(), None if bias is None else bias.bfloat16()
    if weight.device.type == "cpu":
        try:
            packed = torch.ops.mkldnn._reorder_linear_weight(weight, ONEDNN_PACKING_POINTS)
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


def _largest_error(network: _Bfloat16Decoder, exact: PointFunction, like: Tensor) -> float:
    """The largest error of the network's values near its surface, always at the same points."""
    points = points_in_sphere(ERROR_SAMPLE_POINTS, like)
    values = network(points)
    near = values.abs() <= NEAR_SURFACE_VALUE
    near = near | (near.sum() < MIN_NEAR_SURFACE_POINTS)
    return float((values[near] - exact(points[near])).abs().max())
