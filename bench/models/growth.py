"""Early growth: tries candidates from the smallest on, and keeps one where the held-out error falls significantly."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import ceil
from typing import TypeVar

from bench.models.fit import EIKONAL_POINTS, SCREENING, Fitted, Fitter
from bench.models.held_out import HeldOutError
from bench.models.model import Candidate, Evidence
from bench.setup.fields import GrowthSettings
from renderers.field import Field
from renderers.rendering import final_notes

MIN_TRIAL = 8  # iterations, where a quarter of the fit is more than that
# Constants of the model `cost`, in milliseconds of a core, fitted to nine candidates at 256, 1,024 and 4,096 rays;
# it is within a third of the measured times
START, WARM, FIT = 30.0, 1.0, 11.0  # of a start, and of an iteration of a warm start and of a fit without its values
FLOP = 2e-8
OVERHEAD = 12_000  # FLOPs per value beyond the field's own
PER_RAY, PER_POINT, PER_WARM_POINT = 6.6, 6, 2  # field values, with their backward passes counted as values

T = TypeVar("T")


@dataclass
class Trials:
    """The trials of candidates, in order: all of them, and those of the ones that were kept, the last one best."""

    tried: list[Evidence] = field(default_factory=list)
    kept: list[Evidence] = field(default_factory=list)
    without_gain: int = 0  # successive trials since the last one that was kept


def climb(
    candidates: Iterable[T], trial: Callable[[T, Trials], Evidence | None], *, patience: int, footprint: float = 0.0
) -> Trials:
    """Tries candidates from the smallest on, and keeps each that is better than the last one kept.

    Better is a held-out error that is lower by more than the standard error of the difference over the same groups of
    rays or pixels. That is the noise of what is held out alone: another start may end with another error.

    Args:
        candidates: the smallest first.
        trial: the result of a candidate's trial, given those before; None skips the candidate.
        patience: successive candidates that may be tried without gain.
        footprint: error under which no larger one is tried.
    """
    trials = Trials()
    for candidate in candidates:
        if trials.kept and (trials.kept[-1].mean <= footprint or trials.without_gain == patience):
            break
        evidence = trial(candidate, trials)
        if evidence is None:
            continue
        trials.tried.append(evidence)
        trials.without_gain += 1
        if not trials.kept or _is_better(evidence, trials.kept[-1]):
            trials.kept.append(evidence)
            trials.without_gain = 0
    return trials


@dataclass
class Growth:
    """The result of early growth.

    Args:
        first, initial_error: the field of the first candidate after its warm start, and its held-out error.
        tried: every candidate, in order, as far as it was fitted.
        footprint: half a pixel, in scene units, under which growth ends.
        end: why no larger candidate was tried, where the error is above the footprint.
        fields: of the candidates that were kept, by name, in order; the last one after its whole fit.
    """

    fitted: Fitted
    first: Field
    initial_error: HeldOutError | None
    tried: list[Evidence]
    fields: dict[str, Field]
    footprint: float
    end: str

    def summary(self, requested: str) -> list[str]:
        """The result, in words."""
        error = self.fitted.evidence.mean
        path, size = " -> ".join(self.fields), self.fitted.model.size
        found = f"field={requested}: {path}, {size}, held-out error {error:.3g}"
        if error <= self.footprint:
            return [found, *final_notes(self.fitted.renderer)]
        above = f"above half a pixel ({self.footprint:.3g}): {self.end}; more iterations may help"
        return [f"{found}, {above}", *final_notes(self.fitted.renderer)]

    @property
    def overhead(self) -> float:
        """Seconds of all fits together over those of the final candidate's fit."""
        return self.total("seconds") / max(self.fitted.evidence.seconds, 1e-9)

    def total(self, name: str) -> float:
        """The sum over all fits of a cost in Evidence."""
        return sum(getattr(evidence, name) for evidence in self.tried)


def grow(fitter: Fitter, candidates: list[Candidate], settings: GrowthSettings) -> Growth:
    """Tries candidates from the smallest on, each beginning from the last one kept, and fits that one completely.

    Growth ends where the error is below the footprint or patience ends; candidates whose trial would exceed the budget
    are skipped.
    """
    whole, footprint = fitter.settings.iterations, fitter.observations.footprint
    short = min(max(ceil(settings.trial * whole), MIN_TRIAL), ceil(whole / 4))
    _load()
    smallest, end = fitter.begin(candidates[0], None), "there is no larger candidate"
    first, initial_error = smallest.model.frozen(), smallest.evidence.error
    fits = {candidates[0].name: smallest}

    def trial(candidate: Candidate, trials: Trials) -> Evidence | None:
        nonlocal end
        if trials.kept:
            now = fits[trials.kept[-1].candidate]
            others = sum(cost(fits[one.candidate].candidate, short, fitter) for one in trials.tried)
            others -= cost(now.candidate, short, fitter)
            kept, gone = (cost(one, whole, fitter) * (settings.budget - 1) for one in (now.candidate, candidate))
            if others + cost(candidate, short, fitter) > kept or others + cost(now.candidate, short, fitter) > gone:
                end = "larger ones would exceed models.growth.budget"
                return None
            fits[candidate.name] = fitter.begin(candidate, now.model, evaluate=False)
        fitter.fit(fits[candidate.name], short, checkpoints=False)
        return fits[candidate.name].evidence

    trials = climb(candidates, trial, patience=settings.patience, footprint=footprint)
    last = fits[trials.kept[-1].candidate]
    if trials.without_gain == settings.patience:
        end = f"{trials.without_gain} larger ones were no better"
    fitter.fit(last, whole - short, checkpoints=False)
    fields = {one.candidate: fits[one.candidate].model.frozen() for one in trials.kept}
    return Growth(last, first, initial_error, trials.tried, fields, footprint, end)


def cost(candidate: Candidate, iterations: int, fitter: Fitter) -> float:
    """An estimate of the cost of a warm start and `iterations` iterations, in milliseconds; not measured by a clock."""
    settings, whole = fitter.settings, 1 + (candidate.tries / SCREENING if candidate.tries > 1 else 0)
    values = PER_RAY * fitter.observations.rays + PER_POINT * EIKONAL_POINTS
    warm = WARM + PER_WARM_POINT * settings.warm_points * candidate.flops * FLOP
    start = candidate.tries * START + settings.warm_iterations * whole * warm
    return start + iterations * (FIT + values * (candidate.flops + OVERHEAD) * FLOP)


def _load() -> None:
    """Imports slow modules beforehand, so that their seconds do not count for the first candidate."""
    import scipy.cluster.vq  # noqa: F401
    import trimesh  # noqa: F401


def _is_better(new: Evidence, old: Evidence) -> bool:
    if new.error is None or old.error is None:
        return old.error is None and new.error is not None
    return old.mean - new.mean > new.error.noise_of_difference(old.error)
