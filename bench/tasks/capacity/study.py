"""Fits all candidates to one shape, chooses the smallest sufficient candidate, and checks that choice."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from bench.pictures.size_chart import CONFIRMED_FROM
from bench.tasks.capacity.fit import Fitted, Fitter
from bench.tasks.capacity.held_out import HeldOutError
from bench.tasks.capacity.model import Candidate, Evidence
from bench.tasks.capacity.observations import Views
from renderers.checks import check_at_least
from renderers.rendering import Renderer


@dataclass(frozen=True)
class CheckSettings:
    """Settings of the check of a choice on further views.

    Args:
        views: number of further views.
        seeds: number of random draws of `drawn` views.
    """

    views: int
    seeds: int
    drawn: int

    def __post_init__(self) -> None:
        check_at_least("task.checks.seeds", self.seeds, 1, "20 resolve 95 %")
        check_at_least("task.checks.drawn", self.drawn, 2, "8 give a standard error")
        check_at_least("task.checks.views", self.views, self.drawn, f"{3 * self.drawn} give different draws")


@dataclass(frozen=True)
class Choice:
    """The chosen candidate, the best candidate, and the rules that the chosen one fulfils."""

    chosen: Evidence
    best: Evidence
    confirmed: bool  # it suffices on further views too; if no candidate does, the best one is chosen
    measure: str  # the measure of size
    within: bool  # the error is within one standard error of the best
    enough: bool  # the error is below the footprint


def fit_all(fitter: Fitter, candidates: list[Candidate], rounds: int = 1) -> Iterator[Fitted]:
    """Fits every candidate in at most `rounds` rounds; each may start from the best candidate before it."""
    fitter, best = replace(fitter, stage="fit_all"), None
    for candidate in candidates:
        fitted = fitter.begin(candidate, None if best is None else best.model)
        fitter.finish(fitted, rounds)
        if not fitted.failed and (best is None or fitted.evidence.mean < best.evidence.mean):
            best = fitted
        yield fitted


def check(fits: list[Fitted], views: Views, settings: CheckSettings, *, seed: int) -> None:
    """Adds to the evidence of each fit the fractions of draws of further views on which it suffices; see `shares`."""
    further = views.further(settings.views, seed)
    fitted = [fit for fit in fits if not fit.failed]
    errors = [further.error(fit.model.frozen(), views.renderer) for fit in fitted]
    for fit, error in zip(fitted, errors, strict=True):
        within, enough = shares(error, errors, settings, footprint=views.footprint, seed=seed)
        fit.evidence.held_within, fit.evidence.held_enough = within, enough


def refit(chosen: Fitted, fitter: Fitter, renderer: Renderer, *, fewest_rays: float) -> Evidence:
    """Fits a candidate again from the same start, at pixel precision, with a number of rays that follows the loss.

    The fit starts with a fraction of the rays. It has as many rounds as the first fit, and the same evaluation.
    """
    settings = replace(fitter.settings, fewest_rays=fewest_rays)
    observations = fitter.observations.with_renderer(renderer)
    frugal = replace(fitter, settings=settings, observations=observations, stage="frugal", spent={})
    fitted = frugal.begin(chosen.candidate, chosen.previous, evaluate=False)
    fitted_iterations = 0
    while fitted_iterations < chosen.evidence.iterations:  # the rounds of `Fitter.finish`
        frugal.fit(fitted, max(fitted_iterations, settings.iterations), checkpoints=False)
        fitted_iterations += max(fitted_iterations, settings.iterations)
    if not fitted.failed:
        fitted.evidence.error = fitter.observations.error(fitted.model.frozen())
    return fitted.evidence


def shares(
    chosen: HeldOutError, candidates: list[HeldOutError], settings: CheckSettings, *, footprint: float, seed: int
) -> tuple[float, float]:
    """The fractions of random draws of views on which a candidate is as good as the best, and below the footprint.

    Args:
        footprint: half a pixel, in scene units.
    """
    draw, within, enough = np.random.default_rng([seed, 4]), 0, 0
    for _ in range(settings.seeds):
        drawn = draw.choice(settings.views, settings.drawn, replace=False)
        best = min((error.select(drawn) for error in candidates), key=lambda error: error.mean)
        within += is_as_good(chosen.select(drawn), best)
        enough += chosen.select(drawn).mean <= footprint
    return within / settings.seeds, enough / settings.seeds


def choose(evidence: list[Evidence], footprint: float, measure: str) -> Choice:
    """The smallest candidate within one standard error of the best (Breiman et al. 1984), or below the footprint.

    The rule must also hold on `CONFIRMED_FROM` of the draws of further views, if these were checked. The footprint is
    half a pixel (DIST, Eq. 10), in scene units; `measure` is a measure of `models.size`.

    Raises:
        ValueError: all fits failed.
    """
    successful = [candidate for candidate in evidence if candidate.error is not None]
    if not successful:
        raise ValueError(
            f"all fits failed; the last: {evidence[-1].reason}; try other models.candidates or another renderer"
        )
    best = min(successful, key=lambda candidate: candidate.mean)
    sufficient = [fit for fit in successful if is_as_good(fit.error, best.error) or fit.mean <= footprint]
    confirmed = [fit for fit in sufficient if is_confirmed(fit, best, footprint)]
    chosen = min(confirmed or [best], key=lambda candidate: (candidate.size.by(measure), candidate.mean))
    within, enough = is_as_good(chosen.error, best.error), chosen.mean <= footprint
    return Choice(chosen, best, bool(confirmed), measure, within, enough)


def is_confirmed(fit: Evidence, best: Evidence, footprint: float) -> bool:
    """Whether a rule that a candidate fulfils also holds on further views; true if these were not checked."""
    held = [fit.held_enough] if fit.mean <= footprint else []
    held += [fit.held_within] if is_as_good(fit.error, best.error) else []
    return any(fraction is None or fraction >= CONFIRMED_FROM for fraction in held)


def is_as_good(error: HeldOutError, best: HeldOutError) -> bool:
    """Whether an error is within one standard error of the best."""
    return error.mean <= best.mean + best.standard_error
