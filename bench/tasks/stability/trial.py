"""Trials of a stress test: their conditions, the criteria of success, and their outcomes."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import torch

from bench.machine.limits import Limits
from bench.shape_prior import Prior
from bench.solve.observed_view import DEPTH_LOSSES
from bench.solve.optimise import OptimiserSettings
from renderers.checks import check_at_least, check_choice, check_fraction, check_positive
from renderers.silhouette import SilhouetteLoss


@dataclass(frozen=True)
class Criteria:
    """The criteria of success.

    Args:
        hits: minimum fraction of the true hits that are found within the pixel's footprint.
        false_hits: maximum ratio of spurious hits to true hits; to all rays if the scene has no true hits.
        cosine: minimum cosine between the gradient and the true one.
        scale: maximum relative error of the gradient's length.
        surface_error: maximum mean distance from the true surface to the fitted one, in scene units.
    """

    hits: float
    false_hits: float
    cosine: float
    scale: float
    surface_error: float

    def __post_init__(self) -> None:
        for name in ("hits", "cosine"):
            check_fraction(f"task.criteria.{name}", getattr(self, name), "0.99 is strict")
        for name in ("false_hits", "scale", "surface_error"):
            check_positive(f"task.criteria.{name}", getattr(self, name), "0.01 is strict")

    @property
    def of_renderings(self) -> str:
        """The criterion of a rendering in words, in two lines."""
        return (
            f"success: at least {self.hits:g} of the true hits lie within the footprint of a pixel,\n"
            f"and spurious hits are at most {self.false_hits:g} of them (without true hits: of the rays)"
        )


@dataclass(frozen=True)
class FitSettings:
    """The fit of a stress test with measure=fit.

    Args:
        resolution: height and width of the image, in pixels.
        iterations, learning_rate: settings of Adam; the rate falls to zero along half a cosine.
        depth_loss, depth_weight, silhouette, silhouette_weight: as in completion.
        offset: distance of the initial code from the true one, over the length of the true one.
    """

    resolution: int
    iterations: int
    learning_rate: float
    depth_loss: str
    depth_weight: float
    silhouette: SilhouetteLoss
    silhouette_weight: float
    offset: float

    def __post_init__(self) -> None:
        check_at_least("task.fit.resolution", self.resolution, 4, "20 takes seconds")
        check_choice("task.fit.depth_loss", self.depth_loss, DEPTH_LOSSES)
        check_positive("task.fit.offset", self.offset, "1 is as far as the mean shape")
        OptimiserSettings(self.iterations, self.learning_rate, "cosine")


@dataclass(frozen=True)
class Conditions:
    """The conditions of all trials: W of a W x W rendering, the fit, criteria, limits, device, and any prior."""

    resolution: int
    fit: FitSettings
    criteria: Criteria
    limits: Limits
    device: torch.device
    prior: Prior | None


class Failure(StrEnum):
    """How a trial failed; NONE for a success."""

    NONE = ""
    LOST = "lost"
    FALSE = "false"
    WRONG = "wrong surface"
    NAN = "nan"
    SIGN = "gradient sign"
    DIRECTION = "gradient direction"
    SCALE = "gradient scale"
    DIVERGED = "diverged"
    NOT_REACHED = "not reached"
    TIMEOUT = "timeout"
    OOM = "out of memory"
    CRASHED = "crashed"


@dataclass(frozen=True)
class Outcome:
    """The outcome of a trial: its failure, numbers, images [height, width] of rendering and truth, an error message."""

    failure: Failure
    numbers: dict[str, float] = field(default_factory=dict)
    images: dict[str, np.ndarray] = field(default_factory=dict)
    message: str = ""

    @property
    def success(self) -> bool:
        return self.failure is Failure.NONE


@dataclass(frozen=True)
class Trial:
    """One trial of a search: its level from 0 to 1, its severity, its number at this level, and its outcome."""

    level: float
    severity: float
    repeat: int
    outcome: Outcome
