"""Permutation tests of paired differences: where both sides are equal, each difference has either sign."""

from functools import cache
from itertools import product

import numpy as np

MOST_EXACT = 16  # units of which all signs are tried; of more, 2**16 random signs


@cache
def signs(units: int) -> np.ndarray:
    """The signs of units [flips, units], of which the first are all positive."""
    if units <= MOST_EXACT:
        return np.array([*product((1.0, -1.0), repeat=units)])
    drawn = np.random.default_rng(0).choice((1.0, -1.0), (2**MOST_EXACT, units))
    drawn[0] = 1
    return drawn


def chances(differences: np.ndarray) -> np.ndarray:
    """Of differences [units, pairs] the probability [pairs] of as large a sum if each unit's had either sign."""
    sums = np.abs(differences.sum(axis=0))
    return (np.abs(signs(len(differences)) @ differences) >= sums - 1e-12).mean(axis=0)


def not_rejected(values: np.ndarray, alpha: float) -> tuple[float, float]:
    """The ends of the means of values [units] that flipped signs do not reject, by bisection."""
    drawn, ends = signs(len(values)), []
    sums, counts = drawn @ values, drawn.sum(axis=1)
    for end in (values.min(), values.max()):
        kept, lost = values.mean(), 2 * end - values.mean()
        for _ in range(50):
            mean = (kept + lost) / 2
            chance = np.mean(np.abs(sums - mean * counts) >= np.abs(sums[0] - mean * counts[0]) - 1e-12)
            kept, lost = (mean, lost) if chance > alpha else (kept, mean)
        ends.append(float(kept))
    return ends[0], ends[1]


def bounds(values: np.ndarray, alpha: float) -> tuple[float, float] | None:
    """The ends of the means of all columns of values [units, columns] that are not rejected, at alpha in all.

    None where there are too few units to reject any mean, or no column.
    """
    units, columns = values.shape
    if not columns or 2 / 2**units > alpha / columns:
        return None
    low, high = zip(*(not_rejected(column, alpha / columns) for column in values.T), strict=True)
    return min(low), max(high)
