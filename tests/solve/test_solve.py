"""The iterations at which the state of a run is evaluated."""

from bench.solve.optimise import BUDGET, OptimiserSettings
from bench.solve.solve import checkpoints_of
from tests.looped import each


@each("interval, iterations, expected", [
    (5, 12, {0, 5, 10, 11}), (5, 11, {0, 5, 10}), (100, 12, {0, 11}), (1, 1, {0}),
    ("doubling", 12, {0, 1, 2, 4, 8, 11}), ("doubling", 9, {0, 1, 2, 4, 8}), ("doubling", 1, {0}), (None, 12, set()),
])  # fmt: skip
def test_checkpoints_begin_with_the_first_iteration_and_end_with_the_last(interval, iterations, expected):
    assert checkpoints_of(interval, OptimiserSettings(iterations, 0.1, "constant")) == sorted(expected)


def test_checkpoints_of_a_loop_that_its_budget_ends_are_costs():
    settings = OptimiserSettings(100, 0.1, "constant", 1000.0, BUDGET)
    assert checkpoints_of(5, settings) == [0, 30, 100, 200, 500] and checkpoints_of(None, settings) == []
