"""The optimisation loop, whose clock runs around a step's forward and backward pass only; several starts within it.

Several starts share one budget of iterations: successive halving keeps the better ones, and the last gets the rest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import cos, inf, isfinite, isnan, pi
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim.adam import adam

from bench.machine.environment import MemoryPeak, Stopwatch
from bench.records.record import RunStatus
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Counts
from renderers.hits import Hits, collect_hits, missing_distance_message

DIVERGED = 100.0  # a loss above this many times its first value, or `least_reference`, has diverged
KEPT = 4  # one start of four is kept after each round (successive halving, Jamieson and Talwalkar 2016)
LAST = 3  # a start is scored by its mean loss over the last 3 iterations of a round: views change between them
SCHEDULES = ("constant", "cosine", "ramped", "steps")
MARKS = (0.6, 0.8)  # shares of the iterations after which the rate of "steps" is a fifth (DVR: 750 and 1,000 epochs)
RAMP = 0.1  # share of the iterations over which the rate of "ramped" rises


class NotReached(Exception):
    """An optimisation cannot continue, without an error of the program; the message says why."""


@dataclass(frozen=True)
class OptimiserSettings:
    """Adam, for a fixed number of iterations.

    Args:
        iterations: their number.
        learning_rate: of Adam, at the start.
        schedule: "constant", or "cosine": the rate falls to zero along half a cosine; "ramped": a cosine that rises
            from zero over the first tenth, for a start that is nearly right; "steps": a fifth after each of two marks.
        budget: of the field, see `renderers.field.Counts.cost`; the step that reaches it is the last.
    """

    iterations: int
    learning_rate: float
    schedule: str
    budget: float | None = None

    def __post_init__(self) -> None:
        check_at_least("task.optimiser.iterations", self.iterations, 1, "the paper uses 100")
        check_positive("task.optimiser.learning_rate", self.learning_rate, "0.01 to 0.1 suit")
        check_choice("task.optimiser.schedule", self.schedule, SCHEDULES)
        if self.budget is not None:
            check_positive("task.optimiser.budget", self.budget, "the suite has 6e6 to 2e7, null is none")

    def rate(self, iteration: int) -> float:
        """The learning rate of an iteration, counted from 0."""
        done = iteration / self.iterations
        if self.schedule in ("constant", "steps"):
            passed = sum(done >= mark for mark in MARKS) if self.schedule == "steps" else 0
            return self.learning_rate / 5**passed
        rise = min((iteration + 1) / (RAMP * self.iterations), 1.0) if self.schedule == "ramped" else 1.0
        return self.learning_rate * 0.5 * (1 + cos(pi * done)) * rise


@runtime_checkable
class Objective(Protocol):
    """What the optimisation loop minimises. Every evaluation that `loss` makes is counted in `counts`."""

    parameters: list[Tensor]
    counts: Counts

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The loss of an iteration, counted from 0, as "total", and its weighted terms."""
        ...


@dataclass
class FirstChecked:
    """An objective whose first loss, the warm-up of `optimise`, checks the hits of its renderings.

    The check evaluates the field once, which is neither counted nor on the clock.

    Args:
        problem: the objective.
        notes: gets a note where hits lie off the surface; a run goes on with them.
    """

    problem: Objective
    notes: list[str]
    checked: bool = False

    @property
    def parameters(self) -> list[Tensor]:
        """The objective's parameters."""
        return self.problem.parameters

    @property
    def counts(self) -> Counts:
        """The objective's counts."""
        return self.problem.counts

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The objective's loss.

        Raises:
            BrokenContract: where the first loss is a number, but some hit has no finite distance or a negative one.
        """
        if self.checked:
            return self.problem.loss(iteration)
        self.checked = True
        with collect_hits() as kept:
            terms = self.problem.loss(iteration)
        if not bool(terms["total"].isnan()):  # else `optimise` ends before the step, and says why
            for hits in kept:
                hits.check()
            self.notes += [f"at the first iteration, {note}" for hits in kept if (note := hits.off_surface())][:1]
        return terms


@dataclass
class History:
    """The course and the costs of an optimisation."""

    status: RunStatus = RunStatus.OK
    reason: str = ""
    curve: list[dict[str, Any]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: {"warmup": 0.0, "forward": 0.0, "backward": 0.0})
    counts: Counts = field(default_factory=Counts)
    peak_memory_bytes: int | None = None
    objectives: list[float] = field(default_factory=list)  # the problem's objective before and after, where it has one


def optimise(
    problem: Objective,
    settings: OptimiserSettings,
    device: torch.device,
    *,
    history: History,
    on_step: Callable[[dict[str, Any]], None],
    least_reference: float = 0.0,
) -> None:
    """Runs Adam on the problem's parameters.

    Args:
        problem: gives the loss; its parameters are changed in place.
        device: that is synchronised when the clock is read.
        history: an empty one, filled during the loop, so that it is complete if the loop is stopped. A loss that
            becomes NaN or diverges ends the loop and sets its status. A step is not taken where the loss is NaN.
        least_reference: for divergence, a smaller first loss counts as this; for starts that are nearly right.
        on_step: called with each line of the curve, to which it may add; off the clock, and its memory is not counted.
    """
    optimiser = _Adam(problem.parameters)
    history.seconds["warmup"] = _timed(device, lambda: problem.loss(0)["total"].backward())
    before = replace(problem.counts)
    memory = MemoryPeak(device)
    for iteration in range(settings.iterations):
        optimiser.forget_gradients()
        rate, terms = settings.rate(iteration), dict[str, Tensor]()
        with collect_hits() as kept:
            history.seconds["forward"] += _timed(device, lambda i=iteration, t=terms: t.update(problem.loss(i)))
        numbers = dict(zip(terms, _read([*terms.values()]), strict=True))
        if isnan(numbers["total"]):
            history.status, history.reason = RunStatus.NAN, _not_a_number(numbers, iteration, kept)
        else:
            history.seconds["backward"] += _timed(
                device, lambda rate=rate, loss=terms["total"]: (loss.backward(), optimiser.step(rate))
            )
        history.counts = problem.counts - before
        line = {
            "iteration": iteration,
            "seconds": history.seconds["forward"] + history.seconds["backward"],
            "value_evaluations": history.counts.value + history.counts.coarse,
            "gradient_evaluations": history.counts.gradient,
            "cost": history.counts.cost,
            **numbers,
        }
        history.curve.append(line)
        history.peak_memory_bytes = memory.repeatable()
        over = _failed(history, problem.parameters, least_reference) or line["cost"] >= (settings.budget or inf)
        with memory.pause():
            on_step(line)
        if over:
            break


class _Adam:
    """`torch.optim.Adam` by its function alone: the class imports torch's compiler, for a second of every process."""

    def __init__(self, parameters: list[Tensor]) -> None:
        self.parameters = parameters
        self.averages, self.squares = ([torch.zeros_like(one) for one in parameters] for _ in range(2))
        self.steps = [torch.tensor(0.0, device="cpu") for _ in parameters]

    def forget_gradients(self) -> None:
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Moves the parameters that have a gradient, at a learning rate."""
        states = zip(self.parameters, self.averages, self.squares, self.steps, strict=True)
        moved = [(one, gradient, *state) for one, *state in states if (gradient := one.grad) is not None]
        if moved:
            ones, gradients, averages, squares, steps = map(list, zip(*moved, strict=True))
            settings = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "weight_decay": 0.0}
            adam(ones, gradients, averages, squares, [], steps, lr=rate, **settings, amsgrad=False, maximize=False)


def _largest(parameters: list[Tensor]) -> Tensor:
    """The largest magnitude of any parameter: not finite where one is not."""
    return get_total_norm([one.detach() for one in parameters], norm_type=inf)


def _read(numbers: list[Tensor]) -> list[float]:
    """Numbers of a device, in one wait for it."""
    return torch.stack([number.detach().double() for number in numbers]).tolist()


def _not_a_number(numbers: dict[str, float], iteration: int, kept: Sequence[Hits]) -> str:
    """Why the loss of an iteration is not a number: its terms that are not, and the hits without a distance."""
    wrong = [name for name, number in numbers.items() if isnan(number) and name != "total"]
    what = f"the {' and the '.join(wrong)} term{'s are' if len(wrong) > 1 else ' is'}" if wrong else "the loss is"
    endless = missing_distance_message(kept)
    return f"{what} not a number at iteration {iteration}{f': {endless}' if endless else ''}"


def _failed(history: History, parameters: list[Tensor], least_reference: float) -> bool:
    """Whether the loop must end; notes the reason in the history."""
    loss, first = history.curve[-1]["total"], max(history.curve[0]["total"], least_reference)
    iteration = history.curve[-1]["iteration"]
    (largest,) = _read([_largest(parameters)])
    if history.status is RunStatus.OK and not isfinite(largest):
        history.status, history.reason = RunStatus.NAN, f"a parameter is not a number at iteration {iteration}"
    elif loss > DIVERGED * first:
        history.status = RunStatus.DIVERGED
        begun = history.curve[0]["total"]
        history.reason = f"the loss rose from {begun:.3g} to {loss:.3g} by iteration {iteration}"
    return history.status is not RunStatus.OK


def _timed(device: torch.device, work: Callable[[], Any]) -> float:
    stopwatch = Stopwatch(device)
    work()
    return stopwatch.seconds()


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
