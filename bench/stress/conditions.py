"""Under what all trials of a search are made, and what counts as success."""

from dataclasses import dataclass

import torch

from bench.limits import Limits
from bench.tasks.problem import OptimiserSettings
from renderers.checks import check_at_least, check_positive, check_share


@dataclass(frozen=True)
class Criteria:
    """What counts as success.

    Args:
        hits: least share of the true hits that must be found within the pixel's footprint.
        false_hits: largest share of false hits, of the true ones; of all rays where there is nothing to hit.
        cosine: least cosine between the gradient and the true one.
        scale: largest relative error of its length.
        surface_error: largest mean distance from the true surface to the fitted one, in scene units.
    """

    hits: float
    false_hits: float
    cosine: float
    scale: float
    surface_error: float

    def __post_init__(self) -> None:
        for name in ("hits", "cosine"):
            check_share(f"task.criteria.{name}", getattr(self, name), "0.99 is strict")
        for name in ("false_hits", "scale", "surface_error"):
            check_positive(f"task.criteria.{name}", getattr(self, name), "0.01 is strict")


@dataclass(frozen=True)
class FitSettings:
    """The fit whose end is judged.

    Args:
        resolution: pixels a side.
        iterations, learning_rate: of Adam; the rate falls to zero along half a cosine.
        depth_weight, silhouette_weight: as in completion.
        offset: of the ball's middle at the start, in scene units.
    """

    resolution: int
    iterations: int
    learning_rate: float
    depth_weight: float
    silhouette_weight: float
    offset: float

    def __post_init__(self) -> None:
        check_at_least("task.fit.resolution", self.resolution, 4, "32 suits a ball")
        check_positive("task.fit.offset", self.offset, "0.1 is easily found back")
        OptimiserSettings(self.iterations, self.learning_rate, "cosine")


@dataclass(frozen=True)
class Conditions:
    """Under what all trials are made: pixels a side of a rendering, the fit, what is a success, limits, the device."""

    resolution: int
    fit: FitSettings
    criteria: Criteria
    limits: Limits
    device: torch.device
