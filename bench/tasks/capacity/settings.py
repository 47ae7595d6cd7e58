"""The settings of fields without a prior: their candidates, their fits, and the views that they are fitted to."""

from dataclasses import dataclass
from math import isnan

from bench.tasks.capacity.names import parse_field_name
from renderers.checks import check_at_least, check_choice, check_fraction

STORED, FREE, BYTES = "stored", "free", "bytes"  # measures of size; see `bench.tasks.capacity.model.Size`
SIZE_WORDS = {STORED: "stored numbers", FREE: "free numbers", BYTES: "bytes"}


@dataclass(frozen=True)
class FitSettings:
    """Settings of a candidate's fit.

    Args:
        iterations: of the fit with the renderer's loss; with task=capacity, of a round.
        fewest_rays: smallest fraction of the rays in an iteration if their number follows the loss; 1 always takes
            all. See `rays_share`.
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
        check_fraction("models.fit.fewest_rays", self.fewest_rays, "1 always takes all rays")
        check_at_least("models.fit.warm_iterations", self.warm_iterations, 0, "0 switches the warm start off")
        check_at_least("models.fit.eikonal_weight", self.eikonal_weight, 0, "0 switches the term off")


@dataclass(frozen=True)
class GrowthSettings:
    """Settings of the search of `field=auto`.

    Args:
        trial: fraction of a complete fit's iterations in a candidate's trial.
        patience: successive candidates that may be tried without improvement.
        budget: largest cost of all candidates together, as a multiple of the final candidate's complete fit. It is
            estimated by `bench.tasks.capacity.growth.cost`, not measured, so that a run ends the same on every machine.
    """

    trial: float
    patience: int
    budget: float

    def __post_init__(self) -> None:
        remedy = "1/40 shows whether a candidate is better than the one before"
        check_fraction("models.growth.trial", self.trial, remedy)
        check_at_least("models.growth.patience", self.patience, 1, "5 finds a grid behind small networks")
        check_at_least("models.growth.budget", self.budget, 1, "2 is twice the fit of the final candidate")


@dataclass(frozen=True)
class ViewSettings:
    """Settings of the views that candidates are fitted to and evaluated on.

    Args:
        fitted: number of views whose depth and silhouette are observed.
        held_out: number of held-out views.
        share: fraction of the fitted views' rays that is also held out.
        elevation: largest absolute elevation of the cameras, in degrees.
        rays: number of rays of the fitted views drawn in each iteration.
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
        candidates: their names, the smallest first by free numbers; see `bench.tasks.capacity.candidates.candidate`.
        size: the measure of size: "stored", "free" or "bytes"; see `bench.tasks.capacity.model.Size`. Candidates are
            tried in its order, see `bench.tasks.capacity.candidates.by_size`.
        fit: settings of each fit.
        growth: settings of `field=auto`.
        views: of a true shape, if candidates are fitted to one.
    """

    candidates: tuple[str, ...]
    size: str
    fit: FitSettings
    growth: GrowthSettings
    views: ViewSettings

    def __post_init__(self) -> None:
        check_at_least("the length of models.candidates", len(self.candidates), 1, "conf/scale has complete lists")
        if len(set(self.candidates)) < len(self.candidates):
            raise ValueError(f"models.candidates must name each candidate once, not {', '.join(self.candidates)}")
        for name in self.candidates:
            parse_field_name(name)
        check_choice("models.size", self.size, tuple(SIZE_WORDS))


def rays_share(min_fraction: float, footprint: float, error: float) -> float:
    """The fraction of an image's pixels at the resolution whose half pixel equals the current error.

    Pixels finer than the error are not needed. The resolution follows from DIST, Eq. 10; its square is their number.

    Args:
        footprint: half a pixel of the whole image, in scene units.
        error: in scene units.
    """
    if not footprint or isnan(error):
        return 1.0
    return min(max((footprint / max(error, footprint)) ** 2, min_fraction), 1.0)
