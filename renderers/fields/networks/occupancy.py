"""DVR's network: occupancy and texture of points and a shape code, bound to one code before rendering."""

from dataclasses import dataclass
from math import log

import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import check_at_least
from renderers.field import Flops, Kind, PointFunction
from renderers.fields.mlp import split_into_passes
from renderers.fields.networks.network import flops_of

BLOCKS = 5  # DVR, Sec. 3.5


class OccupancyNetwork(nn.Module):
    """Fully connected ResNet blocks with ReLU, then two heads of one layer each: occupancy, and texture.

    Source: DVR (Niemeyer et al. 2020), Secs. 3.1 and 3.5: 5 blocks; one output for occupancy, three for texture; codes
        of length 256 for single views.
    Deviates: no image encoder; the code is an input. The two sections do not specify where the code enters, the form of
        a block, the width and the initial weights. Here a linear map of the code is added before every block; a block
        is x + B relu(A relu(x)); the width is an argument; the initial weights are torch's.

    Args:
        width: neurons per layer.
        code_length: numbers in a shape's code; 0 for a network of one shape.
    """

    def __init__(self, *, width: int, code_length: int) -> None:
        super().__init__()
        check_at_least("width", width, 1, "128 suits one shape, 512 many")
        check_at_least("code_length", code_length, 0, "DVR has 256 for single views, 0 is for one shape")
        self.width, self.code_length = width, code_length
        self.first = nn.Linear(3, width)
        takes_code = range(BLOCKS if code_length else 0)
        self.shifts = nn.ModuleList(nn.Linear(code_length, width, bias=False) for _ in takes_code)
        self.blocks = nn.ModuleList(Block(width) for _ in range(BLOCKS))
        self.occupancy_head = nn.Linear(width, 1)
        self.texture_head = nn.Linear(width, 3)

    def at(self, code: Float[Tensor, "*shapes code_length"]) -> "BoundOccupancy":
        """Occupancy and texture of one code, or of a batch of codes; a code's shift of each block is computed once."""
        if code.shape[-1] != self.code_length:
            raise ValueError(f"code must end in {self.code_length} numbers, not {code.shape[-1]}")
        return BoundOccupancy(self, tuple(shift(code) for shift in self.shifts))


@dataclass(frozen=True)
class BoundOccupancy:
    """An occupancy network at one code. It is not a Field: `OccupancyField` makes one from its logits."""

    network: OccupancyNetwork
    shifts: tuple[Tensor, ...]

    @property
    def flops(self) -> Flops:
        """Of one logit; see `flops_of`."""
        return flops_of(nn.ModuleList([self.network.first, self.network.blocks, self.network.occupancy_head]))

    def logits(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Logits of being inside; for a batch of codes [*shapes, length], of points [*shapes, n, 3]."""
        return self._outputs(points, self.network.occupancy_head).squeeze(-1)

    def colours(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Red, green and blue from 0 to 1, at points as for `logits`."""
        return self._outputs(points, self.network.texture_head).sigmoid()

    def _outputs(self, points: Tensor, head: nn.Module) -> Tensor:
        if self.shifts and self.shifts[0].dim() > 1:
            return head(self._features(points))
        chunks = [head(self._features(chunk)) for chunk in split_into_passes(points.reshape(-1, 3), self.network.width)]
        outputs = torch.cat(chunks)
        return outputs.view(*points.shape[:-1], outputs.shape[-1])

    def _features(self, points: Tensor) -> Tensor:
        features = self.network.first(points)
        for index, block in enumerate(self.network.blocks):
            if self.shifts:
                shift = self.shifts[index]
                features = features + (shift if shift.dim() == 1 else shift[..., None, :])
            features = block(features)
        return features.relu_()


@dataclass(frozen=True)
class OccupancyField:
    """The level set p = threshold (DVR, Sec. 3.1) as a field: logit(threshold) - logit(p), negative where p is above.

    Args:
        logits: logit(p) at points.
        threshold: DVR's tau, between 0 and 1; 0.5 in the paper.
        flops: operations per point; None if unknown.
    """

    logits: PointFunction
    threshold: float
    flops: Flops | None = None
    kind: Kind = Kind.LEVEL
    lipschitz: float | None = None

    def __post_init__(self) -> None:
        if not 0 < self.threshold < 1:
            raise ValueError(f"threshold must lie between 0 and 1, not {self.threshold}: DVR uses 0.5")

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return log(self.threshold / (1 - self.threshold)) - self.logits(points)


class Block(nn.Module):
    """Two layers with a skip connection around them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inner, self.outer = nn.Linear(width, width), nn.Linear(width, width)

    def forward(self, features: Tensor) -> Tensor:
        return features + self.outer(self.inner(torch.relu(features)).relu_())
