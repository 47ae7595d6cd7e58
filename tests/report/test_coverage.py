"""The 95 % intervals of the report cover the true value in at least 93 % of simulated experiments.

Sizes are six shapes with one seed each, the smallest with an interval, and larger ones. tests/stress simulates the
credible intervals of breakdowns.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad
from scipy.optimize import brentq

from bench.report.data.statistics import (
    Interval,
    bootstrap,
    clopper_pearson,
    interquartile_mean,
    median,
    paired_bootstrap,
    ratio,
    share,
    typical,
)

BOOTSTRAP_DRAWS = 200  # the report takes 2,000
SIMULATIONS = 3000
MIN_COVERAGE = 0.93
# Standard deviations of the logarithm of an error: between shapes, and at each level within a shape.
SHAPE_DEVIATION, LEVEL_DEVIATION = 0.8, 0.4
SIZES = [(6, 1), (8, 2), (8, 4, 2)]  # shapes, seeds; shapes, views, seeds


def covered(interval: Interval, truth: float) -> bool:
    return interval.low <= truth <= interval.high


def lognormal(generator, size):
    """Errors of runs, with a deviation per shape and one per view and seed."""
    total = SHAPE_DEVIATION * generator.normal(size=(size[0], *[1] * (len(size) - 1)))
    for level in range(1, len(size)):
        total = total + LEVEL_DEVIATION * generator.normal(size=(*size[: level + 1], *[1] * (len(size) - level - 1)))
    return np.exp(total)


def spread(size) -> float:
    """The standard deviation of a run's logarithm."""
    return math.sqrt(SHAPE_DEVIATION**2 + (len(size) - 1) * LEVEL_DEVIATION**2)


def groups(errors) -> list:
    return list(errors) if errors.ndim == 2 else [list(shape) for shape in errors]


def middle(distribution) -> float:
    """The true interquartile mean: the integral of the quantile function from 1/4 to 3/4, times two."""
    return 2 * quad(distribution.ppf, 0.25, 0.75)[0]


def simulated_coverage(covers) -> float:
    """The fraction of simulated experiments whose interval covers the true value."""
    generator = np.random.default_rng(0)
    return float(np.mean([covers(generator, number) for number in range(SIMULATIONS)]))


def averaged(statistic) -> Callable[..., Interval]:
    return lambda errors, seed: bootstrap(errors, statistic, seed=seed, draws=BOOTSTRAP_DRAWS)


# Averages of lognormal errors with the median 1: the interval, and the true value.
LOGNORMAL_AVERAGES = {
    "interquartile mean": (averaged(interquartile_mean), lambda size: middle(stats.lognorm(spread(size)))),
    "median": (averaged(median), lambda size: 1.0),
    "median of shapes": (lambda errors, seed: typical(errors), lambda size: 1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("name", LOGNORMAL_AVERAGES)
def test_averages(size, name):
    interval, truth = LOGNORMAL_AVERAGES[name][0], LOGNORMAL_AVERAGES[name][1](size)

    def covers(generator, seed):
        return covered(interval(groups(lognormal(generator, size)), seed=seed), truth)

    coverage = simulated_coverage(covers)
    assert coverage >= MIN_COVERAGE and (size[-1] > 1 or coverage < 0.99)  # nor much too wide for single runs


@pytest.mark.parametrize("shapes", [6, 8, 12])
@pytest.mark.parametrize("failed", [20.0, math.inf])
def test_medians_of_shapes_of_which_some_fail(shapes, failed):
    """15 % of shapes fail or have 20 times the error; Student's interval of the mean logarithm covers 82 to 87 %."""
    deviation, shift = spread((shapes, 1)), math.log(failed)

    def below(logarithm: float) -> float:
        chances = stats.norm.cdf([logarithm / deviation, (logarithm - shift) / deviation])
        return float(chances @ [0.85, 0.15])

    truth = math.exp(brentq(lambda logarithm: below(logarithm) - 0.5, -5, 5))

    def covers(generator, _):
        errors = np.where(generator.random((shapes, 1)) < 0.15, failed, 1.0) * lognormal(generator, (shapes, 1))
        return covered(typical(list(errors)), truth)

    assert simulated_coverage(covers) >= 0.95 - 0.012


@pytest.mark.slow
@pytest.mark.parametrize("size", [(6, 1), (8, 2)], ids=str)
@pytest.mark.parametrize("name", ["interquartile means", "medians of shapes"])
def test_ratios(size, name):
    def covers(generator, seed):
        shapes, noise = generator.normal(size=(size[0], 1)), 0.4 * generator.normal(size=(2, *size))
        first, second = np.exp(shapes + noise)
        pair = list(1.25 * first), list(second)
        if name == "medians of shapes":
            return covered(ratio(*pair), 1.25)
        return covered(paired_bootstrap(*pair, interquartile_mean, seed=seed, draws=BOOTSTRAP_DRAWS), 1.25)

    assert simulated_coverage(covers) >= MIN_COVERAGE


@pytest.mark.slow
@pytest.mark.parametrize("size", [(6, 1), (6, 8), (8, 2), (8, 4), (16, 8)], ids=str)
@pytest.mark.parametrize("rate", [0.03, 0.1, 0.5, 0.9])
@pytest.mark.parametrize("alike", [0.0, 0.3, 0.8])  # correlation of the trials of a shape
def test_shares(size, rate, alike):
    shapes, trials = size
    weight = 1 / alike - 1 if alike else math.inf
    of_shape = stats.betabinom(trials, rate * weight, (1 - rate) * weight) if alike else stats.binom(trials, rate)
    counts = of_shape.rvs((SIMULATIONS, shapes), random_state=0)
    totals, times = np.unique(counts.sum(axis=1), return_counts=True)  # the interval depends on the sum alone
    samples = [counts[counts.sum(axis=1) == total][0] for total in totals]
    holds = [covered(share(counted.astype(float), np.full(shapes, float(trials))), rate) for counted in samples]
    assert np.dot(holds, times) / times.sum() >= MIN_COVERAGE


def test_shares_of_independent_trials_for_every_rate():
    """Such trials are at the ends of a stress sweep; Wilson's interval covers some rates in 84 % at 5 or 6 trials."""
    rates = np.linspace(0.002, 0.998, 250)
    for n in (1, 5, 6, 8, 40):
        intervals = [clopper_pearson(k / n, n) for k in range(n + 1)]
        holds = np.array([(interval.low <= rates) & (rates <= interval.high) for interval in intervals])
        assert ((stats.binom.pmf(np.arange(n + 1)[:, None], n, rates) * holds).sum(axis=0) >= 0.95 - 1e-9).all()
