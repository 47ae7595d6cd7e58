"""Early growth: from the smallest rung on, only while the held-out error falls by more than its noise."""

from dataclasses import dataclass
from math import ceil

import torch

from bench.ladder.choice import Evidence
from bench.ladder.fit import EIKONAL_POINTS, SCREENING, Fitted, Fitter
from bench.ladder.held_out import HeldOutError
from bench.ladder.model import Rung
from bench.ladder.settings import GrowthSettings
from bench.thickness import ending
from renderers.field import Field

LEAST_TRIAL = 8  # iterations, where a quarter of the fit is more than that
# What `cost` counts by, in milliseconds of a core: measured on nine rungs at 256, 1,024 and 4,096 rays, within a third
START, WARM, FIT = 30.0, 1.0, 11.0  # a start; an iteration of a warm start and of a fit, whatever it asks of the field
FLOP = 2e-8
OVERHEAD = 12_000  # FLOPs: what asking for a value costs besides the field's own
PER_RAY, PER_POINT, PER_WARM_POINT = 6.6, 6, 2  # values' worth that are asked, the way back with them


@dataclass
class Growth:
    """What was tried, and what it ended on.

    Args:
        fitted: the rung that it ended on, fitted to the end.
        first, begun: the field of the first rung as it began, and its held-out error.
        tried: every rung in its turn, as far as it was fitted.
        footprint: half a pixel, in scene units, under which growth ends.
        end: why no larger rung was tried, where the error is above the footprint.
        fields: those of the rungs that it stood on, by name, one after the other; the last one at its end.
    """

    fitted: Fitted
    first: Field
    begun: HeldOutError | None
    tried: list[Evidence]
    fields: dict[str, Field]
    footprint: float
    end: str

    def told(self, asked: str) -> list[str]:
        """What it came to, in words."""
        error = self.fitted.evidence.mean
        told = (
            f"field={asked}: {' -> '.join(self.fields)}, {self.fitted.model.size} numbers, held-out error {error:.3g}"
        )
        if not self.footprint or error <= self.footprint:
            return [told, *ending(self.fitted.renderer)]
        above = f"above half a pixel ({self.footprint:.3g}): {self.end}; more iterations may help"
        return [f"{told}, {above}", *ending(self.fitted.renderer)]

    @property
    def overhead(self) -> float:
        """Seconds of all fits together over those of the fit that it ended on."""
        return self.total("seconds") / max(self.fitted.evidence.seconds, 1e-9)

    @property
    def overhead_judged(self) -> float:
        """The same of all that was done: with looks at held-out rays, and with what it takes to begin."""
        return self.total("wall") / max(self.fitted.evidence.wall, 1e-9)

    def total(self, name: str) -> float:
        """Of all fits together: seconds, evaluations, gradients or flops, without looks; or wall, with them."""
        return sum(getattr(evidence, name) for evidence in self.tried)


def grow(fitter: Fitter, rungs: list[Rung], settings: GrowthSettings) -> Growth:
    """Tries rungs from the smallest on, keeps those that are better, and fits the last to the end.

    A rung is better where its held-out error is less than that of the one before by more than the standard error of the
    difference, over the same rays. Growth ends where the error is below the footprint or patience ends; rungs whose
    trial would take the whole above its budget are passed over.

    Args:
        fitter: fits them.
        rungs: the smallest first.
        settings: how far to look ahead.
    """
    whole = fitter.settings.iterations
    trial = min(max(ceil(settings.trial * whole), LEAST_TRIAL), ceil(whole / 4))
    _load()
    now, end = fitter.begin(rungs[0], None), "the ladder has no more"
    first, begun = now.model.frozen(), now.begun
    fitter.fit(now, trial, looks=False)
    tried, fields, vain, others = [now.evidence], {now.rung.name: now.model.frozen()}, 0, 0.0
    for larger in rungs[1:]:
        if now.evidence.mean <= fitter.observations.footprint or vain == settings.patience:
            break
        kept, gone = (cost(one, whole, fitter) * (settings.budget - 1) for one in (now.rung, larger))
        if others + cost(larger, trial, fitter) > kept or others + cost(now.rung, trial, fitter) > gone:
            end = "others would take more than ladder.growth.budget"
            continue
        fitted = fitter.begin(larger, now.model, look=False)
        fitter.fit(fitted, trial, looks=False)
        tried.append(fitted.evidence)
        better = _is_better(fitted, now)
        others += cost(now.rung if better else larger, trial, fitter)
        vain = 0 if better else vain + 1
        if better:
            now = fitted
            fields[larger.name] = now.model.frozen()
    end = f"{vain} larger ones were no better" if vain == settings.patience else end
    fitter.fit(now, whole - trial, looks=False)
    fields[now.rung.name] = now.model.frozen()
    return Growth(now, first, begun, tried, fields, fitter.observations.footprint, end)


def cost(rung: Rung, iterations: int, fitter: Fitter) -> float:
    """About what a warm start and so many iterations cost, in milliseconds; no clock is asked."""
    settings, whole = fitter.settings, 1 + (rung.tries / SCREENING if rung.tries > 1 else 0)
    asked = PER_RAY * fitter.observations.rays + PER_POINT * EIKONAL_POINTS
    warm = WARM + PER_WARM_POINT * settings.warm_points * rung.flops * FLOP
    begun = rung.tries * START + settings.warm_iterations * whole * warm
    return begun + iterations * (FIT + asked * (rung.flops + OVERHEAD) * FLOP)


def _load() -> None:
    """Loads what is loaded at the first use, seconds that the first rung is not charged with."""
    import scipy.cluster.vq  # noqa: F401
    import trimesh  # noqa: F401

    torch.optim.Adam([torch.zeros(1)])


def _is_better(new: Fitted, old: Fitted) -> bool:
    if new.evidence.error is None or old.evidence.error is None:
        return old.evidence.error is None and new.evidence.error is not None
    return old.evidence.mean - new.evidence.mean > new.evidence.error.noise_of_difference(old.evidence.error)
