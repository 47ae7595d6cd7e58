"""The fields to choose from, by name, and the settings of their fits."""

import re
from collections.abc import Callable
from dataclasses import dataclass

from bench.config import nearest
from bench.models.analytic import PARTS, OnePart, UnionOf
from bench.models.learned import NarrowBand, Network
from bench.models.model import Candidate
from bench.setup.auto import AUTO
from renderers.checks import check_at_least, check_share

SIZED: dict[str, Callable[..., Candidate]] = {"union": UnionOf, "network": Network, "grid": NarrowBand}
EXAMPLES = ("union_3", "network_4x64", "grid_32", "auto", "prior")
FORMS = "union_K, network_LAYERSxWIDTH, grid_N"
PAPERS = Network(8, 512)  # that of DeepSDF and DIST, without a code


def candidate(name: str) -> Candidate:
    """The candidate of a name.

    Raises:
        ValueError: where no candidate has this name.
    """
    if name in PARTS:
        return OnePart(name)
    kind, _, size = name.partition("_")
    in_form = re.fullmatch("[0-9]+x[0-9]+" if kind == "network" else "[0-9]+", size, re.ASCII)
    if kind not in SIZED or in_form is None:
        known = [*PARTS, *EXAMPLES]
        raise ValueError(f"unknown field {name!r}{nearest(name, known)}; or {FORMS}, in numbers")
    return SIZED[kind](*map(int, size.split("x")))


@dataclass(frozen=True)
class FitSettings:
    """How each candidate is fitted.

    Args:
        iterations: of the fit with the renderer's loss.
        fewest_rays: least share of the rays in an iteration where their number follows the loss; 1 always takes all.
            See `bench.setup.auto.rays_share`.
        warm_iterations, warm_points: iterations and points per iteration of the warm start, which fits the observed
            points or the previous field without a renderer.
        eikonal_weight: of the mean square of |grad f| - 1 (Gropp et al. 2020), for fields that are not distances by
            construction.
    """

    iterations: int
    fewest_rays: float
    warm_iterations: int
    warm_points: int
    eikonal_weight: float

    def __post_init__(self) -> None:
        for name in ("iterations", "warm_points"):
            check_at_least(f"models.fit.{name}", getattr(self, name), 1, "conf/scale has values that work")
        check_share("models.fit.fewest_rays", self.fewest_rays, "1 always takes all rays")
        check_at_least("models.fit.warm_iterations", self.warm_iterations, 0, "0 switches the warm start off")
        check_at_least("models.fit.eikonal_weight", self.eikonal_weight, 0, "0 switches the term off")


@dataclass(frozen=True)
class GrowthSettings:
    """How `field=auto` tries candidates.

    Args:
        trial: share of a whole fit's iterations that a candidate's trial takes.
        patience: successive candidates that may be tried without improvement.
        budget: most cost of all candidates together, as a multiple of the final candidate's whole fit; by the cost
            model of `bench.models.growth.cost`, not by a clock, so that a run ends the same on every machine.
    """

    trial: float
    patience: int
    budget: float

    def __post_init__(self) -> None:
        check_share("models.growth.trial", self.trial, "1/40 shows whether a candidate is better than the one before")
        check_at_least("models.growth.patience", self.patience, 1, "5 finds a grid behind small networks")
        check_at_least("models.growth.budget", self.budget, 1, "2 is twice the fit of the final candidate")


@dataclass(frozen=True)
class ViewSettings:
    """The views that candidates are fitted to and evaluated on.

    Args:
        fitted: number of views whose depth and silhouette are given.
        held_out: number of views that are held out.
        share: of the fitted views' rays that are held out as well.
        elevation: largest absolute elevation of the cameras, in degrees.
        rays: of the fitted views, drawn in each iteration.
    """

    fitted: int
    held_out: int
    share: float
    elevation: float
    rays: int

    def __post_init__(self) -> None:
        check_at_least("models.views.fitted", self.fitted, 1, "12 cover all sides")
        check_at_least("models.views.held_out", self.held_out, 2, "8 give a standard error")
        check_at_least("models.views.rays", self.rays, 1, "1024 work")
        if not 0 <= self.share < 1:
            raise ValueError(f"models.views.share must lie between 0 and 1, not {self.share}: 0.1 holds out a tenth")
        if not 0 <= self.elevation < 90:
            raise ValueError(f"models.views.elevation must lie between 0 and 90 degrees, not {self.elevation}: 60")


@dataclass(frozen=True)
class ModelSettings:
    """The fields to choose from, and the settings of their fits.

    Args:
        candidates: their names, the smallest first; see `candidate`.
        fit: settings of each fit.
        growth: settings of `field=auto`.
        views: of a known shape, where candidates are fitted to one.
    """

    candidates: tuple[str, ...]
    fit: FitSettings
    growth: GrowthSettings
    views: ViewSettings

    def __post_init__(self) -> None:
        check_at_least("the length of models.candidates", len(self.candidates), 1, "conf/scale has complete lists")
        if len(set(self.candidates)) < len(self.candidates):
            raise ValueError(f"models.candidates must name each candidate once, not {', '.join(self.candidates)}")
        self.all()

    def all(self) -> list[Candidate]:
        """All candidates."""
        return [candidate(name) for name in self.candidates]

    def requested(self, field: str) -> list[Candidate]:
        """All candidates for `auto`, else the one of that name."""
        return self.all() if field == AUTO else [candidate(field)]
