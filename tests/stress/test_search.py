"""The adaptive search finds the middle of a logistic curve, with an interval that holds, in half of a grid's trials."""

import numpy as np
import pytest

from bench.stress.search import Bisection, Search, SearchSettings
from tests.looped import each

DESK = SearchSettings(levels=33, repeats=5)


def searched(settings: SearchSettings, succeeds) -> Search:
    search = Search(settings)
    while (level := search.next()) is not None:
        search.note(level, bool(succeeds(float(search.levels[level]))))
    return search


@each("middle", [0.05, 0.31, 0.5, 0.77, 0.95])
def test_a_sharp_breakdown_lies_in_a_short_interval(middle):
    search = searched(DESK, lambda level: level < middle)
    found = search.result()
    assert found.low <= middle <= found.high
    assert found.low <= found.level <= found.high
    assert found.high - found.low < 0.08
    assert len(search.trials) < 25


@each("width, least", [(0.02, 0.9), (0.08, 0.8)])
def test_the_interval_of_a_noisy_breakdown_holds(width, least):
    generator = np.random.default_rng(1)
    holds = 0
    for _ in range(20):
        middle = generator.uniform(0.1, 0.9)
        search = searched(
            DESK, lambda level, m=middle: generator.random() < 1 / (1 + np.exp(np.clip((level - m) / width, -50, 50)))
        )
        found = search.result()
        holds += found.low <= middle <= found.high
        assert len(search.trials) <= search.most
    assert holds / 20 >= least


@each("succeeds, end", [(True, 32), (False, 0)])
def test_an_end_without_a_breakdown_is_tried_repeatedly(succeeds, end):
    search = searched(DESK, lambda level: succeeds)
    found = search.result()
    assert found.low > 1 if succeeds else found.high < 0
    assert search.trials.count((end, succeeds)) >= DESK.repeats


def bisected(succeeds, levels: int = 33) -> Bisection:
    search = Bisection(SearchSettings(levels, 5))
    while (level := search.next()) is not None:
        assert level not in search.outcomes  # a level is tried once
        search.note(level, bool(succeeds(float(search.levels[level]))))
    return search


@each("levels", [3, 9, 17, 33])
@each("middle", [0.01, 0.31, 0.5, 0.77, 0.999])
def test_without_repeats_the_breakdown_lies_between_neighbours_and_has_no_interval(middle, levels):
    search = bisected(lambda level: level < middle, levels)
    found = search.result()
    assert abs(found.level - middle) <= 0.5 / (levels - 1) + 1e-12
    assert (found.low, found.high, found.width) == (None, None, None)
    assert len(search.outcomes) <= search.most < levels + 1 == search.grid + 1


@each("succeeds, level", [(True, 1 + 0.5 / 32), (False, -0.5 / 32)])
def test_without_repeats_an_end_is_tried_once(succeeds, level):
    search = bisected(lambda at: succeeds)
    assert search.result().level == pytest.approx(level)
    assert search.outcomes == {0: succeeds, 32: succeeds}


def test_without_repeats_a_failure_at_the_mild_end_decides():
    assert bisected(lambda level: level > 0.5).result().level < 0
