"""The DeepSDF decoder: a network of points and a shape code, bound to one code before rendering."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import check_at_least
from renderers.field import Coarse, Flops, Kind
from renderers.fields.affine import segment_bounds
from renderers.fields.bfloat16 import coarse_values

CHUNK = 2048  # points per pass: keeps the activations in cache (measured on CPUs: 65,536 is 1.3 times slower)


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
    """

    def __init__(self, *, layers: int, width: int, code_length: int, skip: int, narrow: bool) -> None:
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
        self.code_length, self.skip, self.width = code_length, skip, width
        inputs, outputs = [again] + [width] * (layers - 1), [width] * layers
        if skip and narrow:
            outputs[skip - 1] -= again
        elif skip:
            inputs[skip] += again
        self.hidden = nn.ModuleList(nn.Linear(i, o) for i, o in zip(inputs, outputs, strict=True))
        self.last = nn.Linear(width, 1)

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
        return BoundDecoder(tuple(layers), (self.last.weight, self.last.bias), self.skip)


@dataclass(frozen=True)
class BoundDecoder:
    """A decoder at one code: a Field that approximates a distance, with no known Lipschitz bound."""

    hidden: tuple[tuple[Tensor, Tensor], ...]
    last: tuple[Tensor, Tensor]
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
        biases = tuple(bias for _, bias in self.hidden)
        if torch.is_grad_enabled() and self._frozen and any(t.requires_grad for t in (flat, *biases)):
            values = _FrozenDecoder.apply(self, flat, *biases)
            assert isinstance(values, Tensor)
        else:
            chunks = [self._forward(chunk) for chunk in flat.split(CHUNK)]
            values = torch.cat(chunks) if len(chunks) != 1 else chunks[0]
        return values.view(points.shape[:-1])

    def _forward(self, points: Tensor, gates: tuple[Tensor, ...] = ()) -> Tensor:
        """The values; fills `gates`, where given, with True where a ReLU is open."""
        features = points
        for index, (weight, bias) in enumerate(self.hidden):
            if index == self.skip and index:
                features = torch.cat([features, points], dim=-1)
            features = torch.relu(_affine(features, weight, bias))
            if gates:
                torch.gt(features, 0, out=gates[index])
        return _affine(features, *self.last).squeeze(-1)

    def _backward(self, gradient: Tensor, gates: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
        """From the gradient [n] of values to those of points [n, 3] and hidden biases [n, width]."""
        towards_points = torch.zeros_like(gradient)[:, None]
        towards_biases = []
        features = gradient[:, None] * self.last[0]
        for index in range(len(self.hidden) - 1, -1, -1):
            features = features * gates[index]
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
        for start in range(0, len(points), CHUNK):
            part = slice(start, start + CHUNK)
            values[part] = field._forward(points[part], tuple(gate[part] for gate in gates))
        ctx.save_for_backward(*gates)
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = gradients
        towards_points = gradient.new_zeros(len(gradient), 3)
        towards_biases = [gradient.new_zeros(gate.shape[1]) for gate in ctx.saved_tensors]
        for rows in gradient.nonzero().squeeze(-1).split(CHUNK):
            gates = [gate[rows] for gate in ctx.saved_tensors]
            some, biases = ctx.field._backward(gradient[rows], gates)
            towards_points = towards_points.index_put((rows,), some)
            towards_biases = [total + part.sum(0) for total, part in zip(towards_biases, biases, strict=True)]
        return None, towards_points, *towards_biases


def _affine(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    if bias.dim() == 1:
        return torch.nn.functional.linear(features, weight, bias)
    return features @ weight.T + bias[..., None, :]
