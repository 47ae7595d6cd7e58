"""Fits a ladder of fields to one shape, and says which rung the shape needs, and what that saves."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from bench.ladder.choice import Choice, Evidence, choose, is_as_good
from bench.ladder.fit import Fitted, Fitter
from bench.ladder.held_out import HeldOutError
from bench.ladder.model import Rung
from bench.ladder.views import Views
from bench.thickness import finest
from renderers.camera import Rays
from renderers.checks import check_at_least
from renderers.field import Counts, Meter
from renderers.rendering import Renderer


@dataclass(frozen=True)
class CheckSettings:
    """How a choice is checked by views that it has not seen.

    Args:
        views: how many more there are.
        seeds: draws of some of them.
        drawn: how many of them a draw has.
    """

    views: int
    seeds: int
    drawn: int

    def __post_init__(self) -> None:
        check_at_least("task.checks.seeds", self.seeds, 1, "20 can tell 95 %")
        check_at_least("task.checks.drawn", self.drawn, 2, "8 give a standard error")
        check_at_least("task.checks.views", self.views, self.drawn, f"{3 * self.drawn} give draws that differ")


@dataclass
class Study:
    """The fits of all rungs to the same observations.

    Args:
        fitter: to rays, through the renderer as it was asked for.
        frugal: the same renderer, no more precise than a pixel.
        frugal_rays: share of the rays that the frugal fit begins with.
    """

    fitter: Fitter
    frugal: Renderer
    frugal_rays: float
    fits: list[Fitted] = field(default_factory=list)

    def climb(self, rungs: list[Rung]) -> Iterator[Fitted]:
        """Fits every rung, each begun with the best before it where that helps."""
        fitter = replace(self.fitter, part="climb")
        for rung in rungs:
            best = min(self._sound, key=lambda fitted: fitted.evidence.mean, default=None)
            fitted = fitter.begin(rung, None if best is None else best.model)
            fitter.fit(fitted, fitter.settings.iterations, looks=True)
            self.fits.append(fitted)
            yield fitted

    def choose(self) -> tuple[Choice, Fitted]:
        """The rung that is recommended, and its fit."""
        choice = choose([fitted.evidence for fitted in self.fits], self.fitter.observations.footprint)
        return choice, next(fitted for fitted in self.fits if fitted.evidence is choice.chosen)

    def check(self, chosen: Fitted, views: Views, settings: CheckSettings) -> dict[str, float]:
        """On what share of draws of views, unseen by the choice, it holds; the best rung is that of each draw."""
        observations, further = self.fitter.observations, views.further(settings.views, self.fitter.seed)
        renderer = finest(observations.renderer)
        errors = {fitted: further.error(fitted.model.frozen(), renderer) for fitted in self._sound}
        footprint, seed = observations.footprint, self.fitter.seed
        return shares(errors[chosen], list(errors.values()), settings, footprint=footprint, seed=seed)

    def refit(self, chosen: Fitted) -> Evidence:
        """A rung again from where it began, no more precise than a pixel, with the rays that the loss asks for.

        It is judged as all others are.
        """
        settings = replace(self.fitter.settings, fewest_rays=self.frugal_rays)
        observations = self.fitter.observations.through(self.frugal)
        fitter = replace(self.fitter, settings=settings, observations=observations, part="frugal", spent={})
        fitted = fitter.begin(chosen.rung, chosen.previous, look=False)
        fitter.fit(fitted, settings.iterations, looks=False)
        if not fitted.failed:
            fitted.evidence.error = self.fitter.observations.error(fitted.model.frozen())
        return fitted.evidence

    @torch.no_grad()
    def precision(self, fitted: Fitted, rays: Rays) -> dict[str, float]:
        """What rendering rays costs with either renderer, and hits that only one has."""
        plain, shape, counts = self.fitter.observations.renderer, fitted.model.frozen(), (Counts(), Counts())
        hits = [
            finest(renderer).render(Meter(shape, count), rays).hit
            for renderer, count in zip((plain, self.frugal), counts, strict=True)
        ]
        lost, gained = int((hits[0] & ~hits[1]).sum()), int((hits[1] & ~hits[0]).sum())
        return {
            "precision.evaluations": counts[0].value,
            "precision.evaluations_auto": counts[1].value,
            "precision.hits": int(hits[0].sum()),
            "precision.lost": lost,
            "precision.gained": gained,
        }

    @property
    def _sound(self) -> list[Fitted]:
        return [fitted for fitted in self.fits if fitted.evidence.error is not None]


def shares(
    chosen: HeldOutError, rungs: list[HeldOutError], settings: CheckSettings, *, footprint: float, seed: int
) -> dict[str, float]:
    """On what share of draws of views a choice is as good as the draw's best rung; on what share it holds.

    Args:
        chosen: its errors in all views.
        rungs: those of all rungs.
        settings: how many draws of how many views.
        footprint: half a pixel, in scene units, under which a choice holds as well.
        seed: of the draws.
    """
    draw, within, held = np.random.default_rng([seed, 4]), 0, 0
    for _ in range(settings.seeds):
        drawn = draw.choice(settings.views, settings.drawn, replace=False)
        best = min((error.some(drawn) for error in rungs), key=lambda error: error.mean)
        as_good = is_as_good(chosen.some(drawn), best)
        within += as_good
        held += as_good or chosen.some(drawn).mean <= footprint
    found = {"held_out_seeds_within": within / settings.seeds, "held_out_seeds_held": held / settings.seeds}
    return {"held_out_seeds": settings.seeds, **found}
