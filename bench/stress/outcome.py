"""What a trial came to."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np


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
    CRASHED = "crashed"


@dataclass(frozen=True)
class Outcome:
    """How a trial ended: its failure, its numbers, images [height, width] of what was found and is true, an error."""

    failure: Failure
    numbers: dict[str, float] = field(default_factory=dict)
    images: dict[str, np.ndarray] = field(default_factory=dict)
    message: str = ""

    @property
    def success(self) -> bool:
        """Whether it did not fail."""
        return self.failure is Failure.NONE


@dataclass(frozen=True)
class Trial:
    """One trial of a search: at which level from 0 to 1, and what it came to."""

    level: float
    severity: float
    outcome: Outcome
