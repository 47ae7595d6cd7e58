"""What `auto` saves on a scene, in numbers: early growth, the frugal fit, and rendering at pixel precision."""

from dataclasses import dataclass
from functools import cached_property

from bench.report.parsimony_runs import NETWORK, SceneRun, over

COSTS = ("seconds", "flops", "evaluations")
REACHED, NOT_REACHED, FAILED, NOT_FITTED = "reached", "not reached", "failed", "not fitted"


@dataclass(frozen=True)
class Saving:
    """What `auto` saves on a scene."""

    run: SceneRun

    @property
    def state(self) -> str:
        """Whether the papers' network came to the error of field=auto; empty where there is no such error."""
        network = self.run.ladder.rung(NETWORK)
        if not self.run.ok or self.run.number("auto.error") is None:
            return ""
        if network is None:
            return NOT_FITTED
        if network.numbers.get("seconds_at_auto") is not None:
            return REACHED
        return FAILED if network.error is None else NOT_REACHED

    @cached_property
    def network(self) -> dict[str, float | None]:
        """What the network spent until then, or in all of its fit where it did not come to it."""
        names = {REACHED: "{}_at_auto", NOT_REACHED: "{}", FAILED: "{}"}
        if self.state not in names:
            return dict.fromkeys(COSTS)
        return {cost: self.run.number(f"{NETWORK}.{names[self.state].format(cost)}") for cost in COSTS}

    def ratio(self, cost: str) -> float | None:
        """The network's cost over auto's: at least that where it was not reached."""
        bounded = self.state in (REACHED, NOT_REACHED)
        return over(self.network[cost], self.run.number(f"auto.{cost}")) if bounded else None

    def frugal(self, name: str) -> float | None:
        """The frugal fit's number over the plain fit's; of a failed fit there is none."""
        chosen = self.run.ladder.chosen
        if chosen is None or self.run.number("frugal.error") is None:
            return None
        return over(self.run.number(f"frugal.{name}"), chosen.numbers.get(name))

    @property
    def errors(self) -> tuple[float | None, float | None]:
        """Of the recommended rung's plain and frugal fit, in half pixels."""
        plain, frugal = (self.run.number(name) for name in ("recommended_error", "frugal.error"))
        return self.run.in_footprints(plain), self.run.in_footprints(frugal)

    def failure(self, name: str) -> str:
        """The status of a fit that failed; empty for others."""
        return (self.run.word(f"{name}.failed") or "").partition(":")[0]

    @property
    def precision(self) -> float | None:
        """The share of evaluations that rendering at pixel precision saves."""
        share = over(self.run.number("precision.evaluations_auto"), self.run.number("precision.evaluations"))
        return None if share is None else 1 - share
