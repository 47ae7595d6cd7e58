"""Networks of encoded points: Fourier features, and a hash grid of several resolutions, as distances of one shape.

The slope of a hash grid jumps between its cells, and depends on one cell of each level. Neuralangelo (Li et al. 2023)
takes central differences instead, which reach neighbouring cells: see `slope_width` of `coloured.ColouredEncoded`.
"""

from dataclasses import dataclass
from math import pi
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import linear

from renderers.field import Flops, Kind
from renderers.fields.mlp import Layer, split_into_passes

HASH_PRIMES = (1, 2_654_435_761, 805_459_861)  # Mueller et al. 2022, Eq. 4
FLOPS_PER_SINE = 20  # an estimate, also for the cosine
FLOPS_PER_LEVEL, FLOPS_PER_FEATURE = 110, 16  # an estimate: eight indices and weights; eight products and sums


@runtime_checkable
class Encoding(Protocol):
    """A function from points to features, without the points."""

    @property
    def flops(self) -> int: ...

    def __call__(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]: ...


@dataclass(frozen=True)
class FourierFeatures:
    """The cosine and sine of `frequencies` [m, 3], in cycles per scene unit, at a point.

    Source: Tancik et al. 2020, "Fourier Features Let Networks Learn High Frequency Functions", Sec. 4: random
        frequencies from a normal distribution, which are not learnt.
    """

    frequencies: Float[Tensor, "m 3"]

    @property
    def flops(self) -> int:
        return len(self.frequencies) * (6 + 2 * FLOPS_PER_SINE)

    def __call__(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        angles = 2 * pi * points @ self.frequencies.T.to(points.dtype)
        return torch.cat([angles.cos(), angles.sin()], dim=-1)


@dataclass(frozen=True)
class HashGrid:
    """Features of several grids, interpolated trilinearly. Corners of a grid that is larger than a table share entries.

    Source: Mueller et al. 2022, "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", Sec. 3.
    Deviates: points outside the cube have the features of its nearest point.

    Args:
        tables: [levels, entries, features]; `entries` is a power of 2.
        cells: number of cells per axis of each level.
        reach: half the side of the cube about the origin, in scene units.
    """

    tables: Float[Tensor, "levels entries features"]
    cells: tuple[int, ...]
    reach: float

    @property
    def flops(self) -> int:
        levels, _, features = self.tables.shape
        return levels * (FLOPS_PER_LEVEL + FLOPS_PER_FEATURE * features)

    def __call__(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        unit = (points.clamp(-self.reach, self.reach) + self.reach) / (2 * self.reach)
        return torch.cat([self._level(level, unit * count) for level, count in enumerate(self.cells)], dim=-1)

    def _level(self, level: int, position: Float[Tensor, "n 3"]) -> Float[Tensor, "n features"]:
        """The features of a level at positions in units of its cells."""
        low = position.detach().nan_to_num().floor().clamp(0, self.cells[level] - 1)
        corners = torch.cartesian_prod(*[torch.arange(2, device=position.device)] * 3)  # [8, 3]
        offset = (position - low)[:, None]
        weights = torch.where(corners.bool(), offset, 1 - offset).prod(dim=-1)
        features = self.tables[level][self._entries(level, low.long()[:, None] + corners)]
        return (weights[..., None] * features.to(weights.dtype)).sum(dim=1)

    def _entries(self, level: int, corners: Int[Tensor, "n 8 3"]) -> Int[Tensor, "n 8"]:
        """The entries of corners: one for each corner if the table is large enough, else by their hash."""
        x, y, z = corners.unbind(-1)
        side, entries = self.cells[level] + 1, self.tables.shape[1]
        if side**3 <= entries:
            return (x * side + y) * side + z
        return (x * HASH_PRIMES[0] ^ y * HASH_PRIMES[1] ^ z * HASH_PRIMES[2]) & (entries - 1)


@dataclass(frozen=True)
class EncodedNetwork:
    """A ReLU network of a point and its encoding.

    Deviates from both sources: the network also takes the point itself, so that it can be initialised to a sphere.

    Args:
        encoding: of the points.
        layers: weight [out, in] and bias [out] of each layer; the first one takes the point, then its features.
    """

    encoding: Encoding
    layers: tuple[Layer, ...]
    kind: Kind = Kind.DISTANCE
    lipschitz: float | None = None

    @property
    def flops(self) -> Flops:
        value = self.encoding.flops + 2 * sum(weight.numel() for weight, _ in self.layers)
        return Flops(value, 2 * value)

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        flat = points.reshape(-1, 3)
        width = max(weight.shape[1] for weight, _ in self.layers)
        chunks = [flat] if torch.is_grad_enabled() else split_into_passes(flat, width)
        return torch.cat([self._values(chunk) for chunk in chunks]).view(points.shape[:-1])

    def _values(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        features = torch.cat([points, self.encoding(points)], dim=-1)
        *hidden, last = ((weight.to(points.dtype), bias.to(points.dtype)) for weight, bias in self.layers)
        for layer in hidden:
            features = linear(features, *layer).relu()
        return linear(features, *last).squeeze(-1)
