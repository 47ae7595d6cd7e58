"""Several starts within one budget: they take turns, the better ones stay, and the last one has the rest for itself."""

from dataclasses import dataclass, field
from math import inf, isnan

import torch
from torch import Tensor

from renderers.checks import check_at_least

KEPT = 4  # of so many starts one stays after each round (successive halving, Jamieson and Talwalkar 2016)
LAST = 3  # losses at the end of a round that a start is judged by: views change from one iteration to the next


@dataclass(frozen=True)
class StartSettings:
    """How many starts there are, and how many iterations each of them has in each round."""

    count: int
    trial: int

    def __post_init__(self) -> None:
        check_at_least("task.starts", self.count, 1, "1 is a single start; conf/method has rows with more")
        check_at_least("task.trial", self.trial, 1, "8 tell good starts from bad ones")

    @property
    def rounds(self) -> list[int]:
        """How many starts are in each round; none where there is but one."""
        counts = [self.count]
        while counts[-1] > 1:
            counts.append(-(-counts[-1] // KEPT))
        return counts[:-1]

    @property
    def trials(self) -> int:
        """Iterations of all rounds together."""
        return self.trial * sum(self.rounds)

    def own(self, iterations: int) -> int:
        """How many of so many iterations the start that is left has."""
        return iterations - self.trials + self.trial * len(self.rounds)

    def check(self, iterations: int) -> None:
        """Raises ValueError where the rounds would take the whole budget."""
        if self.trials >= iterations:
            raise ValueError(
                f"task.iterations must be more than {self.trials}, not {iterations}: {self.count} starts share it, "
                f"with task.trial={self.trial} for each in rounds of {', '.join(map(str, self.rounds))}"
            )


@dataclass
class Starts:
    """Whose turn it is, iteration after iteration. The truth picks nothing here: only losses do."""

    settings: StartSettings
    losses: list[dict[int, Tensor]] = field(init=False)  # of each start's own iterations
    alive: list[int] = field(init=False)  # the best first, once a round is over
    begun: int = 0  # the iteration that this round began with
    own: int = 0  # how many of its own iterations each start had before this round

    def __post_init__(self) -> None:
        self.losses = [{} for _ in range(self.settings.count)]
        self.alive = list(range(self.settings.count))

    def turn(self, iteration: int) -> tuple[int, int]:
        """The start whose iteration this is, and which of its own iterations, counted from 0."""
        left = iteration - self.begun
        return self.alive[left % len(self.alive)], self.own + left // len(self.alive)

    def note(self, start: int, own: int, loss: Tensor) -> None:
        """Keeps the loss of one of a start's own iterations, and ends the round with its last one."""
        self.losses[start][own] = loss.detach()
        end = self.own + self.settings.trial
        if len(self.alive) > 1 and all(end - 1 in self.losses[other] for other in self.alive):
            self.begun, self.own = self.begun + len(self.alive) * self.settings.trial, end
            self.alive = sorted(self.alive, key=self._end)[: -(-len(self.alive) // KEPT)]

    def best(self) -> int:
        """The start that is left; until all rounds are over, the best one of the last that is over."""
        return self.alive[0]

    def give_up(self, start: int, own: int) -> bool:
        """Notes that a start cannot go on, so that it is not kept; false where there is no other."""
        if len(self.alive) == 1:
            return False
        self.note(start, own, torch.tensor(inf))
        return True

    def _end(self, start: int) -> float:
        """The mean loss of a start at the end of a round; infinite where it is not a number."""
        last = [self.losses[start][own] for own in range(max(self.own - LAST, 0), self.own)]
        mean = float(torch.stack(last).mean())
        return inf if isnan(mean) else mean
