"""Networks that are nowhere steeper than 1: the magnitude of a value never exceeds the distance to the surface."""

from dataclasses import dataclass
from math import sqrt

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import linear, pad

from renderers.field import Flops, Kind
from renderers.fields.mlp import split_into_passes


@dataclass(frozen=True)
class LipschitzLayer:
    """A residual layer with a Lipschitz constant of at most 1: x - 2 W^T (relu(W x + b) / t).

    Source: Araujo et al. 2023, "A Unified Algebraic Perspective on Lipschitz Neural Networks", Theorem 3: t is the row
        sum of |W W^T|, in which each column is multiplied by its scale and each row divided by it.

    Args:
        log_scale: the logarithm of the scale of each row of the weight.
    """

    weight: Float[Tensor, "k width"]
    bias: Float[Tensor, " k"]
    log_scale: Float[Tensor, " k"]

    def __call__(self, features: Float[Tensor, "n width"]) -> Float[Tensor, "n width"]:
        weight, bias, log_scale = (tensor.to(features.dtype) for tensor in (self.weight, self.bias, self.log_scale))
        ratios = (log_scale[None] - log_scale[:, None]).exp()
        row_sums = ((weight @ weight.T).abs() * ratios).sum(dim=1).clamp_min(torch.finfo(features.dtype).tiny)
        return features - 2 * (linear(features, weight, bias).relu() / row_sums) @ weight


@dataclass(frozen=True)
class LipschitzNetwork:
    """A network of one shape whose slope is at most 1 everywhere, up to rounding.

    A march that steps by its values never passes the surface, whatever the network has learnt.

    Source: Coiffier and Bethune 2024, "1-Lipschitz Neural Distance Fields" (arXiv 2407.09505): the layers above, and a
        last row of unit length. Points are padded with zeros to the width.
    Deviates: the loss is that of a task. The paper's needs only whether points are inside: see `label_loss`.

    Args:
        layers: in their order, all of one width.
        last: of any length; it is divided by that.
        offset: added to the last layer.
    """

    layers: tuple[LipschitzLayer, ...]
    last: Float[Tensor, " width"]
    offset: Float[Tensor, ""]
    kind: Kind = Kind.BOUND
    lipschitz: float | None = 1.0

    @staticmethod
    def new(layers: int, width: int, *, seed: int) -> "LipschitzNetwork":
        """Random weights of variance 1 / width. Raises ValueError for fewer than 1 layer, or 4 features.

        A width of 4 is the smallest in which a point has room for a feature.
        """
        if layers < 1 or width < 4:
            raise ValueError(f"layers must be at least 1 and width at least 4, not {layers} and {width}: 4 and 64 suit")
        draw = torch.Generator().manual_seed(seed)
        rows = [torch.randn(width, width, generator=draw) / sqrt(width) for _ in range(layers)]
        parts = (LipschitzLayer(row, 0.1 * torch.randn(width, generator=draw), torch.zeros(width)) for row in rows)
        return LipschitzNetwork(tuple(parts), torch.randn(width, generator=draw), torch.zeros(()))

    @property
    def parameters(self) -> list[Tensor]:
        """All tensors that may be learnt, of the layers in their order, then of the last row."""
        of_layers = [tensor for layer in self.layers for tensor in (layer.weight, layer.bias, layer.log_scale)]
        return [*of_layers, self.last, self.offset]

    @property
    def flops(self) -> Flops:
        value = 2 * (2 * sum(layer.weight.numel() for layer in self.layers) + self.last.numel())
        return Flops(value, 2 * value)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        flat, width = points.reshape(-1, 3), len(self.last)
        chunks = [flat] if torch.is_grad_enabled() else split_into_passes(flat, width)
        return torch.cat([self._values(chunk) for chunk in chunks]).view(points.shape[:-1])

    def _values(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        features = pad(points, (0, len(self.last) - 3))
        for layer in self.layers:
            features = layer(features)
        last = torch.nn.functional.normalize(self.last.to(points.dtype), dim=0)
        return features @ last + self.offset.to(points.dtype)


def label_loss(
    values: Float[Tensor, " n"], inside: Float[Tensor, " n"], *, margin: float, hinge_weight: float
) -> Float[Tensor, ""]:
    """The hinge-Kantorovich-Rubinstein loss of a network of slope 1 (Coiffier and Bethune 2024).

    Its minimum is a distance, outside of the margin.

    Args:
        values: of the network at n points.
        inside: 1 at points inside the shape, 0 outside.
        margin: in scene units; values of the right sign and below it still cost.
        hinge_weight: of the hinge; the mean of signed values has the weight 1.
    """
    signed = torch.where(inside > 0.5, -values, values)
    return hinge_weight * (margin - signed).relu().mean() - signed.mean()
