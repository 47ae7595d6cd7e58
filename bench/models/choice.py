"""Chooses a candidate: the smallest within one standard error of the best, or whose error is under half a pixel."""

from dataclasses import dataclass, field
from math import inf

from bench.models.held_out import HeldOutError
from bench.models.model import Size
from bench.records.record import RunStatus


@dataclass
class Evidence:
    """The result of a candidate's fit, and its cost.

    Args:
        candidate: its name.
        size: its free and its stored numbers.
        flops_per_query: floating-point operations per value.
        error: on held-out rays; None where the fit failed.
        status, reason: how the fit ended.
        seconds, evaluations, gradients, flops: of the fit with its warm start, without checkpoints.
        wall: seconds in all, with starts and checkpoints.
        iterations: of the fit, without its warm start.
        checkpoints: seconds, evaluations, gradients, flops and error at each checkpoint.
    """

    candidate: str
    size: Size
    flops_per_query: int
    error: HeldOutError | None = None
    status: RunStatus = RunStatus.OK
    reason: str = ""
    seconds: float = 0.0
    evaluations: int = 0
    gradients: int = 0
    flops: int = 0
    wall: float = 0.0
    iterations: int = 0
    checkpoints: list[dict[str, float]] = field(default_factory=list)

    @property
    def mean(self) -> float:
        """The mean error on held-out rays; infinite where the fit failed."""
        return inf if self.error is None else self.error.mean


@dataclass(frozen=True)
class Choice:
    """The recommended candidate, the best one, and which rules the recommended one fulfils."""

    chosen: Evidence
    best: Evidence
    measure: str  # of size, by which it is the smallest
    within: bool  # its error is within one standard error of the best one's
    enough: bool  # its error is under the footprint


def choose(evidence: list[Evidence], footprint: float, measure: str) -> Choice:
    """The smallest candidate within one standard error of the best (Breiman et al. 1984), or under the footprint.

    Args:
        evidence: of all candidates.
        footprint: half a pixel (DIST, Eq. 10), in scene units.
        measure: of size, see `models.size`.

    Raises:
        ValueError: where all fits failed.
    """
    known = [candidate for candidate in evidence if candidate.error is not None]
    if not known:
        raise ValueError(
            f"all fits failed; the last: {evidence[-1].reason}; try other models.candidates or another renderer"
        )
    best = min(known, key=lambda candidate: candidate.mean)
    fit = [candidate for candidate in known if is_as_good(candidate.error, best.error) or candidate.mean <= footprint]
    chosen = min(fit, key=lambda candidate: (candidate.size.by(measure), candidate.mean))
    return Choice(chosen, best, measure, is_as_good(chosen.error, best.error), chosen.mean <= footprint)


def is_as_good(error: HeldOutError, best: HeldOutError) -> bool:
    """Whether an error is within one standard error of the best."""
    return error.mean <= best.mean + best.standard_error
