"""The DeepSDF decoder: a network of points and a shape code, bound to one code before anything is rendered."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import check_at_least
from renderers.field import Kind

CHUNK = 4096  # points a pass: keeps the activations in cache (measured on CPUs: 65,536 is 1.3 times slower)


class Decoder(nn.Module):
    """Fully connected ReLU layers of points and a code, with one skip that feeds both in again.

    Source: DeepSDF (Park et al. 2019), the network of DIST, B.1, with 8 hidden layers of 512, code length 256, skip 4.
    Deviates: no weight normalisation, no dropout, no final tanh.

    Args:
        layers: hidden layers, at least 1.
        width: neurons a hidden layer.
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
    def flops(self) -> int:
        """Of one value: a multiplication and an addition a weight."""
        return 2 * sum(weight.numel() for weight, _ in (*self.hidden, self.last))

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """The values; for a batch of codes [*shapes, code_length], of points [*shapes, n, 3]."""
        if self.hidden[0][1].dim() > 1:
            return self._forward(points)
        flat = points.reshape(-1, 3)
        chunks = [self._forward(chunk) for chunk in flat.split(CHUNK)]
        return (torch.cat(chunks) if len(chunks) != 1 else chunks[0]).view(points.shape[:-1])

    def _forward(self, points: Tensor) -> Tensor:
        features = points
        for index, (weight, bias) in enumerate(self.hidden):
            if index == self.skip and index:
                features = torch.cat([features, points], dim=-1)
            features = torch.relu(_affine(features, weight, bias))
        return _affine(features, *self.last).squeeze(-1)


def _affine(features: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    if bias.dim() == 1:
        return torch.nn.functional.linear(features, weight, bias)
    return features @ weight.T + bias[..., None, :]
