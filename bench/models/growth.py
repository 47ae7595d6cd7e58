"""Early growth: tries candidates from the smallest on, and keeps one where the held-out error falls significantly."""

from dataclasses import dataclass
from math import ceil

from bench.models.choice import Evidence
from bench.models.fit import EIKONAL_POINTS, SCREENING, Fitted, Fitter
from bench.models.held_out import HeldOutError
from bench.models.model import Candidate
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


@dataclass
class Growth:
    """The result of early growth.

    Args:
        fitted: the final candidate, fitted completely.
        first, initial_error: the field of the first candidate after its warm start, and its held-out error.
        tried: every candidate that was tried, in order, as far as it was fitted.
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
        if not self.footprint or error <= self.footprint:
            return [found, *final_notes(self.fitted.renderer)]
        above = f"above half a pixel ({self.footprint:.3g}): {self.end}; more iterations may help"
        return [f"{found}, {above}", *final_notes(self.fitted.renderer)]

    @property
    def overhead(self) -> float:
        """Seconds of all fits together over those of the final candidate's fit."""
        return self.total("seconds") / max(self.fitted.evidence.seconds, 1e-9)

    @property
    def overhead_judged(self) -> float:
        """The same with evaluations on held-out rays and with finding the starts."""
        return self.total("wall") / max(self.fitted.evidence.wall, 1e-9)

    def total(self, name: str) -> float:
        """The sum over all fits of a cost in Evidence: checkpoints count in `wall` only."""
        return sum(getattr(evidence, name) for evidence in self.tried)


def grow(fitter: Fitter, candidates: list[Candidate], settings: GrowthSettings) -> Growth:
    """Tries candidates from the smallest on, keeps those that are better, and fits the last one kept completely.

    A candidate is better where its held-out error is below that of the last one kept by more than the standard error
    of the difference, over the same rays. Growth ends where the error is below the footprint or patience ends;
    candidates whose trial would exceed the budget are skipped.

    Args:
        fitter: fits the candidates.
        candidates: the smallest first.
        settings: of trials, patience and budget.
    """
    whole = fitter.settings.iterations
    trial = min(max(ceil(settings.trial * whole), MIN_TRIAL), ceil(whole / 4))
    _load()
    now, end = fitter.begin(candidates[0], None), "there is no larger candidate"
    first, initial_error = now.model.frozen(), now.initial_error
    fitter.fit(now, trial, checkpoints=False)
    tried, fields, without_gain, others = [now.evidence], {now.candidate.name: now.model.frozen()}, 0, 0.0
    for larger in candidates[1:]:
        if now.evidence.mean <= fitter.observations.footprint or without_gain == settings.patience:
            break
        kept, gone = (cost(candidate, whole, fitter) * (settings.budget - 1) for candidate in (now.candidate, larger))
        if others + cost(larger, trial, fitter) > kept or others + cost(now.candidate, trial, fitter) > gone:
            end = "larger ones would exceed models.growth.budget"
            continue
        fitted = fitter.begin(larger, now.model, evaluate=False)
        fitter.fit(fitted, trial, checkpoints=False)
        tried.append(fitted.evidence)
        better = _is_better(fitted.evidence, now.evidence)
        others += cost(now.candidate if better else larger, trial, fitter)
        without_gain = 0 if better else without_gain + 1
        if better:
            now = fitted
            fields[larger.name] = now.model.frozen()
    end = f"{without_gain} larger ones were no better" if without_gain == settings.patience else end
    fitter.fit(now, whole - trial, checkpoints=False)
    fields[now.candidate.name] = now.model.frozen()
    return Growth(now, first, initial_error, tried, fields, fitter.observations.footprint, end)


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
