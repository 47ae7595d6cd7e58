"""What a trial came to."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from renderers.checks import check_positive


class Failure(StrEnum):
    """How a trial failed; none where it did not."""

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
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"task.criteria.{name} must lie above 0 and up to 1, not {getattr(self, name)}: 0.99")
        for name in ("false_hits", "scale", "surface_error"):
            check_positive(f"task.criteria.{name}", getattr(self, name), "0.01 is strict")


@dataclass(frozen=True)
class Outcome:
    """How a trial ended: its failure, its numbers, and images [height, width] of what was found and is true."""

    failure: Failure
    numbers: dict[str, float] = field(default_factory=dict)
    images: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def success(self) -> bool:
        """Whether it did not fail."""
        return self.failure is Failure.NONE
