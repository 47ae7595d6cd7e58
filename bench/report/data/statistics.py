"""Statistics of methods' errors over runs: averages, intervals, ranks and Pareto fronts.

Lower is better. A run that failed or is missing has the error +inf. A method's errors are groups: an array per shape,
with the errors of its seeds, or a list per shape with an array per view. When methods are compared, the same position
in their groups means the same shape, view and seed.

The independent unit is the shape. With fewer than `MIN_SHAPES` shapes there is no interval: its ends are nan, and the
values of the shapes are in `Interval.points`, to be shown instead. One run gives no probability and no rank.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import count
from typing import Any

import numpy as np
import pandas as pd
from scipy import special  # scipy.stats would take 0.6 s and 60 MiB

from bench.records import format

Values = np.ndarray | Sequence[float]
Groups = Sequence[Any]  # per shape an array of its seeds, or a sequence of such arrays, one per view
Statistic = Callable[[np.ndarray], float | np.ndarray]  # reduces the last axis, as `interquartile_mean` does
Point = tuple[Groups, Groups]  # the costs and the errors of one setting
CONFIDENCE_LEVEL = 0.95
ALPHA = 1 - CONFIDENCE_LEVEL  # the probability of any false rejection among the tests of a page
MIN_SHAPES = 6  # an interval of five shapes would cover their median with a probability of only 94 %


@dataclass(frozen=True)
class Interval:
    """An estimate and the ends of its confidence interval, nan with too few shapes: then its `points` are shown."""

    value: float
    low: float
    high: float
    points: tuple[float, ...] = field(default=(), compare=False, repr=False)  # the estimates of the single shapes

    @property
    def has_ends(self) -> bool:
        return not math.isnan(self.low)

    def times(self, scale: float) -> "Interval":
        value, low, high, *points = (scale * x for x in (self.value, self.low, self.high, *self.points))
        return Interval(value, low, high, tuple(points))

    def ends(self, scale: float = 1.0) -> str:
        """The interval times `scale` as text; without an interval the number of shapes, such as (n = 4)."""
        if not self.has_ends:
            return f"(n = {len(self.points)})"
        return f"[{format.number(scale * self.low)}, {format.number(scale * self.high)}]"

    def __str__(self) -> str:
        """The estimate with its interval, or with the number of shapes."""
        return f"{self.alone()} {self.ends()}"

    def alone(self) -> str:
        return format.number(None if math.isnan(self.value) else self.value)


def interquartile_mean(values: Values) -> float | np.ndarray:
    """The mean of the middle half [...] of values [..., n]; a value at the edge of that half counts partly."""
    ordered = np.sort(_checked(values), axis=-1)
    n, i = ordered.shape[-1], np.arange(ordered.shape[-1])
    share = np.clip(np.minimum(i + 1, 0.75 * n) - np.maximum(i, 0.25 * n), 0, None)  # inside the middle half
    return (ordered[..., share > 0] * share[share > 0]).sum(axis=-1) / (n / 2)


def median(values: Values) -> float | np.ndarray:
    """The median [...] of values [..., n]; for even n the mean of the middle two, +inf if one of them is."""
    return np.median(_checked(values), axis=-1)


def geometric_mean(values: Values) -> float | np.ndarray:
    """The geometric mean [...] of values [..., n] of 0 or more; +inf if one of them is."""
    with np.errstate(divide="ignore"):  # log(0)
        return np.exp(np.log(_checked(values)).mean(axis=-1))


def shapes_won(first: Groups, second: Groups) -> float:
    """The number of shapes on which the median of the first's runs is lower; a tie counts half."""
    a, b = (np.array([median(flat([group])) for group in groups]) for groups in (first, second))
    return float(((a < b) + 0.5 * (a == b)).sum())


def bootstrap(groups: Groups, statistic: Statistic, *, seed: int = 0, draws: int = 2000) -> Interval:
    """The statistic of all runs with its hierarchical bootstrap interval over shapes, views and seeds.

    A draw takes shapes with replacement, then views of each, then seeds of each (Davison and Hinkley 1997, Sec. 3.8).
    The percentiles are widened for few shapes (Hesterberg 2015: expanded percentile interval). For interquartile means
    and medians of six shapes or more, the interval covers 95 % or more; if seeds vary as much as shapes, 99 %.
    `statistic` reduces the last axis, of the runs of all shapes: a shape with more runs weighs more. Ends are draws,
    never interpolated, so they can be +inf; nan with fewer than `MIN_SHAPES` shapes.
    """
    (value,), (drawn,), points = _resample([groups], statistic, seed, draws)
    return _interval(value, drawn, points[0])


def typical(groups: Groups) -> Interval:
    """The median over shapes of the geometric mean of their runs, with the interval of the sign test.

    Its ends are values of shapes, so it is valid for any distribution, and may be infinite.
    """
    return _median_interval(_shape_values(groups, geometric_mean))


def ratio(first: Groups, second: Groups, *, of_shape: Statistic = geometric_mean) -> Interval:
    """The median over shapes of the ratio of two errors, each the geometric mean, or `of_shape`, of the shape's runs.

    If both fail on a shape, its ratio is 1. Raises ValueError if the two have other shapes, views or seeds.
    """
    if _sizes(first) != _sizes(second):
        raise ValueError(f"{_UNEQUAL_SHAPES} {[_sizes(first), _sizes(second)]}: leave out what one of them lacks")
    return _median_interval(_ratio(*(_shape_values(each, of_shape) for each in (first, second))))


def shape_groups(values: Any) -> list[np.ndarray]:
    """The groups of a pandas series whose index begins with the family and the shape."""
    return [group.to_numpy() for _, group in values.groupby(level=[0, 1])]


def common_ratio(first: Any, second: Any) -> Interval | None:
    """The `ratio` of two such series on the entries that both have; None without any."""
    common = first.index.intersection(second.index)
    return ratio(*(shape_groups(each.loc[common]) for each in (first, second))) if len(common) else None


class Verdict(Enum):
    """The result of a test whether a ratio differs from 1."""

    DIFFERS = "differs"
    NOT_DISTINGUISHED = "cannot be distinguished"  # tested, and not rejected; this is not the same as equal
    NOT_DECIDABLE = "cannot be decided"  # no data of so few shapes could be rejected


def ratio_verdicts(ratios: Sequence[Interval]) -> list[Verdict]:
    """The verdict on each ratio of a family: the sign test over shapes with Holm's step-down at a total of 5 %.

    A ratio is not decidable if the test would not reject even if all shapes of all ratios agreed. Ratios of fewer than
    `MIN_SHAPES` shapes are not decidable, and do not count as tests.
    """
    counted = [index for index, ratio in enumerate(ratios) if ratio.has_ends]
    tests = (
        [sign_test_p_value(ratios[index].points) for index in counted],
        [_min_p_value(len(ratios[index].points)) for index in counted],
    )
    rejected, decidable = ({index for index, sure in zip(counted, holm(test), strict=True) if sure} for test in tests)
    open_verdicts = [Verdict.NOT_DISTINGUISHED if i in decidable else Verdict.NOT_DECIDABLE for i in range(len(ratios))]
    return [Verdict.DIFFERS if i in rejected else verdict for i, verdict in enumerate(open_verdicts)]


def holm(p_values: Values, alpha: float = ALPHA) -> np.ndarray:
    """Which hypotheses the step-down procedure of Holm (1979) rejects at a total level `alpha`."""
    ordered = np.argsort(p_values, kind="stable")
    passed = np.asarray(p_values)[ordered] <= alpha / (len(ordered) - np.arange(len(ordered)))
    rejected = np.zeros(len(ordered), dtype=bool)
    rejected[ordered] = np.logical_and.accumulate(passed)
    return rejected


def shapes_needed(ratios: int, alpha: float = ALPHA) -> int:
    """The fewest shapes with which the sign test can reject anything in a family of that many ratios."""
    return next(n for n in count(1) if _min_p_value(n) <= alpha / ratios)


def shapes_agreeing(shapes: int, ratios: int) -> int:
    """How many shapes must be on one side of 1 for Holm's first step to reject; `shapes` + 1 if it cannot."""
    chances = 2 * special.bdtr(np.arange(shapes), shapes, 0.5)  # of at most i shapes on the other side
    return shapes + 1 - int(np.searchsorted(chances, ALPHA / ratios, side="right"))


def _min_p_value(shapes: int) -> float:
    return 2.0 * 0.5**shapes


def sign_test_p_value(points: Sequence[float], centre: float = 1.0) -> float:
    """Two-sided, of the values' median against `centre`; equal values do not count."""
    below, above = sum(x < centre for x in points), sum(x > centre for x in points)
    return min(1.0, 2 * float(special.bdtr(min(below, above), below + above, 0.5)))


def _shape_values(groups: Groups, statistic: Statistic) -> np.ndarray:
    return np.array([statistic(flat([group])) for group in groups])


def _median_interval(points: np.ndarray) -> Interval:
    n = len(points)
    with np.errstate(divide="ignore", invalid="ignore"):  # log(0), and 0 next to inf: no median
        middle = math.exp(np.median(np.log(points)))
    if n < MIN_SHAPES:
        return Interval(middle, math.nan, math.nan, tuple(points.tolist()))
    chances = special.bdtr(np.arange(n), n, 0.5)  # of at most i of n values below the median
    beyond, ordered = int(np.searchsorted(chances, ALPHA / 2)) - 1, np.sort(points)
    return Interval(middle, float(ordered[beyond]), float(ordered[-1 - beyond]), tuple(points.tolist()))


def share(successes: Values, trials: Values) -> Interval:
    """The fraction of successes (a tie is half a one) among all trials of all shapes, with an interval over shapes.

    The interval is that of `clopper_pearson` with as many trials as shapes, as trials of one shape are not independent.
    Their design effect (Rao and Scott 1992) cannot be estimated from so few shapes: intervals with it cover 91 % at 16
    shapes. The ends are nan with fewer than `MIN_SHAPES` shapes.
    """
    k, m = np.asarray(successes, dtype=float), np.asarray(trials, dtype=float)
    if k.shape != m.shape or not k.size or not ((k >= 0) & (k <= m) & (m >= 1)).all():
        raise ValueError(f"successes must be in 0..trials, trials 1 or more per shape, but they are {k} and {m}")
    value, points = float(k.sum() / m.sum()), tuple((k / m).tolist())
    if len(k) < MIN_SHAPES:
        return Interval(value, math.nan, math.nan, points)
    return replace(clopper_pearson(value, len(k)), points=points)


def clopper_pearson(value: float, n: float) -> Interval:
    """A fraction of n independent trials with its exact interval (Clopper and Pearson 1934); n may be fractional."""
    if not 0 <= value <= 1 or n < 1:
        raise ValueError(f"the share must be in 0..1 and n at least 1, but they are {value} and {n}: count the trials")
    k, tail = value * n, ALPHA / 2
    low = 0.0 if value == 0 else float(special.betaincinv(k, n - k + 1, tail))
    high = 1.0 if value == 1 else float(special.betaincinv(k + 1, n - k, 1 - tail))
    return Interval(value, low, high)


def rank(table: dict[Any, dict[Any, float | None]]) -> dict[Any, Interval]:
    """Each method's mean rank over the shapes with its bootstrap interval. Rank 1 is best; equal errors share a rank.

    A method without a finite error on a shape gets the worst rank. A shape on which all methods fail is left out. With
    one shape the rank is nan. `Interval.points` are the ranks of the shapes.
    """
    worst, several_shapes = float(len(table)), len({shape for errors in table.values() for shape in errors}) > 1
    errors = pd.DataFrame(table, dtype=float).replace(math.inf, math.nan).dropna(how="all")
    ranks = errors.rank(axis=1).fillna(worst)
    if not several_shapes or ranks.empty:
        return dict.fromkeys(table, Interval(worst if several_shapes else math.nan, math.nan, math.nan))
    return {name: _mean_interval(ranks[name].to_numpy()) for name in table}


def _mean_interval(values: np.ndarray) -> Interval:
    return bootstrap([*values[:, None]], lambda drawn: np.mean(drawn, axis=-1))


def rank_correlation(first: Values, second: Values) -> tuple[float, float]:
    """Spearman's correlation, and its two-sided p value by Student's t approximation; NaN without variation."""
    ranks, freedom = [pd.Series(np.asarray(values)).rank() for values in (first, second)], len(first) - 2
    with np.errstate(divide="ignore", invalid="ignore"):  # at a correlation of 1, and without variation
        rho = np.corrcoef(ranks)[0, 1]
        t = abs(rho) * np.sqrt(freedom / (1 - rho**2))
    return float(rho), 2 * float(special.stdtr(freedom, -t)) if freedom > 0 else math.nan


def smallest_significant_correlation(n: int) -> float:
    """The smallest absolute `rank_correlation` of n values that is significant."""
    t = float(special.stdtrit(n - 2, 1 - ALPHA / 2))
    return t / math.sqrt(n - 2 + t**2)


def tied_with_best(ranks: dict[Any, Interval], best: Any) -> list[Any]:
    """The other methods that cannot be distinguished from the best: the interval of the rank difference contains 0."""
    best_points = np.array(ranks[best].points)
    others = {name: _mean_interval(np.array(rank.points) - best_points) for name, rank in ranks.items() if name != best}
    return [name for name, rank in others.items() if rank.low <= 0 <= rank.high]


def dominated(costs: Values, errors: Values) -> np.ndarray:
    """Whether another of the points [..., n] is no worse in both and better in one. Equal points do not dominate."""
    costs, errors = _checked(costs), _checked(errors)
    mine, other = (costs[..., :, None], errors[..., :, None]), (costs[..., None, :], errors[..., None, :])
    no_worse = (other[0] <= mine[0]) & (other[1] <= mine[1])
    return (no_worse & ((other[0] < mine[0]) | (other[1] < mine[1]))).any(axis=-1)


def front(points: Sequence[Point], *, seed: int = 0, draws: int = 2000) -> list[float]:
    """The probability that each setting is on the Pareto front of medians, over bootstrap draws of shapes and seeds.

    All settings get the same shapes and seeds in a draw. A setting whose median is infinite is not on the front. With
    one run per setting the probability is nan.
    """
    if points and len(flat(points[0][0])) < 2:
        return [math.nan] * len(points)
    _, drawn, _ = _resample([groups for point in points for groups in point], median, seed, draws, fewest=1)
    costs, errors = drawn[0::2].T, drawn[1::2].T
    return (~dominated(costs, errors) & np.isfinite(costs) & np.isfinite(errors)).mean(axis=0).tolist()


def flat(groups: Groups) -> np.ndarray:
    """The values of all runs, shape by shape."""
    return np.concatenate([group if isinstance(group, np.ndarray) else flat(group) for group in groups])


def _checked(values: Values) -> np.ndarray:
    """The values as an array of floats; raises ValueError if there are none, or one is nan or -inf."""
    array = np.asarray(values, dtype=float)
    if not array.shape[-1]:
        raise ValueError("values must be one or more, but there are none: a run that is missing is inf")
    if not (array > -math.inf).all():
        raise ValueError(f"values must be numbers or inf, but some are nan or -inf in {array}: a failure is inf")
    return array


def _ratio(first: float | np.ndarray, second: float | np.ndarray) -> np.ndarray:
    """first / second; 1 if they are equal, also for 0 and inf."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        return np.where(first == second, 1.0, np.divide(first, second))


_UNEQUAL_SHAPES = "all must have the same shapes and seeds, one or more, but have"


def _sizes(groups: Groups) -> list[list[int]]:
    """Per level the group sizes: the number of shapes, of views per shape (if any), of seeds per view or shape."""
    sizes = [[len(groups)]]
    while groups and not isinstance(groups[0], np.ndarray):
        sizes.append([len(group) for group in groups])
        groups = [inner for group in groups for inner in group]
    return [*sizes, [len(group) for group in groups]]


def _resample(
    series: Sequence[Groups], statistic: Statistic, seed: int, draws: int, fewest: int = MIN_SHAPES
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The statistic of each series [series], of each draw [series, draws] unless shapes are few, and of each shape."""
    sizes = [_sizes(groups) for groups in series]
    if not sizes or any(other != sizes[0] for other in sizes) or not all(min(level, default=0) for level in sizes[0]):
        raise ValueError(f"{_UNEQUAL_SHAPES} {sizes}: fill in with inf")
    values = _checked(np.stack([flat(groups) for groups in series]))
    shapes = np.array([[statistic(_checked(flat([group]))) for group in groups] for groups in series], dtype=float)
    drawn = [np.empty((len(series), 0))]
    if len(series[0]) >= fewest:
        drawn = [np.stack([statistic(row[index]) for row in values]) for index in _draw(sizes[0], seed, draws)]
    return np.asarray(statistic(values)), np.concatenate(drawn, axis=1), shapes


def _draw(sizes: list[list[int]], seed: int, draws: int) -> list[np.ndarray]:
    """The indices of the drawn runs, for the sizes of `_sizes`: an array [draws, runs] per number of runs."""
    generator = np.random.default_rng(seed)
    (n,) = sizes[0]
    node, is_drawn = generator.integers(n, size=(draws, n)), np.ones((draws, n), dtype=bool)
    for level in map(np.array, sizes[1:]):
        size, start = level[node][..., None], (np.cumsum(level) - level)[node][..., None]
        nodes = start + generator.integers(size, size=(*node.shape, level.max()))
        is_drawn = is_drawn[..., None] & (np.arange(level.max()) < size)  # a group gives as many entries as it has
        node, is_drawn = nodes.reshape(draws, -1), is_drawn.reshape(draws, -1)
    total = is_drawn.sum(axis=1)
    return [node[total == n][is_drawn[total == n]].reshape(-1, n) for n in np.unique(total)]


def _interval(value: float | np.ndarray, drawn: np.ndarray, points: np.ndarray) -> Interval:
    """The expanded percentile interval of the statistic's draws, and the statistic of each shape."""
    n, shapes = len(points), tuple(points.tolist())
    if n < MIN_SHAPES:
        return Interval(float(value), math.nan, math.nan, shapes)
    tail = special.ndtr(math.sqrt(n / (n - 1)) * special.stdtrit(n - 1, ALPHA / 2))
    low, high = np.quantile(drawn, tail, method="lower"), np.quantile(drawn, 1 - tail, method="higher")
    return Interval(float(value), float(low), float(high), shapes)
