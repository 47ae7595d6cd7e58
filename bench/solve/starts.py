"""Several starts within one budget of iterations: successive halving keeps the better ones, the last gets the rest."""

from dataclasses import dataclass, field
from math import inf, isnan

import torch
from torch import Tensor

from renderers.checks import check_at_least

KEPT = 4  # one start of four is kept after each round (successive halving, Jamieson and Talwalkar 2016)
LAST = 3  # a start is scored by its mean loss over the last 3 iterations of a round: views change between them


@dataclass(frozen=True)
class StartSettings:
    """The number of starts, and the iterations of each of them in each round."""

    count: int
    trial: int

    def __post_init__(self) -> None:
        check_at_least("task.starts", self.count, 1, "1 is a single start; conf/method has rows with more")
        check_at_least("task.trial", self.trial, 1, "8 separate good starts from bad ones")

    @property
    def rounds(self) -> list[int]:
        """The number of starts in each round; empty for a single start."""
        counts = [self.count]
        while counts[-1] > 1:
            counts.append(-(-counts[-1] // KEPT))
        return counts[:-1]

    @property
    def trials(self) -> int:
        """The iterations of all rounds together."""
        return self.trial * sum(self.rounds)

    def iterations_of_last(self, iterations: int) -> int:
        """The iterations that the last start gets, of a budget."""
        return iterations - self.trials + self.trial * len(self.rounds)

    def check(self, iterations: int) -> None:
        """Raises ValueError where the rounds would use up the budget."""
        if self.trials >= iterations:
            raise ValueError(
                f"task.optimiser.iterations must be more than {self.trials}, not {iterations}: {self.count} starts "
                f"share it, with task.trial={self.trial} for each in rounds of {', '.join(map(str, self.rounds))}"
            )


@dataclass
class Starts:
    """Assigns iterations to starts, and keeps those with the least losses; the truth is not used."""

    settings: StartSettings
    losses: list[dict[int, Tensor]] = field(init=False)  # by start and step
    alive: list[int] = field(init=False)  # the kept ones, the best first after a round
    begun: int = 0  # first iteration of this round
    done: int = 0  # steps of each kept start before this round

    def __post_init__(self) -> None:
        self.losses = [{} for _ in range(self.settings.count)]
        self.alive = list(range(self.settings.count))

    def turn(self, iteration: int) -> tuple[int, int]:
        """The start that an iteration belongs to, and the start's step, counted from 0."""
        left = iteration - self.begun
        return self.alive[left % len(self.alive)], self.done + left // len(self.alive)

    def note(self, start: int, step: int, loss: Tensor) -> None:
        """Notes the loss of a start's step; the last one of a round ends it."""
        self.losses[start][step] = loss.detach()
        end = self.done + self.settings.trial
        if len(self.alive) > 1 and all(end - 1 in self.losses[other] for other in self.alive):
            self.begun, self.done = self.begun + len(self.alive) * self.settings.trial, end
            self.alive = sorted(self.alive, key=self._end)[: -(-len(self.alive) // KEPT)]

    def best(self) -> int:
        """The last start; before all rounds are over, the best one of the last completed round."""
        return self.alive[0]

    def give_up(self, start: int, step: int) -> bool:
        """Notes that a start cannot continue, so that it is not kept; False where there is no other."""
        if len(self.alive) == 1:
            return False
        self.note(start, step, torch.tensor(inf))
        return True

    def _end(self, start: int) -> float:
        """The mean loss of a start at the end of a round; infinite where it is NaN."""
        last = [self.losses[start][step] for step in range(max(self.done - LAST, 0), self.done)]
        mean = float(torch.stack(last).mean())
        return inf if isnan(mean) else mean
