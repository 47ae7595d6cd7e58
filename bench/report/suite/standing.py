"""The standing of the suite: which share of problems and targets each row reaches, and at what cost.

After data profiles (Moré and Wild 2009, "Benchmarking derivative-free optimization algorithms") and the targets of COCO
(Hansen et al. 2021): an error e has the remainder r = log(e / reference) / log(start / reference), 1 at the start and 0
at the reference, and a target is an r that is reached once the error stays at or below it to the end of the run. Each
set of problems weighs the same. Renderings, which have no course, stand apart: their wrong pixels are a number.
"""

from collections import Counter
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from math import comb, inf, isfinite, nan
from typing import Any

import numpy as np
from scipy.special import stdtrit

from bench.report.data import statistics
from bench.report.data.records import grouped
from bench.report.data.statistics import Interval
from bench.report.suite.attempts import APART, BY_ITSELF, Attempt, joined, least_problems, suite
from bench.tables import choice

REFERENCE = "dist"  # the preset of the row by whose costs others are divided
COST, SECONDS = 0, 1  # places in what a target was reached at
FLIPS = 16  # most scenes of which all signs are tried; of more, as many random ones as there are of these
POWER = 0.8  # the share of cases in which a difference of the resolution is found


@dataclass(frozen=True)
class Standing:
    """The newest attempts of several rows at problems and seeds.

    Rows are compared at the problems that all of them have, but for rows that lack some of the least size: these are
    `lacking`. Attempts under other settings than most of the set's are not judged.

    Args:
        everything: in any order, also several of a key. Those at problems that the reference row has no attempt at are
            not judged. Seconds are divided by those of the reference row on the same machine, of whatever age.
    """

    everything: list[Attempt]

    @cached_property
    def reference(self) -> str | None:
        """The row by whose costs others are divided; None where there is none."""
        label = choice("renderer", REFERENCE).get("_label_")
        rows = sorted({one.row for one in self.everything if one.preset == REFERENCE})
        return label if label in rows else next(iter(rows), None)

    @cached_property
    def _settings(self) -> dict[tuple[str, bool], str]:
        """Of each set, and of its tuned rows, the settings that most attempts have."""
        return {
            part: max(Counter(one.settings for one in own).items(), key=lambda found: (found[1], found[0]))[0]
            for part, own in grouped(joined(self.everything), lambda one: (one.set, one.tuned)).items()
        }

    def _is_alike(self, one: Attempt) -> bool:
        return one.settings == self._settings[one.set, one.tuned]

    @cached_property
    def alike(self) -> list[Attempt]:
        """The newest attempt of each row at each problem and seed, under the settings that most of its set have."""
        return joined(filter(self._is_alike, self.everything))

    @cached_property
    def _known(self) -> dict[str, set[tuple[Any, ...]]]:
        """The problems and seeds of each row, of those that the reference row has, if there is one."""
        every = grouped(self.alike, lambda one: one.row)
        keys = {row: {one.key[:3] for one in own} for row, own in every.items()}
        return {row: own & keys.get(str(self.reference), own) for row, own in keys.items()}

    @cached_property
    def _needed(self) -> set[tuple[Any, ...]]:
        """The problems and seeds that a row must have: the least size's, or all if the reference lacks one."""
        known = self._known.get(str(self.reference)) or set().union(*self._known.values())
        least = least_problems()
        return least if least <= known else known

    @cached_property
    def compared(self) -> set[tuple[Any, ...]]:
        """The problems and seeds at which rows are compared."""
        whole = [own for own in self._known.values() if own >= self._needed]
        return set.intersection(*whole) if whole else self._needed

    def lacking(self, row: str) -> int:
        """How many of the problems and seeds that it must have a row has no attempt at."""
        return len(self._needed - self._known[row])

    def not_run(self, row: str) -> int:
        """As `lacking`, but for sets that a row at tuned settings has none of."""
        sets = {key[0] for key in self._known[row] if row.endswith(BY_ITSELF)}
        return sum(not sets or key[0] in sets for key in self._needed - self._known[row])

    @cached_property
    def attempts(self) -> list[Attempt]:
        """The attempts at the problems and seeds at which rows are compared."""
        return [one for one in self.alike if one.key[:3] in self.compared]

    @cached_property
    def rows(self) -> list[str]:
        """The rows, the one that reaches the most first; those that lack problems last, tuned ones behind theirs."""
        found = dict.fromkeys(one.row for one in self.attempts)

        def place(row: str) -> tuple[Any, ...]:
            stated = row.removesuffix(BY_ITSELF)
            of = stated if stated in found else row
            return self.lacking(of), -np.nan_to_num(self.share(of).value), stated, row

        return sorted(found, key=place)

    @cached_property
    def sets(self) -> list[str]:
        """The sets of problems with judged attempts, in the order of the suite."""
        return [name for name in suite().errors if any(one.set == name for one in self.judged)]

    @cached_property
    def references(self) -> dict[tuple[str, str], float]:
        """The reference error of each set and problem: the suite's, or else the least final error at its setting."""
        found = {}
        for (of_set, problem), own in grouped(self.attempts, lambda one: (one.set, one.problem)).items():
            known = suite().references.get(of_set, {})
            stated = known.get(problem, known.get(own[0].scene, known.get("all")))
            least = min((one.final for one in own if not one.tuned), default=inf)
            found[of_set, problem] = least if stated is None else stated
        return found

    @cached_property
    def starts(self) -> dict[tuple[Any, ...], float]:
        """The error before, of each problem and seed: the median of the finite ones, if any of attempts that are ok."""
        known = grouped((one for one in self.attempts if isfinite(one.start)), lambda one: one.key[:3])
        sound = {key: [one for one in own if one.ok] or own for key, own in known.items()}
        return {key: float(np.median([one.start for one in own])) for key, own in sound.items()}

    @cached_property
    def judged(self) -> list[Attempt]:
        """The attempts with a course, at problems whose start is worse than the reference."""
        return [
            one
            for one in self.attempts
            if one.set not in APART and self.starts.get(one.key[:3], 0.0) > self.references[one.set, one.problem] > 0
        ]

    def scenes(self, of_set: str | None = None) -> int:
        """The number of scenes of the judged attempts, in one set or in all."""
        return len({one.scene for one in self.judged if of_set in (None, one.set)})

    @cached_property
    def left_out(self) -> list[str]:
        """The problems of sets with a course that are not judged."""
        with_course = [one for one in self.attempts if one.set not in APART]
        every, judged = ({f"{one.set}: {one.problem}" for one in of} for of in (with_course, self.judged))
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

    def failures(self, row: str) -> Counter[str]:
        """How many attempts of a row ended otherwise than ok, by their status."""
        return Counter(one.status for one in self.attempts if one.row == row and not one.ok)

    def wrong(self, row: str) -> float | None:
        """The mean share of the pixels of an object that a row renders wrongly; all of them where it failed."""
        own = [one for one in self.attempts if one.row == row and one.set in APART and self.starts.get(one.key[:3])]
        return float(np.mean([min(one.final / self.starts[one.key[:3]], 1.0) for one in own])) if own else None

    def share(self, row: str, of_set: str | None = None) -> Interval:
        """The share of targets that a row reaches, the mean of its sets', with its interval over scenes."""
        return _over_scenes(*self._solved(self.of(row, of_set)))

    def gain(self, row: str) -> Interval | None:
        """The share that a row at tuned settings reaches, less its renderer's at the set's, at the same problems."""
        own, other = ({one.key[:3]: one for one in self.of(name)} for name in (row, row.removesuffix(BY_ITSELF)))
        both = own.keys() & other.keys()
        if not row.endswith(BY_ITSELF) or not both:
            return None
        (tuned, every), (stated, _) = (self._solved([of[key] for key in both]) for of in (own, other))
        return _over_scenes(tuned - stated, every)

    def _solved(self, own: list[Attempt]) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of targets that attempts reach, and of all [scenes, sets]."""
        scenes, sets = (sorted({part(one) for one in own}) for part in (lambda one: one.scene, lambda one: one.set))
        reached, every = np.zeros((2, len(scenes), len(sets)))
        for one in own:
            at = scenes.index(one.scene), sets.index(one.set)
            reached[at] += sum(isfinite(cost) for cost, _ in self.reached[one.key])
            every[at] += len(suite().targets)
        return reached, every

    @cached_property
    def units(self) -> dict[tuple[Any, ...], float]:
        """The cost of the reference's run at each judged problem and seed; where it failed its median in the set."""
        known = [one for one in self.of(str(self.reference)) if one.ok and one.cost > 0]
        medians = {
            of_set: float(np.median([one.cost for one in own]))
            for of_set, own in grouped(known, lambda one: one.set).items()
        }
        found = {one.key[:3]: medians[one.set] for one in self.judged if one.set in medians}
        return found | {one.key[:3]: one.cost for one in known}

    def line(self, row: str) -> dict[str, Any]:
        """What tables say of a row."""
        lacking, seconds = self.not_run(row), self.ratio(row, SECONDS)
        failed = [f"{count} {status}" for status, count in self.failures(row).most_common()]
        return {
            **{"against": self.against(row), "row": row, "preset": self.preset(row), "share": self.share(row)},
            **{name: self.share(row, name).value for name in self.sets},
            **{"ratio": self.ratio(row), "gain": self.gain(row), "wrong": self.wrong(row)},
            "at_dist": nan if row.endswith(BY_ITSELF) else self.share_at_dist(row),
            "problems": len(self.of(row)),
            "seconds": seconds if seconds and seconds.known else None,
            "failed": ", ".join([*failed, *([f"{lacking} not run"] if lacking else [])]),
        }

    def profile(self, row: str, of_set: str | None = None) -> tuple[list[float], list[float]]:
        """Costs over the reference's, ascending, to the row's largest, and the share that it has reached at each."""
        own = [one for one in self.of(row, of_set) if one.key[:3] in self.units]
        sizes = Counter(one.set for one in own)
        steps = Counter[float]()
        for one in own:
            for at in self.reached[one.key]:
                if isfinite(at[COST]):
                    weight = 1 / (len(sizes) * sizes[one.set] * len(suite().targets))
                    steps[at[COST] / self.units[one.key[:3]]] += weight
        if not own:
            return [], []
        last = max(one.cost / self.units[one.key[:3]] for one in own)
        costs = sorted(steps)
        shares = np.cumsum([steps[cost] for cost in costs]).round(12).tolist()
        return [costs[0] if costs else last, *costs, last], [0.0, *shares, shares[-1] if shares else 0.0]

    def share_at_dist(self, row: str) -> float:
        """The share that a row has reached at the cost of the reference's run."""
        return max((share for at, share in zip(*self.profile(row), strict=True) if at <= 1), default=0.0)

    def ratio(self, row: str, of: int = COST) -> Interval | None:
        """The ratio of a row's cost to the reference's over the targets that both reach: the median over scenes.

        Args:
            of: `COST`, or `SECONDS`, of attempts on the same machine alone, while it was not loaded.
        """
        if self.reference in (None, row):
            return None

        def place(one: Attempt) -> tuple[Any, ...]:
            return (*one.key[:3], one.machine if of == SECONDS else "")

        known = self.alike
        if of == SECONDS:  # of whatever age, the newest on each machine
            timed = [one for one in self.everything if one.timed and self._is_alike(one)]
            known = sorted(timed, key=lambda one: one.started)
        others = {place(one): one for one in known if one.row == self.reference}
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
    def ranked(self) -> list[str]:
        """The rows that lack no problem, the one that reaches the most first."""
        return [row for row in self.rows if not self.lacking(row) and self.of(row)]

    @cached_property
    def told(self) -> set[str]:
        """The ranked rows whose shares are told from the first's: signs flipped over scenes, 5 % in all.

        Which row is first is found in the same runs, so that any pair of rows may be compared (Bonferroni).
        """
        first, *others = self.ranked or [""]
        return {row for row in others if self._chance(first, row) <= self._level}

    def against(self, row: str) -> str:
        """What is known of a row's share beside the first's; nothing of a row that lacks problems."""
        if row not in self.ranked:
            return ""
        return "first" if row == self.ranked[0] else "less" if row in self.told else "not told"

    def _chance(self, first: str, second: str) -> float:
        """The probability of as large a difference of shares where each scene's has either sign (permutation test)."""
        by_scene = self._apart(first, second)
        return float(np.mean(np.abs(_signs(len(by_scene)) @ by_scene) >= abs(by_scene.sum()) - 1e-12))

    def _apart(self, first: str, second: str) -> np.ndarray:
        """What each scene [scenes] adds to the difference of two rows' shares."""
        reached, every = self._solved(self.of(first))
        apart = (reached - self._solved(self.of(second))[0]) / every.sum(axis=0)
        return apart.mean(axis=1)

    @cached_property
    def _level(self) -> float:
        """The chance up to which a difference is told: 5 % over the number of pairs."""
        return (1 - statistics.LEVEL) / max(comb(len(self.ranked), 2), 1)

    @cached_property
    def resolution(self) -> float | None:
        """The difference of shares at which a row is told in four cases of five, in the median of rows.

        As by a t-test over scenes at the level of a pair. None where there are too few scenes to tell any row from the
        first, however far it is behind.
        """
        first, *others = self.ranked or [""]
        if not others or 2 / 2 ** self.scenes() > self._level:
            return None
        spreads = [float(np.std(self._apart(first, row), ddof=1)) * self.scenes() ** 0.5 for row in others]
        return float(sum(stdtrit(self.scenes() - 1, (1 - self._level / 2, POWER))) * np.median(spreads))


@cache
def _signs(scenes: int) -> np.ndarray:
    """The signs of scenes [flips, scenes]: all of few scenes, random ones of more, of which the first is what is."""
    if scenes <= FLIPS:
        return np.array([*product((1, -1), repeat=scenes)])
    signs = np.random.default_rng(0).choice((1, -1), (2**FLIPS, scenes))
    signs[0] = 1
    return signs


def _over_scenes(reached: np.ndarray, every: np.ndarray) -> Interval:
    """The mean over sets of what is reached of all, [scenes, sets], with the bootstrap interval over scenes."""
    if not every.size:
        return Interval(nan, nan, nan)

    def mean(drawn: Any) -> Any:  # of numbers of scenes [..., n]
        places = np.asarray(drawn, dtype=int)
        of = reached[places].sum(axis=-2), every[places].sum(axis=-2)
        known = of[1] > 0  # a set that is not drawn has no part: to give it the share of all covers 79 to 87 % at quick
        shares = np.divide(*of, out=np.zeros_like(of[0]), where=known)
        return shares.sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)

    return statistics.bootstrap([np.array([place]) for place in range(len(every))], mean)
