"""The warm start of a candidate, without a renderer: a fit to the observed points or to the previous field."""

from dataclasses import dataclass, field
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.models.model import Model
from bench.models.observations import generator
from bench.shape_prior.autodecoder import near_surface_first
from renderers.field import Counts, Field, Meter

SURFACE_WIDTH = 0.05  # scene units: of `near_surface_first`
NEAR = 0.05  # scene units, standard deviation: how far from the surface half of the points are
RADIUS = 1.1  # scene units, of the sphere that holds the others: rays start on the unit sphere


@dataclass
class WarmStart:
    """Fits a model's parameters to points; see `bench.solve.problem.Objective`.

    A field with a formula is fitted to the observed points, where it should be 0, and to points that are known to lie
    outside, where it should not be negative. Other fields are fitted to the values of a target field.

    Args:
        model: that is fitted.
        surface, free: points of the surface; points outside.
        target: the field whose values are fitted; None fits to the points.
        count: number of points in an iteration, of each kind.
        seed: of the draws.
    """

    model: Model
    surface: Float[Tensor, "n 3"]
    free: Float[Tensor, "m 3"]
    target: Field | None
    count: int
    seed: int
    counts: Counts = field(default_factory=Counts)
    target_counts: Counts = field(default_factory=Counts)  # of evaluations of the target
    phase: ClassVar[str] = "warm start"

    @torch.no_grad()
    def error(self) -> float:
        """The loss of the current model, on the first draw, not counted."""
        return float(self._loss(self.model.field(), 0))

    @property
    def parameters(self) -> list[Tensor]:
        """The parameters that the optimiser changes."""
        return self.model.parameters

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The mean error of the values."""
        return {"total": self._loss(Meter(self.model.field(), self.counts), iteration)}

    def _loss(self, shape: Field, iteration: int) -> Float[Tensor, ""]:
        draw = generator(self.seed, iteration)
        if self.target is not None:
            points = scattered(self.surface, self.count, draw)
            with torch.no_grad():
                wanted = Meter(self.target, self.target_counts)(points)
            return near_surface_first((shape(points) - wanted).abs(), wanted, SURFACE_WIDTH).mean()
        off = shape(_some(self.surface, self.count, draw)).abs().mean()
        inside = (-shape(_some(self.free, self.count, draw))).clamp_min(0).mean()
        return off + inside


def scattered(surface: Float[Tensor, "n 3"], count: int, draw: torch.Generator) -> Float[Tensor, "count 3"]:
    """Points, half of them near points of a surface, the others anywhere in a sphere that holds the scene."""
    near = count // 2
    around = torch.nn.functional.normalize(torch.randn(count - near, 3, generator=draw), dim=-1)
    around *= RADIUS * torch.rand(count - near, 1, generator=draw) ** (1 / 3)
    noise = NEAR * torch.randn(near, 3, generator=draw)
    return torch.cat([_some(surface, near, draw) + noise.to(surface.device), around.to(surface.device)])


def _some(points: Float[Tensor, "n 3"], count: int, draw: torch.Generator) -> Float[Tensor, "count 3"]:
    return points[torch.randint(len(points), (count,), generator=draw).to(points.device)]
