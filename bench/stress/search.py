"""An adaptive search for the breakdown: the severity at which half of the trials succeed.

The chance of success falls along a logistic curve of the level, from 0 (mild) to 1 (severe). A table holds posterior
probabilities of its middle and width; each trial is made where it is expected to be most informative (the psi method
of Kontsevich and Tyler 1999). The interval is the central 95 % of the posterior.

Where repeats of a trial cannot differ, a level is tried once, and the breakdown lies between two neighbouring levels;
it has no interval.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from renderers.checks import check_at_least

WIDTHS = (0.003, 0.01, 0.03, 0.08, 0.2)  # of the logistic curve, in levels from 0 to 1
LAPSE = 0.02  # chance that a trial fails, or succeeds, independently of its level
BEYOND = 0.15  # how far outside the sweep the middle may lie, in levels
FINENESS = 4  # middles in the table per step between two levels
CERTAIN = 0.95


@dataclass(frozen=True)
class SearchSettings:
    """The resolution and the length of a search.

    Args:
        levels: of the equivalent full grid, both ends included.
        repeats: trials per level of that grid; the search makes half of the grid's trials at most.
    """

    levels: int
    repeats: int

    def __post_init__(self) -> None:
        check_at_least("task.search.levels", self.levels, 3, "33 resolve a fifth of a decade over six decades")
        check_at_least("task.search.repeats", self.repeats, 2, "5 are little: 0 of 5 still allows 43 %")


@dataclass(frozen=True)
class Breakdown:
    """The level at which half of the trials succeed, with its interval; below 0 or above 1 it is outside the sweep.

    Without repeats there are no interval and no width.
    """

    level: float
    low: float | None = None
    high: float | None = None
    width: float | None = None  # of the logistic curve, the most probable


class Search:
    """Chooses the level of each trial from the outcomes of those before."""

    def __init__(self, settings: SearchSettings) -> None:
        self.settings = settings
        self.levels = np.linspace(0.0, 1.0, settings.levels)
        self.grid = settings.levels * settings.repeats  # trials of the full grid
        self.most = self.grid // 2
        step = 1.0 / (settings.levels - 1) / FINENESS
        self.middles = np.arange(-BEYOND, 1.0 + BEYOND + step / 2, step)
        self.probabilities = np.full((len(self.middles), len(WIDTHS)), 1.0 / len(self.middles) / len(WIDTHS))
        self.trials: list[tuple[int, bool]] = []  # the index of the level, and whether it succeeded

    @cached_property
    def _success(self) -> np.ndarray:
        """The chance of success [level, middle, width]."""
        apart = (self.middles[None, :, None] - self.levels[:, None, None]) / np.array(WIDTHS)
        return LAPSE + (1 - 2 * LAPSE) / (1 + np.exp(-np.clip(apart, -50, 50)))

    def next(self) -> int | None:
        """The index of the level of the next trial; None where the interval is short enough or the trials are used up.

        The two ends come first. An end at or beyond which the breakdown lies is tried `repeats` times at least, so that
        a success rate is known for it.
        """
        if len(self.trials) >= self.most:
            return None
        tried = [index for index, _ in self.trials]
        last = self.settings.levels - 1
        for end in (0, last):
            if end not in tried:
                return end
        found, (low, high) = self.result(), self._interval()
        if high - low <= 2 / last or low > 1 or high < 0:
            decides = {0: found.level < 1 / last, last: found.level > 1 - 1 / last}
            short = [end for end in decides if decides[end] and tried.count(end) < self.settings.repeats]
            return short[0] if short else None
        return self._most_informative()

    def note(self, index: int, success: bool) -> None:
        """Updates the table with a trial at the level of an index."""
        self.trials.append((index, success))
        chance = self._success[index]
        self.probabilities = self.probabilities * (chance if success else 1 - chance)
        self.probabilities /= self.probabilities.sum()

    def result(self) -> Breakdown:
        """The breakdown by the current table."""
        low, high = self._interval()
        return Breakdown(self._quantile(0.5), low, high, WIDTHS[int(self.probabilities.sum(axis=0).argmax())])

    def _interval(self) -> tuple[float, float]:
        return self._quantile((1 - CERTAIN) / 2), self._quantile((1 + CERTAIN) / 2)

    def _quantile(self, share: float) -> float:
        """The middle below which this share of the posterior lies."""
        below = self.probabilities.sum(axis=1).cumsum()
        return float(self.middles[min(int(np.searchsorted(below, share)), len(below) - 1)])

    def _most_informative(self) -> int:
        """The level whose trial leaves the least expected entropy."""
        chance = self._success
        succeeds = (chance * self.probabilities).sum(axis=(1, 2))
        after = _entropy(chance * self.probabilities), _entropy((1 - chance) * self.probabilities)
        return int(np.argmin(succeeds * after[0] + (1 - succeeds) * after[1]))


class Bisection:
    """Halves the levels between the last success and the first failure, each tried once."""

    def __init__(self, settings: SearchSettings) -> None:
        self.settings = settings
        self.levels = np.linspace(0.0, 1.0, settings.levels)
        self.outcomes: dict[int, bool] = {}  # of each level that was tried, by its index
        self.grid = settings.levels
        self.most = 2 + (settings.levels - 2).bit_length()  # both ends, and one per halving

    def next(self) -> int | None:
        """The index of the next trial's level, the two ends first; None where the breakdown lies between neighbours."""
        last = self.settings.levels - 1
        for end in (0, last):
            if end not in self.outcomes:
                return end
        success, failure = self._around()
        return (success + failure) // 2 if failure - success > 1 else None

    def note(self, index: int, success: bool) -> None:
        """Keeps the outcome at the level of an index."""
        self.outcomes[index] = success

    def result(self) -> Breakdown:
        """The middle between the last success and the first failure; half a step outside where an end decides."""
        success, failure = self._around()
        return Breakdown((success + failure) / 2 / (self.settings.levels - 1))

    def _around(self) -> tuple[int, int]:
        """The indices of the last success before the first failure and of that failure; beyond an end without one."""
        failure = min((index for index, success in self.outcomes.items() if not success), default=self.settings.levels)
        before = [index for index, success in self.outcomes.items() if success and index < failure]
        return max(before, default=-1), failure


def _entropy(tables: np.ndarray) -> np.ndarray:
    """The entropy of each of the tables [levels, middles, widths], scaled to a sum of 1."""
    shares = tables / tables.sum(axis=(1, 2), keepdims=True)
    return -(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=(1, 2))
