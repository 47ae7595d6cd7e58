"""Permutation tests of paired differences: if both sides are equal, each difference can have either sign."""

from functools import cache
from itertools import product

import numpy as np

from bench.report.data.statistics import shapes_needed

MAX_EXACT_UNITS = 16  # up to here all sign vectors are tested, above it 2**15 random ones


@cache
def signs(units: int) -> np.ndarray:
    """The sign vectors [flips, units] whose first sign is positive: the others give the same sums, negated."""
    if units <= MAX_EXACT_UNITS:
        return np.array([(1.0, *others)[:units] for others in product((1.0, -1.0), repeat=max(units - 1, 0))])
    random_signs = np.random.default_rng(0).choice((1.0, -1.0), (2 ** (MAX_EXACT_UNITS - 1), units))
    random_signs[0] = 1
    return random_signs


def p_values(differences: np.ndarray) -> np.ndarray:
    """The p values [pairs] of differences [units, pairs]: the fraction of flips whose sum is at least as large."""
    sums = np.abs(differences.sum(axis=0))
    return (np.abs(signs(len(differences)) @ differences) >= sums - 1e-12).mean(axis=0)


def any_at_most(differences: np.ndarray, p_value: float) -> bool:
    """Whether the p value of any pair is at most `p_value`; pairs that fewer flips already refuse are not completed."""
    flips, sums = signs(len(differences)), np.abs(differences.sum(axis=0))
    counts = np.zeros(len(sums), int)
    for block in np.array_split(flips, 16):
        counts += (np.abs(block @ differences) >= sums - 1e-12).sum(axis=0)
        left = counts <= p_value * len(flips)
        differences, sums, counts = differences[:, left], sums[left], counts[left]
    return len(sums) > 0


def bounds(values: np.ndarray, alpha: float) -> tuple[float, float] | None:
    """The ends of simultaneous intervals, at 1 - alpha, of the means of values [units, columns]; None if few."""
    units, columns = values.shape
    if not columns or units < shapes_needed(columns, alpha):
        return None
    low, high = zip(*(interval(column, alpha / columns) for column in values.T), strict=True)
    return min(low), max(high)


def interval(values: np.ndarray, alpha: float) -> tuple[float, float]:
    """The confidence interval of the mean of values [units] at level 1 - alpha: the means that the test accepts."""
    flips, ends = signs(len(values)), []
    sums, counts = flips @ values, flips.sum(axis=1)
    for end in (values.min(), values.max()):
        accepted, rejected = values.mean(), 2 * end - values.mean()
        for _ in range(50):
            mean = (accepted + rejected) / 2
            p_value = np.mean(np.abs(sums - mean * counts) >= np.abs(sums[0] - mean * counts[0]) - 1e-12)
            accepted, rejected = (mean, rejected) if p_value > alpha else (accepted, mean)
        ends.append(float(accepted))
    return ends[0], ends[1]
