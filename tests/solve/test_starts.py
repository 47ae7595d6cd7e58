"""Whose turn it is among several starts, and which ones stay."""

import pytest
import torch

from bench.solve.optimise import Starts, StartSettings


def play(count: int, trial: int, iterations: int, loss) -> list[tuple[int, int]]:
    starts = Starts(StartSettings(count, trial))
    turns = []
    for iteration in range(iterations):
        start, own = starts.turn(iteration)
        starts.note(start, own, torch.tensor(float(loss(start, own))))
        turns.append((start, own))
    return turns


def test_they_take_turns_and_the_best_goes_on():
    turns = play(3, 2, 9, lambda start, own: (5.0, 1.0, 3.0)[start])
    assert turns == [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (1, 2), (1, 3), (1, 4)]


def test_a_quarter_stays_after_each_round():
    assert StartSettings(48, 4).rounds == [48, 12, 3]
    assert StartSettings(48, 4).trials == 4 * 63
    assert StartSettings(1, 8).rounds == []
    assert StartSettings(5, 1).rounds == [5, 2]
    turns = play(5, 1, 10, lambda start, own: 10 - start if own == 0 else 100 * start)
    assert [start for start, _ in turns] == [0, 1, 2, 3, 4, 4, 3, 3, 3, 3]  # 4 and 3 stay, then 3 is the better one
    assert [own for _, own in turns[5:]] == [1, 1, 2, 3, 4]


def test_a_start_is_scored_by_the_end_of_its_round():
    turns = play(2, 6, 20, lambda start, own: 100 - 30 * own if start else 10)
    assert turns[-1] == (1, 6 + 20 - 12 - 1)


def test_a_later_loss_changes_nothing():
    starts = Starts(StartSettings(2, 1))
    starts.note(0, 0, torch.tensor(1.0))
    starts.note(1, 0, torch.tensor(2.0))
    starts.note(0, 1, torch.tensor(9.0))
    assert starts.best() == 0
    assert starts.turn(7) == (0, 6)


def test_until_all_were_tried_it_is_the_first_one():
    starts = Starts(StartSettings(2, 1))
    starts.note(1, 0, torch.tensor(0.0))
    assert starts.best() == 0


def test_in_a_later_round_it_is_the_better_one_of_the_round_before():
    starts = Starts(StartSettings(5, 1))
    for start, loss in enumerate((5.0, 4.0, 1.0, 3.0, 2.0)):
        starts.note(start, 0, torch.tensor(loss))
    assert starts.best() == 2
    starts.note(2, 1, torch.tensor(9.0))
    assert starts.best() == 2  # the round of two is not over
    starts.note(4, 1, torch.tensor(1.0))
    assert starts.best() == 4


def test_a_start_that_is_not_a_number_is_never_kept():
    assert play(2, 1, 3, lambda start, own: 7.0 if start else float("nan"))[-1][0] == 1


def test_one_start_is_alone():
    assert play(1, 8, 3, lambda start, own: 1.0) == [(0, 0), (0, 1), (0, 2)]


def test_rounds_must_leave_something_of_the_budget():
    StartSettings(4, 8).check(33)
    with pytest.raises(ValueError, match=r"optimiser\.iterations must be more than 32, not 32: 4 starts share it"):
        StartSettings(4, 8).check(32)
    StartSettings(1, 8).check(1)
