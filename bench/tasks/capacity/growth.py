"""Early growth: tries candidates by size, and keeps a candidate that lowers the held-out error significantly."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import ceil, inf
from typing import TypeVar

from bench.tasks.capacity.fit import EIKONAL_POINTS, SCREENING, Fitted, Fitter
from bench.tasks.capacity.held_out import HeldOutError
from bench.tasks.capacity.model import Candidate, Evidence
from bench.tasks.capacity.settings import GrowthSettings
from renderers.field import Field
from renderers.rendering import final_notes

MIN_TRIAL_ITERATIONS = 8  # unless a quarter of the fit is less
# The model `cost`, in milliseconds of a core, was fitted to nine candidates at 256, 1,024 and 4,096 rays. It is within
# a third of the measured times. Steps are without field evaluations; a backward pass counts as further evaluations.
START_MS, WARM_STEP_MS, FIT_STEP_MS = 30.0, 1.0, 11.0
MS_PER_FLOP, EXTRA_FLOPS_PER_EVALUATION = 2e-8, 12_000
EVALUATIONS_PER_RAY, EVALUATIONS_PER_POINT, EVALUATIONS_PER_WARM_POINT = 6.6, 6, 2

T = TypeVar("T")


@dataclass
class Trials:
    """The trials of candidates, in order: all of them, and those of kept candidates, the best last."""

    tried: list[Evidence] = field(default_factory=list)
    kept: list[Evidence] = field(default_factory=list)
    without_gain: int = 0  # ended trials in a row that did not lower the least error


def climb(
    candidates: Iterable[T], trial: Callable[[T, Trials], Evidence | None], *, patience: int, footprint: float = 0.0
) -> Trials:
    """Tries candidates in order of size, and keeps each candidate that is better than the last kept one.

    A candidate is better if its held-out error is lower by more than the standard error of the difference over the
    same groups of rays or pixels. This covers the noise of the held-out data, not of the start.

    Growth does not end while the held-out error still falls. A candidate with the least error so far begins the count
    of `patience` again, although it is not kept within the noise. A candidate whose error still falls at the end of its
    trial does not count: larger networks learn more slowly, so a short trial does not show that they are no better.

    Args:
        candidates: the smallest first.
        trial: returns the result of a candidate's trial, from the earlier trials; None skips the candidate.
        patience: successive candidates whose trials ended and did not lower the error; then growth ends.
        footprint: no larger candidate is tried below this error.
    """
    trials = Trials()
    for candidate in candidates:
        if trials.kept and (trials.kept[-1].mean <= footprint or trials.without_gain == patience):
            break
        evidence = trial(candidate, trials)
        if evidence is None:
            continue
        is_least = evidence.mean < min((trial.mean for trial in trials.tried), default=inf)
        trials.tried.append(evidence)
        if not trials.kept or _is_better(evidence, trials.kept[-1]):
            trials.kept.append(evidence)
        trials.without_gain = 0 if is_least else trials.without_gain + (not evidence.falling)
    return trials


@dataclass
class Growth:
    """The result of early growth.

    Args:
        first, initial_error: the field of the first candidate after its warm start, and its held-out error.
        tried: the results of all candidates, in order.
        footprint: half a pixel, in scene units; growth ends below this error.
        end: the reason why no larger candidate was tried, if the error is above the footprint.
        fields: of the kept candidates, by name, in order; the last one after its complete fit.
    """

    fitted: Fitted
    first: Field
    initial_error: HeldOutError | None
    tried: list[Evidence]
    fields: dict[str, Field]
    footprint: float
    end: str

    def summary(self, requested: str) -> list[str]:
        error = self.fitted.evidence.mean
        path, size = " -> ".join(self.fields), self.fitted.model.size
        summary = f"field={requested}: {path}, {size}, held-out error {error:.3g}"
        if error <= self.footprint:
            return [summary, *final_notes(self.fitted.renderer)]
        above = f"above half a pixel ({self.footprint:.3g}): {self.end}; more iterations may help"
        return [f"{summary}, {above}", *final_notes(self.fitted.renderer)]

    @property
    def overhead(self) -> float:
        """Seconds of all fits together over those of the final candidate's fit."""
        return self.total("seconds") / max(self.fitted.evidence.seconds, 1e-9)

    def total(self, name: str) -> float:
        """The sum over all fits of a cost in Evidence."""
        return sum(getattr(evidence, name) for evidence in self.tried)


def grow(fitter: Fitter, candidates: list[Candidate], settings: GrowthSettings) -> Growth:
    """Tries candidates in order of size, each from the last kept one, and fits the last kept one completely.

    Growth ends if the error is below the footprint or patience ends. Candidates whose trial would exceed the budget are
    skipped.
    """
    iterations, footprint = fitter.settings.iterations, fitter.observations.footprint
    trial_steps = min(max(ceil(settings.trial * iterations), MIN_TRIAL_ITERATIONS), ceil(iterations / 4))
    _import_slow_modules()
    smallest, end = fitter.begin(candidates[0], None), "there is no larger candidate"
    first, initial_error = smallest.model.frozen(), smallest.evidence.error
    fits = {candidates[0].name: smallest}

    def trial(candidate: Candidate, trials: Trials) -> Evidence | None:
        nonlocal end
        if trials.kept:
            kept = fits[trials.kept[-1].candidate]
            pair = (kept.candidate, candidate)
            old_cost, new_cost = (cost(c, trial_steps, fitter) for c in pair)
            old_limit, new_limit = ((settings.budget - 1) * cost(c, iterations, fitter) for c in pair)
            spent = sum(cost(fits[fit.candidate].candidate, trial_steps, fitter) for fit in trials.tried) - old_cost
            if spent + new_cost > old_limit or spent + old_cost > new_limit:
                end = "larger ones would exceed models.growth.budget"
                return None
            fits[candidate.name] = fitter.begin(candidate, kept.model, evaluate=False)
        fitter.fit(fits[candidate.name], trial_steps, checkpoints=False)
        return fits[candidate.name].evidence

    trials = climb(candidates, trial, patience=settings.patience, footprint=footprint)
    last = fits[trials.kept[-1].candidate]
    if trials.without_gain == settings.patience:
        end = f"{trials.without_gain} larger ones were no better"
    fitter.fit(last, iterations - trial_steps, checkpoints=False)
    fields = {evidence.candidate: fits[evidence.candidate].model.frozen() for evidence in trials.kept}
    return Growth(last, first, initial_error, trials.tried, fields, footprint, end)


def cost(candidate: Candidate, iterations: int, fitter: Fitter) -> float:
    """The estimated cost of a warm start and `iterations` iterations, in milliseconds; nothing is measured."""
    settings, warm_starts = fitter.settings, 1 + (candidate.tries / SCREENING if candidate.tries > 1 else 0)
    evaluations = EVALUATIONS_PER_RAY * fitter.observations.rays + EVALUATIONS_PER_POINT * EIKONAL_POINTS
    warm_step = WARM_STEP_MS + EVALUATIONS_PER_WARM_POINT * settings.warm_points * candidate.flops * MS_PER_FLOP
    start = candidate.tries * START_MS + settings.warm_iterations * warm_starts * warm_step
    return start + iterations * (
        FIT_STEP_MS + evaluations * (candidate.flops + EXTRA_FLOPS_PER_EVALUATION) * MS_PER_FLOP
    )


def _import_slow_modules() -> None:
    """Imports slow modules before the fits, so that the first candidate is not charged for them."""
    import scipy.cluster.vq  # noqa: F401
    import trimesh  # noqa: F401


def _is_better(new: Evidence, old: Evidence) -> bool:
    if new.error is None or old.error is None:
        return old.error is None and new.error is not None
    return old.mean - new.mean > new.error.noise_of_difference(old.error)
