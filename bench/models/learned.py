"""Candidates without a formula: networks of one shape, and a grid whose samples near the surface are fitted."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bench.models.model import Model, Seen
from bench.shape_prior.autodecoder import initialise_to_sphere
from renderers.checks import check_at_least
from renderers.fields.grid import FLOPS, Grid
from renderers.fields.mlp import BoundDecoder, Decoder

DEEP = 8  # layers from which on a skip connection feeds the points in again half-way, as in DeepSDF
MAX_RATE, RATE_OF_WIDTH = 2e-3, 0.4  # Adam's rate: at most 2e-3, inversely as the width (Yang et al. 2021)
START_RADIUS = 0.5  # of the sphere that a network is initialised to, in scene units
REACH = 1.05  # half the side of the sampled cube: the unit sphere and a margin
BAND = 2.0  # cells to both sides of the surface whose samples are fitted
MOST_SAMPLES = 256  # along an axis: 64 MiB of values
GRID_RATE = 2e-3  # scene units


@dataclass(frozen=True)
class Network:
    """Fully connected ReLU layers from a point to a distance (see `renderers.fields.mlp.Decoder`, without a code)."""

    layers: int
    width: int
    follows: ClassVar[bool] = True
    tries: ClassVar[int] = 1

    def __post_init__(self) -> None:
        check_at_least("network layers", self.layers, 1, "network_1x16 is small")
        check_at_least("network width", self.width, 4, "network_1x16 is small")

    @property
    def name(self) -> str:
        return f"network_{self.layers}x{self.width}"

    @cached_property
    def size(self) -> int:
        """The number of parameters."""
        return sum(parameter.numel() for parameter in self._decoder(0).parameters())

    @cached_property
    def flops(self) -> int:
        return self._bound(list(self._decoder(0).parameters())).flops.value

    def starts(self, seen: Seen) -> list[Model]:
        """Initialised near the distance of a sphere; the warm start then fits it to the previous field."""
        decoder = self._decoder(seen.seed)
        initialise_to_sphere(decoder, START_RADIUS)
        parameters = [parameter.detach().to(seen.device).requires_grad_() for parameter in decoder.parameters()]
        return [Model(self.name, parameters, self._bound, min(MAX_RATE, RATE_OF_WIDTH / self.width), metric=False)]

    def _decoder(self, seed: int) -> Decoder:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            return Decoder(layers=self.layers, width=self.width, code_length=0, skip=self._skip, narrow=True)

    @property
    def _skip(self) -> int:
        return self.layers // 2 if self.layers >= DEEP else 0

    def _bound(self, free: list[Tensor]) -> BoundDecoder:
        pairs = list(zip(free[::2], free[1::2], strict=True))
        return BoundDecoder(tuple(pairs[:-1]), pairs[-1], self._skip)


@dataclass(frozen=True)
class NarrowBand:
    """A grid of distances: those near the surface are fitted, the others keep the values of the previous field."""

    resolution: int
    follows: ClassVar[bool] = True
    tries: ClassVar[int] = 1

    def __post_init__(self) -> None:
        if not 8 <= self.resolution <= MOST_SAMPLES:
            raise ValueError(f"N of grid_N must lie between 8 and {MOST_SAMPLES}, not {self.resolution}: grid_32")

    @property
    def name(self) -> str:
        return f"grid_{self.resolution}"

    @property
    def flops(self) -> int:
        return FLOPS.value

    @torch.no_grad()
    def starts(self, seen: Seen) -> list[Model]:
        """The previous field's values; fitted are those near its surface or near the observed points."""
        axis = torch.linspace(-REACH, REACH, self.resolution, device=seen.device)
        corners = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        values = seen.previous_values(corners.view(-1, 3)).to(seen.device)
        cell = 2 * REACH / (self.resolution - 1)
        near = values.abs() < BAND * cell
        near[self._near_points(seen.points.to(seen.device), cell)] = True
        band = near.nonzero().squeeze(-1)

        def grid(free: list[Tensor]) -> Grid:
            kept = values.index_put((band,), free[0])
            return Grid(kept.view(self.resolution, self.resolution, self.resolution), REACH)

        free = values[band].clone().requires_grad_()
        return [Model(self.name, [free], grid, GRID_RATE, metric=False, held=len(values) - len(free))]

    def _near_points(self, points: Float[Tensor, "n 3"], cell: float) -> Int[Tensor, " m"]:
        """Indices of the samples within `BAND` cells of a point, along each axis."""
        reach = int(BAND)
        steps = torch.arange(1 - reach, reach + 1, device=points.device)
        offsets = torch.cartesian_prod(steps, steps, steps)
        low = ((points + REACH) / cell).floor().long()
        corners = (low[:, None] + offsets).clamp(0, self.resolution - 1).reshape(-1, 3)
        place = (corners[:, 0] * self.resolution + corners[:, 1]) * self.resolution + corners[:, 2]
        return place.unique()
