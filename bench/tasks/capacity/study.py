"""Fits all candidates to one shape, chooses the smallest sufficient candidate, and checks that choice."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

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


def check(chosen: Fitted, fits: list[Fitted], views: Views, settings: CheckSettings, *, seed: int) -> dict[str, float]:
    """The fraction of random draws of further views on which the choice holds; see `shares`."""
    further = views.further(settings.views, seed)
    errors = {fit: further.error(fit.model.frozen(), views.renderer) for fit in fits if not fit.failed}
    return shares(errors[chosen], list(errors.values()), settings, footprint=views.footprint, seed=seed)


def refit(chosen: Fitted, fitter: Fitter, renderer: Renderer, *, fewest_rays: float) -> Evidence:
    """Fits a candidate again from the same start, at pixel precision, with a number of rays that follows the loss.

    The fit starts with a fraction of the rays. It has as many rounds as the first fit, and the same evaluation.
    """
    settings = replace(fitter.settings, fewest_rays=fewest_rays)
    observations = fitter.observations.with_renderer(renderer)
    frugal = replace(fitter, settings=settings, observations=observations, stage="frugal", spent={})
    fitted = frugal.begin(chosen.candidate, chosen.previous, evaluate=False)
    for _ in range(chosen.evidence.iterations // settings.iterations):
        frugal.fit(fitted, settings.iterations, checkpoints=False)
    if not fitted.failed:
        fitted.evidence.error = fitter.observations.error(fitted.model.frozen())
    return fitted.evidence


def shares(
    chosen: HeldOutError, candidates: list[HeldOutError], settings: CheckSettings, *, footprint: float, seed: int
) -> dict[str, float]:
    """The fractions of random draws of views on which a choice is as good as the draw's best candidate, and holds.

    Args:
        footprint: half a pixel, in scene units; a choice with an error below it also holds.
    """
    draw, within, holding = np.random.default_rng([seed, 4]), 0, 0
    for _ in range(settings.seeds):
        drawn = draw.choice(settings.views, settings.drawn, replace=False)
        best = min((error.select(drawn) for error in candidates), key=lambda error: error.mean)
        as_good = is_as_good(chosen.select(drawn), best)
        within += as_good
        holding += as_good or chosen.select(drawn).mean <= footprint
    fractions = {"held_out_seeds_within": within / settings.seeds, "held_out_seeds_held": holding / settings.seeds}
    return {"held_out_seeds": settings.seeds, **fractions}


def choose(evidence: list[Evidence], footprint: float, measure: str) -> Choice:
    """The smallest candidate within one standard error of the best (Breiman et al. 1984), or below the footprint.

    The footprint is half a pixel (DIST, Eq. 10), in scene units; `measure` is a measure of `models.size`.

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
    chosen = min(sufficient, key=lambda candidate: (candidate.size.by(measure), candidate.mean))
    return Choice(chosen, best, measure, is_as_good(chosen.error, best.error), chosen.mean <= footprint)


def is_as_good(error: HeldOutError, best: HeldOutError) -> bool:
    """Whether an error is within one standard error of the best."""
    return error.mean <= best.mean + best.standard_error
