"""The standing of the suite: which share of problems and targets each row reaches within the budget, at what cost.

After data profiles (Moré and Wild 2009, "Benchmarking derivative-free optimization algorithms") and the targets of COCO
(Hansen et al. 2021): an error e has the remainder r = log(e / reference) / log(start / reference), 1 at the start and 0
at the reference, and a target is an r that is reached once the error stays at or below it to the end of the run.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from math import inf, isfinite, nan
from typing import Any

import numpy as np

from bench.report.data import statistics
from bench.report.data.records import grouped
from bench.report.data.statistics import Interval
from bench.report.suite.attempts import Attempt, joined, suite
from bench.tables import choice

REFERENCE = "dist"  # the preset of the row by whose costs others are divided
COST, SECONDS = 0, 1  # places in what a target was reached at


@dataclass(frozen=True)
class Standing:
    """Attempts of several rows, one of each at a problem and seed.

    Args:
        everything: of which those at problems that the reference row has no attempt at are not judged.
        clocks: attempts of the reference row on other machines too, by whose seconds those of other rows are divided.
    """

    everything: list[Attempt]
    clocks: list[Attempt] = field(default_factory=list)

    @classmethod
    def of_all(cls, attempts: Iterable[Attempt]) -> "Standing":
        """Of attempts that may have several at a key."""
        every = [*attempts]
        return cls([*joined(every).values()], every)

    @cached_property
    def reference(self) -> str | None:
        """The row by whose costs others are divided; None where there is none."""
        label = choice("renderer", REFERENCE).get("_label_")
        rows = sorted({one.row for one in self.everything if one.preset == REFERENCE})
        return label if label in rows else next(iter(rows), None)

    @cached_property
    def attempts(self) -> list[Attempt]:
        """The attempts at problems and seeds that the reference row has one at; all where there is no such row."""
        known = {one.key[:3] for one in self.everything if one.row == self.reference}
        return [one for one in self.everything if not known or one.key[:3] in known]

    @cached_property
    def rows(self) -> list[str]:
        """The rows, the one that reaches the most first; of those that lack a problem, last."""
        found = grouped(self.attempts, lambda one: one.row)
        return sorted(found, key=lambda row: (self.lacking(row), -self.share(row).value, row))

    @cached_property
    def sets(self) -> list[str]:
        """The sets of problems, in the order of the suite."""
        return [name for name in suite().errors if any(one.set == name for one in self.attempts)]

    @cached_property
    def references(self) -> dict[tuple[str, str], float]:
        """The reference error of each set and problem: the suite's, or else the least final error of any row."""
        found = {}
        for (of_set, problem), own in grouped(self.attempts, lambda one: (one.set, one.problem)).items():
            known = suite().references.get(of_set, {})
            stated = known.get(own[0].scene, known.get("all"))
            found[of_set, problem] = min(one.final for one in own) if stated is None else stated
        return found

    @cached_property
    def starts(self) -> dict[tuple[Any, ...], float]:
        """The error before, of each problem and seed: the median of the finite ones of all rows."""
        known = grouped((one for one in self.attempts if isfinite(one.start)), lambda one: one.key[:3])
        return {key: float(np.median([one.start for one in own])) for key, own in known.items()}

    @cached_property
    def judged(self) -> list[Attempt]:
        """The attempts at problems whose start is worse than the reference, so that there is something to do."""
        return [
            one
            for one in self.attempts
            if self.starts.get(one.key[:3], 0.0) > self.references[one.set, one.problem] > 0
        ]

    @cached_property
    def scenes(self) -> set[str]:
        """The scenes of the judged attempts."""
        return {one.scene for one in self.judged}

    @cached_property
    def left_out(self) -> list[str]:
        """The problems that are not judged."""
        every, judged = ({f"{one.set}: {one.problem}" for one in of} for of in (self.attempts, self.judged))
        return sorted(every - judged)

    @cached_property
    def reached(self) -> dict[tuple[Any, ...], list[tuple[float, float]]]:
        """Of each judged attempt by its key, the cost and the seconds of each target; infinite where not reached."""
        return {one.key: self._reached(one) for one in self.judged}

    def _reached(self, one: Attempt) -> list[tuple[float, float]]:
        reference, start = self.references[one.set, one.problem], self.starts[one.key[:3]]
        errors = [reference * (start / reference) ** target for target in suite().targets]
        return [one.reached(error) or (inf, inf) for error in errors]

    @cached_property
    def _by_row(self) -> dict[str, list[Attempt]]:
        return grouped(self.judged, lambda one: one.row)

    def of(self, row: str, of_set: str | None = None) -> list[Attempt]:
        """The judged attempts of a row, in one set or in all."""
        return [one for one in self._by_row.get(row, []) if of_set in (None, one.set)]

    def preset(self, row: str) -> str:
        """What decides a row's look."""
        return next(one.preset for one in self.attempts if one.row == row)

    def lacking(self, row: str) -> int:
        """How many problems and seeds of other rows a row has no attempt at."""
        return len({one.key[:3] for one in self.attempts} - {one.key[:3] for one in self.attempts if one.row == row})

    def failures(self, row: str) -> Counter[str]:
        """How many attempts of a row ended otherwise than ok, by their status."""
        return Counter(one.status for one in self.attempts if one.row == row and not one.ok)

    def share(self, row: str, of_set: str | None = None) -> Interval:
        """The share of problems and targets that a row reaches, with its interval over scenes; nan without any."""
        return _mean(self._solved(row, of_set).values())

    def _solved(self, row: str, of_set: str | None = None) -> dict[str, np.ndarray]:
        """Of each scene, which targets of its problems a row reaches: 1 or 0."""
        scenes = grouped(sorted(self.of(row, of_set), key=lambda one: one.key), lambda one: one.scene)
        return {
            scene: np.array([float(isfinite(at[COST])) for one in own for at in self.reached[one.key]])
            for scene, own in scenes.items()
        }

    @cached_property
    def units(self) -> dict[str, float]:
        """Of each set the median cost of a whole run of the reference row, or of any row where there is none."""
        known = {one.row for one in self.judged} & {self.reference} or {one.row for one in self.judged}
        found = grouped((one for one in self.judged if one.row in known), lambda one: one.set)
        return {of_set: float(np.median([one.cost for one in own])) or 1.0 for of_set, own in found.items()}

    def profile(self, row: str, of_set: str | None = None) -> tuple[list[float], list[float]]:
        """Costs in units of their sets, ascending, to the largest of any attempt, and the share reached at each."""
        own = self.of(row, of_set)
        costs = [at[COST] / self.units[one.set] for one in own for at in self.reached[one.key]]
        known = np.sort([cost for cost in costs if isfinite(cost)])
        if not len(known):
            return [], []
        steps = np.unique(known).tolist()
        shares = [float(np.searchsorted(known, cost, side="right")) / len(costs) for cost in steps]
        return [steps[0], *steps, max(one.cost / self.units[one.set] for one in own)], [0.0, *shares, shares[-1]]

    def ratio(self, row: str, of: int = COST) -> Interval | None:
        """The ratio of a row's cost to the reference's over the targets that both reach: the median over scenes.

        Args:
            of: `COST`, or `SECONDS`, of attempts on the same machine alone, while it was not loaded.
        """
        if self.reference in (None, row):
            return None
        known = [*self.clocks, *self.everything] if of == SECONDS else self.everything

        def place(one: Attempt) -> tuple[Any, ...]:
            return (*one.key[:3], one.machine if of == SECONDS else "")

        counts = [one for one in known if of == COST or one.timed]
        others = {place(one): one for one in counts if one.row == self.reference}
        scenes: dict[str, list[tuple[float, float]]] = {}
        for one in self.of(row):
            if (other := others.get(place(one))) is None or (of == SECONDS and not one.timed):
                continue
            pairs = zip(self.reached[one.key], self._reached(other), strict=True)
            both = [(a[of], b[of]) for a, b in pairs if isfinite(a[of]) and isfinite(b[of])]
            scenes.setdefault(one.scene, []).extend(both)
        groups = [np.array(pairs).T for pairs in scenes.values() if pairs]
        return statistics.ratio([g[0] for g in groups], [g[1] for g in groups]) if groups else None

    @cached_property
    def ranks(self) -> dict[str, int]:
        """The rank of each row that lacks no problem; rows that cannot be told from the first of a rank share it."""
        found, first, rank = dict[str, int](), "", 1
        for place, row in enumerate([row for row in self.rows if not self.lacking(row)], 1):
            if not first or (between := self.difference(first, row)).low > 0 or between.high < 0:
                first, rank = row, place
            found[row] = rank
        return found

    def difference(self, first: str, second: str) -> Interval:
        """By how much the share of one row is larger than that of another with the same problems."""
        one, other = self._solved(first), self._solved(second)
        return _mean(one[scene] - other[scene] for scene in one)

    @cached_property
    def resolution(self) -> float | None:
        """The difference of shares that so many scenes just tell apart, in the median of rows; None if they tell none.

        It is half the width of the interval of a row's difference from the first one.
        """
        first, *others = self.ranks or [""]
        found = [self.difference(first, row) for row in others]
        return float(np.median([(one.high - one.low) / 2 for one in found])) if found and found[0].known else None


def _mean(scenes: Iterable[np.ndarray]) -> Interval:
    """The mean over all targets, with the bootstrap interval over scenes; nan without a target."""
    groups = [*scenes]
    if not groups:
        return Interval(nan, nan, nan)
    return statistics.bootstrap(groups, lambda drawn: np.mean(drawn, axis=-1), seed=0)
