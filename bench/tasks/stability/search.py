"""An adaptive search for the breakdown: the severity at which half of the trials succeed.

The success probability falls along a logistic curve of the level, from 0 (mild) to 1 (severe). A table holds posterior
probabilities of the curve's middle and width. Each trial has the level that is expected to be most informative (the psi
method of Kontsevich and Tyler 1999). The interval is the central 95 % of the posterior.

If repeats of a trial cannot differ, each level is tried once. The breakdown lies between two neighbouring levels, and
has no interval.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from renderers.checks import check_at_least

WIDTHS = (0.003, 0.01, 0.03, 0.08, 0.2)  # candidates; unit: the whole range of levels
LAPSE_PROBABILITY = 0.02  # a trial fails, or succeeds, independently of its level
MAX_MIDDLE_OUTSIDE = 0.15  # the middle may lie this far outside the range of levels
MIDDLES_PER_LEVEL = 4
CREDIBLE_PROBABILITY = 0.95


@dataclass(frozen=True)
class SearchSettings:
    """The resolution and the length of a search.

    Args:
        levels: number of levels of the equivalent full grid, both ends included.
        repeats: trials per level of that grid; the search makes at most half of the grid's trials.
    """

    levels: int
    repeats: int

    def __post_init__(self) -> None:
        check_at_least("task.search.levels", self.levels, 3, "33 resolve a fifth of a decade over six decades")
        check_at_least("task.search.repeats", self.repeats, 2, "5 are little: 0 of 5 still allows 43 %")


@dataclass(frozen=True)
class Breakdown:
    """The level at which half of the trials succeed, with its interval; below 0 or above 1 it is outside the sweep.

    Without repeats it has no interval and no width.
    """

    level: float
    low: float | None = None
    high: float | None = None
    width: float | None = None  # the most probable width of the logistic curve


class Search:
    """Chooses the level of each trial from the outcomes of earlier trials."""

    def __init__(self, settings: SearchSettings) -> None:
        self.settings = settings
        self.levels = np.linspace(0.0, 1.0, settings.levels)
        self.grid_trials = settings.levels * settings.repeats  # trials of the full grid
        self.max_trials = self.grid_trials // 2
        step = 1.0 / (settings.levels - 1) / MIDDLES_PER_LEVEL
        self.middles = np.arange(-MAX_MIDDLE_OUTSIDE, 1.0 + MAX_MIDDLE_OUTSIDE + step / 2, step)
        self.probabilities = np.full((len(self.middles), len(WIDTHS)), 1.0 / len(self.middles) / len(WIDTHS))
        self.trials: list[tuple[int, bool]] = []  # the index of the level, and whether the trial succeeded

    @cached_property
    def _success(self) -> np.ndarray:
        """The chance of success [level, middle, width]."""
        scaled = (self.middles[None, :, None] - self.levels[:, None, None]) / np.array(WIDTHS)
        return LAPSE_PROBABILITY + (1 - 2 * LAPSE_PROBABILITY) / (1 + np.exp(-np.clip(scaled, -50, 50)))

    def next(self) -> int | None:
        """The index of the next trial's level; None if the interval is short enough or the trials are used up.

        The two ends come first. If the breakdown lies at or beyond an end, that end is tried at least `repeats` times,
        to measure its success rate.
        """
        if len(self.trials) >= self.max_trials:
            return None
        tried = [index for index, _ in self.trials]
        last = self.settings.levels - 1
        for end in (0, last):
            if end not in tried:
                return end
        breakdown, (low, high) = self.result(), self._interval()
        if high - low <= 2 / last or low > 1 or high < 0:
            is_decisive = {0: breakdown.level < 1 / last, last: breakdown.level > 1 - 1 / last}
            undertested = [end for end in is_decisive if is_decisive[end] and tried.count(end) < self.settings.repeats]
            return undertested[0] if undertested else None
        return self._most_informative()

    def note(self, index: int, success: bool) -> None:
        self.trials.append((index, success))
        chance = self._success[index]
        self.probabilities = self.probabilities * (chance if success else 1 - chance)
        self.probabilities /= self.probabilities.sum()

    def result(self) -> Breakdown:
        low, high = self._interval()
        return Breakdown(self._quantile(0.5), low, high, WIDTHS[int(self.probabilities.sum(axis=0).argmax())])

    def _interval(self) -> tuple[float, float]:
        return self._quantile((1 - CREDIBLE_PROBABILITY) / 2), self._quantile((1 + CREDIBLE_PROBABILITY) / 2)

    def _quantile(self, probability: float) -> float:
        """The quantile of the posterior of the middle."""
        below = self.probabilities.sum(axis=1).cumsum()
        return float(self.middles[min(int(np.searchsorted(below, probability)), len(below) - 1)])

    def _most_informative(self) -> int:
        """The index of the level whose trial gives the smallest expected entropy."""
        chance = self._success
        succeeds = (chance * self.probabilities).sum(axis=(1, 2))
        after = _entropy(chance * self.probabilities), _entropy((1 - chance) * self.probabilities)
        return int(np.argmin(succeeds * after[0] + (1 - succeeds) * after[1]))


class Bisection:
    """Halves the levels between the last success and the first failure, each tried once."""

    def __init__(self, settings: SearchSettings) -> None:
        self.settings = settings
        self.levels = np.linspace(0.0, 1.0, settings.levels)
        self.outcomes: dict[int, bool] = {}  # success by the level's index
        self.grid_trials = settings.levels
        self.max_trials = 2 + (settings.levels - 2).bit_length()  # both ends, and one per halving

    def next(self) -> int | None:
        """The index of the next trial's level, the two ends first; None if the breakdown lies between neighbours."""
        last = self.settings.levels - 1
        for end in (0, last):
            if end not in self.outcomes:
                return end
        success, failure = self._bracket()
        return (success + failure) // 2 if failure - success > 1 else None

    def note(self, index: int, success: bool) -> None:
        self.outcomes[index] = success

    def result(self) -> Breakdown:
        """The middle between the last success and the first failure; half a step outside if one is missing."""
        success, failure = self._bracket()
        return Breakdown((success + failure) / 2 / (self.settings.levels - 1))

    def _bracket(self) -> tuple[int, int]:
        """The indices of the last success before the first failure and of that failure; or beyond the ends."""
        failure = min((index for index, success in self.outcomes.items() if not success), default=self.settings.levels)
        before = [index for index, success in self.outcomes.items() if success and index < failure]
        return max(before, default=-1), failure


def _entropy(tables: np.ndarray) -> np.ndarray:
    """The entropy of each of the tables [levels, middles, widths], scaled to a sum of 1."""
    shares = tables / tables.sum(axis=(1, 2), keepdims=True)
    return -(shares * np.log(np.maximum(shares, 1e-300))).sum(axis=(1, 2))
