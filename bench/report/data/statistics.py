"""Statistics of methods' errors over runs: averages, intervals, tests, ranks and Pareto fronts.

Lower is better. A run that failed or is missing has the error +inf. A method's errors are groups: an array per shape,
with the errors of its seeds. Where methods are compared, the same index in their groups means the same shape and seed.
"""

import math
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from bench.records import format

Values = np.ndarray | Sequence[float]
Groups = Sequence[np.ndarray]
Statistic = Callable[[np.ndarray], float | np.ndarray]  # reduces the last axis, as `interquartile_mean` does
Point = tuple[Groups, Groups]  # the costs and the errors of one setting


@dataclass(frozen=True)
class Interval:
    """An estimate and the ends of its confidence interval; nan ends where there are too few runs for one."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """The estimate, and its interval where there is one."""
        return f"{format.number(self.value)} {format.interval(self.low, self.high)}".strip()


@dataclass(frozen=True)
class Survival:
    """The share `remaining` from each of `times` until the next; nan ends where the interval is not defined."""

    times: np.ndarray
    remaining: np.ndarray
    low: np.ndarray
    high: np.ndarray


def interquartile_mean(values: Values) -> float | np.ndarray:
    """The mean of the middle half [...] of values [..., n]; a value at the edge of that half counts in part."""
    ordered = np.sort(_checked(values), axis=-1)
    n, i = ordered.shape[-1], np.arange(ordered.shape[-1])
    share = np.clip(np.minimum(i + 1, 0.75 * n) - np.maximum(i, 0.25 * n), 0, None)  # of each in the middle half
    return (ordered[..., share > 0] * share[share > 0]).sum(axis=-1) / (n / 2)


def median(values: Values) -> float | np.ndarray:
    """The median [...] of values [..., n]; for even n the mean of the middle two, +inf where one of them is."""
    return np.median(_checked(values), axis=-1)


def bootstrap(groups: Groups, statistic: Statistic, *, seed: int, level: float = 0.95, draws: int = 2000) -> Interval:
    """The statistic of all runs with its bootstrap interval over shapes and seeds.

    A draw takes shapes with replacement and, of each, seeds with replacement (Davison and Hinkley 1997, Sec. 3.8); for
    a single shape, seeds only. The percentiles are widened for few shapes (Hesterberg 2015, "What teachers should know
    about the bootstrap": expanded percentile interval). The interval covers 95 % or more with six shapes or more. With
    fewer, no percentile interval can: the extremes of n values enclose a median with probability 1 - 2^(1 - n), 94 %
    for five, 88 % for four. Where seeds vary as much as shapes it is too wide (covers 99 %), as their spread enters at
    both stages.

    Args:
        statistic: reduces the last axis. It gets the runs of all shapes together: a shape with more seeds weighs more.

    Returns:
        Ends are draws, never interpolated, so they can be +inf; nan for one shape with one seed.
    """
    (value,), (drawn,), n = _resample([groups], statistic, seed, draws)
    return _interval(value, drawn, n, level)


def paired_bootstrap(
    first: Groups, second: Groups, statistic: Statistic, *, seed: int, level: float = 0.95, draws: int = 2000
) -> Interval:
    """The ratio of the first's statistic to the second's, with its interval over the same draws of shapes and seeds.

    Equal statistics have the ratio 1, also if both are +inf or 0: where both fail, neither is better.

    Raises:
        ValueError: the two do not have the same shapes with the same numbers of seeds.
    """
    value, drawn, n = _resample([first, second], statistic, seed, draws)
    return _interval(_ratio(*value), _ratio(*drawn), n, level)


def wilson(failures: int, n: int, *, level: float = 0.95) -> Interval:
    """The share of failures among n runs with Wilson's interval (1927), as a share of 1."""
    if not 0 <= failures <= n or n < 1:
        raise ValueError(f"failures must be in 0..n and n at least 1, but they are {failures} and {n}: count the runs")
    ends = stats.binomtest(failures, n).proportion_ci(level, method="wilson")
    return Interval(failures / n, float(ends.low), float(ends.high))


def kaplan_meier(times: Values, reached: np.ndarray | Sequence[bool], *, level: float = 0.95) -> Survival:
    """The share of runs that have not yet reached their goal over time (Kaplan and Meier 1958), from 1 at time 0.

    Args:
        times: when a run reached its goal or, if it did not, when it ended; finite, 0 or more, in any unit.
        reached: whether the run reached its goal. A run that did not is censored at its end.

    Returns:
        The interval is log-log (Kalbfleisch and Prentice); nan where all or none remain, but 1 at time 0.
    """
    times, reached = np.asarray(times, dtype=float), np.asarray(reached, dtype=bool)
    if times.shape != reached.shape or times.ndim != 1 or not times.size:
        raise ValueError(f"times and reached must be as many, one or more, but are {times.shape} and {reached.shape}")
    if not (np.isfinite(times) & (times >= 0)).all():
        raise ValueError(f"times must be finite and 0 or more, but are {times}: give the time at which a run ended")
    left = stats.ecdf(stats.CensoredData.right_censored(times, ~reached)).sf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # scipy warns of the nan that the docstring describes
        ends = left.confidence_interval(level, method="log-log")
    steps = (left.probabilities, ends.low.probabilities, ends.high.probabilities)
    return Survival(np.append(0.0, left.quantiles), *(np.append(1.0, step) for step in steps))


def holm(p_values: Values) -> np.ndarray:
    """The p-values adjusted for their number (Holm 1979), in the given order, at most 1."""
    p = np.asarray(p_values, dtype=float)
    if not ((p >= 0) & (p <= 1)).all():
        raise ValueError(f"p-values must be in 0..1, but are {p}: leave out what was not tested")
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)), 1)
    return adjusted


def compare(first: Groups, second: Groups) -> float:
    """The two-sided p-value of Wilcoxon's signed-rank test (1945) on the medians of the shapes, exact for any number.

    Exact means over all flips of the signs, given the ranks: ties share their mean rank, and differences of zero are
    left out. The difference is zero where both failed, and the largest where one failed. 1 if all are zero.
    """
    if len(first) != len(second):
        raise ValueError(f"both must have the same shapes, but have {len(first)} and {len(second)}: fill in with inf")
    a, b = (np.array([median(group) for group in groups]) for groups in (first, second))
    differ = a != b
    difference = a[differ] - b[differ]
    ranks = np.rint(2 * stats.rankdata(np.abs(difference))).astype(int)  # doubled, so that ties have integer ranks
    chance = np.ones(1)  # probability of each sum of the ranks whose sign is flipped
    for r in ranks:
        chance = (np.append(chance, np.zeros(r)) + np.append(np.zeros(r), chance)) / 2
    positive = ranks[difference > 0].sum()
    return min(1.0, 2 * float(chance[: min(positive, ranks.sum() - positive) + 1].sum()))


def rank(table: dict[Any, dict[Hashable, float | None]]) -> dict[Any, float]:
    """Each method's mean rank over the shapes, 1 is the best; equal errors share their mean rank.

    A method without a finite error for a shape has the worst rank there: the number of methods. A shape at which all
    methods fail is left out.
    """
    errors = pd.DataFrame(table, dtype=float).replace(math.inf, math.nan).dropna(how="all")
    return errors.rank(axis=1).fillna(len(table)).mean().fillna(len(table)).to_dict()


def dominated(costs: Values, errors: Values) -> np.ndarray:
    """Whether another of the points [..., n] is no worse in both and better in one; equal points do not dominate."""
    costs, errors = _checked(costs), _checked(errors)
    mine, other = (costs[..., :, None], errors[..., :, None]), (costs[..., None, :], errors[..., None, :])
    no_worse = (other[0] <= mine[0]) & (other[1] <= mine[1])
    return (no_worse & ((other[0] < mine[0]) | (other[1] < mine[1]))).any(axis=-1)


def front(points: Sequence[Point], *, seed: int, draws: int = 2000) -> list[float]:
    """The probability of each setting to be on the Pareto front of medians, over bootstrap draws of shapes and seeds.

    All settings get the same shapes and seeds in a draw. A setting whose median is infinite is not on the front.
    """
    _, drawn, _ = _resample([groups for point in points for groups in point], median, seed, draws)
    costs, errors = drawn[0::2].T, drawn[1::2].T
    return (~dominated(costs, errors) & np.isfinite(costs) & np.isfinite(errors)).mean(axis=0).tolist()


def hypervolume(costs: Values, errors: Values, *, reference: tuple[float, float]) -> float | np.ndarray:
    """The area [...] that points [..., n] dominate up to the reference's cost and error, in powers of ten of both.

    A point beyond the reference in either adds nothing.

    Raises:
        ValueError: a cost, an error or the reference is not above 0, so that its logarithm is not finite.
    """
    costs, errors = _checked(costs), _checked(errors)
    if not (min(reference) > 0 and math.isfinite(max(reference)) and (costs > 0).all() and (errors > 0).all()):
        raise ValueError(
            f"costs, errors and the finite reference {reference} must be above 0: add what can be resolved"
        )
    x, y = (np.log10(np.minimum(v, limit)) for v, limit in zip((costs, errors), reference, strict=True))
    order = np.argsort(x, axis=-1)
    x = np.take_along_axis(x, order, axis=-1)
    lowest = np.minimum.accumulate(np.take_along_axis(y, order, axis=-1), axis=-1)
    corner = np.log10(reference)
    return (np.diff(x, axis=-1, append=np.full_like(x[..., :1], corner[0])) * (corner[1] - lowest)).sum(axis=-1)


def hypervolume_interval(
    points: Sequence[Point], *, reference: tuple[float, float], seed: int, level: float = 0.95, draws: int = 2000
) -> Interval:
    """The hypervolume of the settings' medians with its interval; all settings get the same shapes and seeds."""
    value, drawn, n = _resample([groups for point in points for groups in point], median, seed, draws)
    area = hypervolume(drawn[0::2].T, drawn[1::2].T, reference=reference)
    return _interval(hypervolume(value[0::2], value[1::2], reference=reference), area, n, level)


def _checked(values: Values) -> np.ndarray:
    """The values as an array of floats; raises ValueError where there are none, or one is nan or -inf."""
    array = np.asarray(values, dtype=float)
    if not array.shape[-1]:
        raise ValueError("values must be one or more, but there are none: a run that is missing is inf")
    if not (array > -math.inf).all():
        raise ValueError(f"values must be numbers or inf, but some are nan or -inf in {array}: a failure is inf")
    return array


def _ratio(first: float | np.ndarray, second: float | np.ndarray) -> np.ndarray:
    """first / second, 1 where they are equal."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        return np.where(first == second, 1.0, np.divide(first, second))


def _resample(
    series: Sequence[Groups], statistic: Statistic, seed: int, draws: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """The statistic of each series [series], that of each draw [series, draws], and the number of shapes or seeds."""
    sizes = [[len(group) for group in groups] for groups in series]
    if not sizes or not sizes[0] or any(other != sizes[0] for other in sizes) or not min(sizes[0]):
        raise ValueError(f"all must have the same shapes and seeds, one or more, but have {sizes}: fill in with inf")
    values = _checked(np.stack([np.concatenate(groups) for groups in series]))
    drawn = [np.stack([statistic(row[index]) for row in values]) for index in _draw(np.array(sizes[0]), seed, draws)]
    n = len(sizes[0]) if len(sizes[0]) > 1 else sizes[0][0]
    return np.asarray(statistic(values)), np.concatenate(drawn, axis=1), n


def _draw(sizes: np.ndarray, seed: int, draws: int) -> list[np.ndarray]:
    """The indices of the drawn runs, for shapes of the given numbers of seeds: an array [draws, runs] per run count."""
    generator = np.random.default_rng(seed)
    shape = generator.integers(len(sizes), size=(draws, len(sizes), 1))
    size, start = sizes[shape], (np.cumsum(sizes) - sizes)[shape]
    run = start + generator.integers(size, size=(draws, len(sizes), sizes.max()))
    kept = np.arange(sizes.max()) < size  # a shape gives as many runs as it has seeds
    total = kept.sum(axis=(1, 2))
    return [run[total == n][kept[total == n]].reshape(-1, n) for n in np.unique(total)]


def _interval(value: float | np.ndarray, drawn: np.ndarray, n: int, level: float) -> Interval:
    """The expanded percentile interval of the statistic's draws, for n shapes or seeds."""
    if not 0 < level < 1:
        raise ValueError(f"level must be between 0 and 1, but is {level}: 0.95 is usual")
    if n < 2:
        return Interval(float(value), math.nan, math.nan)
    tail = stats.norm.cdf(math.sqrt(n / (n - 1)) * stats.t.ppf((1 - level) / 2, n - 1))
    low, high = np.quantile(drawn, tail, method="lower"), np.quantile(drawn, 1 - tail, method="higher")
    return Interval(float(value), float(low), float(high))
