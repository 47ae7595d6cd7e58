"""Which fields there are to choose from, and how they are fitted."""

from dataclasses import dataclass

from bench.auto import AUTO
from bench.ladder.model import Rung
from bench.ladder.rungs import rung
from renderers.checks import check_at_least, check_share

PRIOR = "prior"  # the field that a task looks for where nothing else is asked for: a code of the dataset's prior


@dataclass(frozen=True)
class FitSettings:
    """How each rung is fitted.

    Args:
        iterations: of the renderer's loss.
        fewest_rays: share of the rays that it begins with where their number follows the loss; 1 takes all from the
            start on. See `bench.auto.rays_share`.
        warm_iterations, warm_points: of the start without a renderer, to the observed points and the previous field.
        eikonal_weight: of the mean square of |grad f| - 1 (Gropp et al. 2020), for fields that are no distance by
            themselves.
    """

    iterations: int
    fewest_rays: float
    warm_iterations: int
    warm_points: int
    eikonal_weight: float

    def __post_init__(self) -> None:
        for name in ("iterations", "warm_points"):
            check_at_least(f"ladder.fit.{name}", getattr(self, name), 1, "conf/scale has values that work")
        check_share("ladder.fit.fewest_rays", self.fewest_rays, "1 takes all rays from the start on")
        check_at_least("ladder.fit.warm_iterations", self.warm_iterations, 0, "0 switches the warm start off")
        check_at_least("ladder.fit.eikonal_weight", self.eikonal_weight, 0, "0 switches the term off")


@dataclass(frozen=True)
class GrowthSettings:
    """How far growth looks ahead.

    Args:
        trial: share of a whole fit's iterations that a rung is tried for.
        patience: successive rungs that may be tried in vain.
        budget: what all rungs together may cost, over the whole fit of the one that it ends on; by the model of
            `bench.ladder.growth.cost`, not by a clock, so that the same run ends the same everywhere.
    """

    trial: float
    patience: int
    budget: float

    def __post_init__(self) -> None:
        check_share("ladder.growth.trial", self.trial, "1/40 tells whether a rung is better than the one before")
        check_at_least("ladder.growth.patience", self.patience, 1, "5 finds a grid behind small networks")
        check_at_least("ladder.growth.budget", self.budget, 1, "2 is twice the fit of the rung that it ends on")


@dataclass(frozen=True)
class ViewSettings:
    """How many views there are.

    Args:
        fitted: whose depth and silhouette are given.
        held_out: of which nothing is.
        share: of the fitted views' rays that are held out, too.
        elevation: of all cameras, at most, to both sides, in degrees.
        rays: of the fitted views, drawn in each iteration.
    """

    fitted: int
    held_out: int
    share: float
    elevation: float
    rays: int

    def __post_init__(self) -> None:
        check_at_least("ladder.views.fitted", self.fitted, 1, "12 see all sides")
        check_at_least("ladder.views.held_out", self.held_out, 2, "8 give a standard error")
        check_at_least("ladder.views.rays", self.rays, 1, "1024 work")
        if not 0 <= self.share < 1:
            raise ValueError(f"ladder.views.share must lie between 0 and 1, not {self.share}: 0.1 holds out a tenth")
        if not 0 <= self.elevation < 90:
            raise ValueError(f"ladder.views.elevation must lie between 0 and 90 degrees, not {self.elevation}: 60")


@dataclass(frozen=True)
class LadderSettings:
    """Which fields there are to choose from, and how they are fitted.

    Args:
        rungs: their names, the smallest first; see `bench.ladder.rungs`.
        fit: how each is fitted.
        growth: how `field=auto` grows.
        views: of a known shape.
    """

    rungs: tuple[str, ...]
    fit: FitSettings
    growth: GrowthSettings
    views: ViewSettings

    def __post_init__(self) -> None:
        check_at_least("the length of ladder.rungs", len(self.rungs), 1, "conf/scale has whole ones")
        if len(set(self.rungs)) < len(self.rungs):
            raise ValueError(f"ladder.rungs must name each rung once, not {', '.join(self.rungs)}")
        self.all()

    def all(self) -> list[Rung]:
        """Every rung."""
        return [rung(name) for name in self.rungs]

    def asked(self, field: str) -> list[Rung]:
        """All for `auto`; the one of that name otherwise."""
        return self.all() if field == AUTO else [rung(field)]
