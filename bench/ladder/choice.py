"""Which rung a scene needs: the smallest that is as good as the best, or as good as a pixel can tell."""

from dataclasses import dataclass, field
from math import inf

from bench.ladder.held_out import HeldOutError
from bench.records import RunStatus


@dataclass
class Evidence:
    """What a rung's fit came to.

    Args:
        rung: its name.
        parameters: free numbers.
        bytes: that it takes to keep the field.
        flops_per_query: floating-point operations a value.
        error: on held-out rays; None where the fit failed.
        status, reason: how the fit ended.
        seconds, evaluations, gradients, flops: of the fit with its warm start, without looks.
        wall: seconds of all that it took, with starts and looks.
        iterations: of the fit, without its warm start.
        looks: on the way: seconds, evaluations, flops and error at each.
    """

    rung: str
    parameters: int
    bytes: int
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
    looks: list[dict[str, float]] = field(default_factory=list)

    @property
    def mean(self) -> float:
        """Its error; infinite where there is none."""
        return inf if self.error is None else self.error.mean


@dataclass(frozen=True)
class Choice:
    """The recommended rung, the best one, and by which rule."""

    chosen: Evidence
    best: Evidence
    within: bool  # one standard error of the best
    enough: bool  # under the footprint


def choose(evidence: list[Evidence], footprint: float) -> Choice:
    """The smallest rung within one standard error of the best (Breiman et al. 1984), or under the footprint.

    Args:
        evidence: of all rungs.
        footprint: half a pixel (DIST, Eq. 10), in scene units.

    Raises:
        ValueError: where all fits failed.
    """
    known = [rung for rung in evidence if rung.error is not None]
    if not known:
        raise ValueError(
            f"all fits failed; the last: {evidence[-1].reason}; other ladder.rungs or another renderer may do"
        )
    best = min(known, key=lambda rung: rung.mean)
    fit = [rung for rung in known if is_as_good(rung.error, best.error) or rung.mean <= footprint]
    chosen = min(fit, key=lambda rung: (rung.parameters, rung.mean))
    return Choice(chosen, best, is_as_good(chosen.error, best.error), chosen.mean <= footprint)


def is_as_good(error: HeldOutError, best: HeldOutError) -> bool:
    """Within one standard error of the best."""
    return error.mean <= best.mean + best.standard_error
