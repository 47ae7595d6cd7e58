"""Early growth: from the smallest rung on, only while the held-out error falls by more than its noise."""

from dataclasses import dataclass
from math import ceil

from bench.ladder.choice import Evidence
from bench.ladder.fit import Fitted, Fitter
from bench.ladder.model import Rung
from bench.ladder.settings import GrowthSettings
from renderers.field import Field

OVERHEAD = 30_000  # FLOPs: what a query costs besides its field's own (measured on two cores: 0.6 us at 50 GFLOP/s)


@dataclass
class Growth:
    """What was tried, and what it ended on.

    Args:
        fitted: the rung that it ended on, fitted to the end.
        first: the field of the first rung as it began.
        tried: every rung in its turn, as far as it was fitted.
        fields: those of the rungs that it stood on, by name, one after the other; the last one at its end.
    """

    fitted: Fitted
    first: Field
    tried: list[Evidence]
    fields: dict[str, Field]

    def told(self, asked: str) -> str:
        """What it came to, in words."""
        error = self.fitted.evidence.mean
        return (
            f"field={asked}: {' -> '.join(self.fields)}, {self.fitted.model.size} numbers, held-out error {error:.3g}"
        )

    @property
    def overhead(self) -> float:
        """Seconds of all fits together over those of the fit that it ended on, which are its whole budget."""
        return self.seconds / max(self.fitted.evidence.seconds, 1e-9)

    @property
    def seconds(self) -> float:
        """Of all fits together, without looks."""
        return sum(evidence.seconds for evidence in self.tried)

    @property
    def evaluations(self) -> int:
        """Field values of all fits together."""
        return sum(evidence.evaluations for evidence in self.tried)

    @property
    def gradients(self) -> int:
        """Gradient evaluations of all fits together."""
        return sum(evidence.gradients for evidence in self.tried)

    @property
    def flops(self) -> int:
        """Of all fits together."""
        return sum(evidence.flops for evidence in self.tried)


@dataclass
class _Standing:
    """Where growth stands."""

    fitted: Fitted
    rung: Rung
    vain: float = 0.0  # cost, in FLOPs a query times shares of a fit


def grow(fitter: Fitter, rungs: list[Rung], settings: GrowthSettings) -> Growth:
    """Tries rungs from the smallest on, keeps those that are better, and fits the last to the end.

    A rung is better where its held-out error is less than that of the one before by more than the standard error of the
    difference, over the same rays. Growth ends where the error is below the footprint, or before the next rung would
    bring what was tried in vain above its share of the present rung's fit.

    Args:
        fitter: fits them.
        rungs: the smallest first.
        settings: how far to look ahead.

    Raises:
        ValueError: where no rung can be fitted.
    """
    whole = fitter.settings.iterations
    trial = max(ceil(settings.trial * whole), 1)
    share = trial / whole + fitter.warm_share
    tried: list[Evidence] = []
    now: _Standing | None = None
    first: Field | None = None
    fields: dict[str, Field] = {}
    for place in rungs:
        cost = (place.flops + OVERHEAD) * share
        if now is not None and now.vain + cost > settings.vain * (now.rung.flops + OVERHEAD):
            break
        fitted = fitter.begin(place, None if now is None else now.fitted.model)
        tried.append(fitted.evidence)
        first = first or fitted.model.frozen()
        fitter.fit(fitted, trial, schedule="ramped", looks=False)
        if now is None or _is_better(fitted, now.fitted):
            now = _Standing(fitted, place)
            fields[place.name] = fitted.model.frozen()
        else:
            now.vain += cost
        if now.fitted.evidence.mean <= fitter.observations.footprint:
            break
    if now is None or first is None:
        raise ValueError("no rung can be fitted: ladder.rungs is empty")
    fitter.fit(now.fitted, whole - trial, schedule="ramped", looks=True)
    fields[now.rung.name] = now.fitted.model.frozen()
    return Growth(now.fitted, first, tried, fields)


def _is_better(new: Fitted, old: Fitted) -> bool:
    if new.evidence.error is None or old.evidence.error is None:
        return old.evidence.error is None and new.evidence.error is not None
    return old.evidence.mean - new.evidence.mean > new.evidence.error.noise_of_difference(old.evidence.error)
