"""The optimisation loop, timed over the forward and backward passes only, and several starts in one loop.

Several starts share one number of iterations: successive halving keeps the better ones, and the last gets the rest.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import count
from math import cos, inf, isfinite, isnan, pi
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim.adam import adam

from bench.machine.environment import MemoryPeak, Stopwatch
from bench.records.record import MIN_BUDGET_ITERATIONS, TOO_EXPENSIVE, RunStatus
from renderers.checks import check_at_least, check_choice, check_positive
from renderers.field import Counts
from renderers.hits import Hits, collect_hits, missing_distance_message
from renderers.schedule import Iteration, schedule_position

DIVERGENCE_FACTOR = 100.0  # times the first loss, or `least_reference` if larger: a loss above it has diverged
HALVING_FACTOR = 4  # one start of four is kept after each round (successive halving, Jamieson and Talwalkar 2016)
SCORED_STEPS = 3  # the score of a start is its mean loss over the last steps of a round, since each sees other views
ITERATIONS, BUDGET, HELD_OUT = "iterations", "budget", "held_out"  # what ends a loop
HELD_OUT_INTERVAL = 5  # iterations between two measurements of the loss of held-out pixels
HELD_OUT_PATIENCE, HELD_OUT_GAIN = 2, 0.02
FINAL_ITERATIONS = 10
BLOCKS = (1, 2, 4, 8)  # pixels per side of a block of which an iteration has one ray
SCHEDULES = ("constant", "cosine", "ramped", "steps")
RATE_DROP_FRACTIONS = (0.6, 0.8)  # the rate of "steps" falls to a fifth there (DVR: 750 and 1,000 epochs)
WARMUP_FRACTION = 0.1  # the rate of "ramped" rises over this fraction of the iterations


class CannotContinue(Exception):
    """An optimisation cannot continue, although the program has no error; the message gives the reason."""


@dataclass(frozen=True)
class OptimiserSettings:
    """Adam, until a number of iterations or a budget is spent.

    Args:
        iterations: number of steps.
        learning_rate: of Adam, at the start.
        schedule: "constant"; "cosine": the rate falls to zero along half a cosine; "ramped": a cosine that rises from
            zero over the first tenth, for a start that is almost correct; "steps": falls to a fifth twice.
        budget: largest cost, see `renderers.field.Counts.cost`; the step that reaches it is the last.
        ends: "iterations", the number of steps, with the budget as a limit; "budget": whatever the number of steps, and
            schedules over `iterations` follow the spent fraction of the budget; "held_out": when the loss of held-out
            pixels stops falling, see `_Patience`, after `iterations` at most; schedules then end early.
        start_noise: standard deviation of normal noise in all initial parameters, for the run-to-run spread.
        afforded_iterations: the number for which `with_affordable_rays` chooses the rays of an iteration.
    """

    iterations: int
    learning_rate: float
    schedule: str
    budget: float | None = None
    ends: str = ITERATIONS
    start_noise: float = 0.0
    afforded_iterations: int = 40

    def __post_init__(self) -> None:
        check_at_least("task.optimiser.iterations", self.iterations, 1, "DIST uses 100")
        check_positive("task.optimiser.learning_rate", self.learning_rate, "0.01 to 0.1 suit")
        check_choice("task.optimiser.schedule", self.schedule, SCHEDULES)
        if self.budget is not None:
            check_positive("task.optimiser.budget", self.budget, "the suite has 2.5e5 to 1e7, null is none")
        check_choice("task.optimiser.ends", self.ends, (ITERATIONS, BUDGET, HELD_OUT))
        check_at_least("task.optimiser.start_noise", self.start_noise, 0, "1e-6 shows the run-to-run spread")
        check_at_least("task.optimiser.afforded_iterations", self.afforded_iterations, 1, "the suite has 40")
        if self.ends == HELD_OUT and self.schedule != "constant":
            raise ValueError(
                "effort=needed (ends=held_out) is only for task=completion with task.optimiser.schedule=constant: "
                "set effort=full"
            )
        if self.ends == BUDGET and self.budget is None:
            raise ValueError("task.optimiser.ends=budget needs task.optimiser.budget=COST, such as 4e6")

    def at(self, index: int, cost: float) -> int:
        """The index, with the position in schedules that follows from the cost spent before it."""
        if self.ends != BUDGET or self.budget is None:
            return index
        return Iteration(index, min(int(self.iterations * cost / self.budget), self.iterations - 1))

    def rate(self, iteration: int) -> float:
        """The learning rate of an iteration, counted from 0."""
        iteration = schedule_position(iteration)
        elapsed = iteration / self.iterations
        if self.schedule in ("constant", "steps"):
            drops = sum(elapsed >= fraction for fraction in RATE_DROP_FRACTIONS) if self.schedule == "steps" else 0
            return self.learning_rate / 5**drops
        warmup = min((iteration + 1) / (WARMUP_FRACTION * self.iterations), 1.0) if self.schedule == "ramped" else 1.0
        return self.learning_rate * 0.5 * (1 + cos(pi * elapsed)) * warmup


@runtime_checkable
class Optimisable(Protocol):
    """Parameters and their loss, which the optimisation loop minimises. `counts` counts all its field evaluations.

    A problem with several starts has an attribute `starts`, see `Starts`, and its `loss` has a second argument, the
    start; the iteration is then the start's.
    """

    parameters: list[Tensor]
    counts: Counts

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The loss of an iteration, counted from 0, under "total", and its weighted terms."""
        ...


@dataclass
class _Patience:
    """Ends a loop by the losses of held-out pixels, which it measures every `HELD_OUT_INTERVAL` iterations.

    When they stop falling, the problem compares more pixels; after the smallest blocks, all pixels of the image for the
    last `FINAL_ITERATIONS`.
    """

    problem: Any  # with `held_out_loss`, whose cost is counted, and `draw`, a `PixelDraw`
    end: int  # the number of iterations
    losses: list[float] = field(default_factory=list)  # since the last refinement

    def is_over(self, index: int) -> bool:
        left = self.end - 1 - index
        draw = self.problem.draw
        if left == FINAL_ITERATIONS or (left > FINAL_ITERATIONS and self._is_still(index) and not draw.refine()):
            draw.release()
            self.end = index + 1 + FINAL_ITERATIONS
        return index + 1 >= self.end

    def _is_still(self, index: int) -> bool:
        if (index + 1) % HELD_OUT_INTERVAL:
            return False
        self.losses.append(self.problem.held_out_loss())
        before, latest = self.losses[:-HELD_OUT_PATIENCE], self.losses[-HELD_OUT_PATIENCE:]
        is_still = bool(before) and not min(latest) < (1 - HELD_OUT_GAIN) * min(before)  # also if it is 0 or NaN
        self.losses = latest[-1:] if is_still else self.losses
        return is_still


def with_affordable_rays(task: Any, make_problem: Callable[[Any], Any]) -> Any:
    """Makes the problem of a task with settings `optimiser` and `pixel_block`, the pixels per side of a block.

    If `pixel_block` is 0, it becomes the smallest of `BLOCKS` with which the budget pays for `afforded_iterations`,
    else the largest. One uncounted iteration measures the cost, with the initial parameters and the final values of
    schedules.
    """
    if task.pixel_block:
        return make_problem(task)
    without_held_out = replace(task.optimiser, ends=ITERATIONS)  # else the first blocks would be larger than the last
    for block in BLOCKS:
        sampled = replace(task, pixel_block=block)
        problem = make_problem(replace(sampled, optimiser=without_held_out))
        with suppress(CannotContinue):  # the loop reports it
            problem.loss(Iteration(0, task.optimiser.iterations - 1))["total"].backward()
        if task.optimiser.afforded_iterations * problem.counts.cost <= (task.optimiser.budget or inf):
            break
    return make_problem(sampled)  # a new one, whose counts are 0


@dataclass
class History:
    """The curve and the costs of an optimisation."""

    status: RunStatus = RunStatus.OK
    reason: str = ""
    curve: list[dict[str, Any]] = field(default_factory=list)
    first_loss: float = inf  # the first finite loss of the start of the curve's last line
    seconds: dict[str, float] = field(default_factory=lambda: {"warmup": 0.0, "forward": 0.0, "backward": 0.0})
    counts: Counts = field(default_factory=Counts)
    peak_memory_bytes: int | None = None
    objectives: list[float] = field(default_factory=list)  # before and after, if the problem has an objective
    notes: list[str] | None = None  # on hits of the warm-up that lie off the surface; None does not check them


def optimise(
    problem: Optimisable,
    settings: OptimiserSettings,
    device: torch.device,
    *,
    history: History,
    on_step: Callable[[dict[str, Any]], None],
    least_reference: float = 0.0,
) -> None:
    """Runs Adam on the problem's parameters.

    A run fails if its budget ends it within `MIN_BUDGET_ITERATIONS`, or if as many iterations spend nothing. The first
    loss is a warm-up. A start skips a step if its loss is NaN or its gradient not finite; others go on.
    If one start remains, its failure ends the loop, and so does a loss far above its first one.

    Args:
        problem: returns the loss; its parameters are changed in place.
        device: synchronised when the clock is read.
        history: an empty one, filled during the loop, so that it is complete if the loop is stopped.
        on_step: receives each line of the curve and may extend it. Its time and memory are not counted.
        least_reference: lower bound of the first loss in the divergence test, for starts that are almost correct.

    Raises:
        BrokenContract: the history has notes, and the distance of a hit of the warm-up is not finite or is negative.
    """
    _add_noise(problem.parameters, settings.start_noise)
    optimiser, own_starts = _Adam(problem.parameters), getattr(problem, "starts", None)
    starts, patience = own_starts or Starts(StartSettings(1, 1)), _Patience(problem, settings.iterations)
    loss_of = problem.loss if own_starts else lambda step, start: problem.loss(step)
    stopwatch = Stopwatch(device)
    start, step = starts.assignment(0)
    _warm_up(lambda: loss_of(step, start)["total"], history)
    history.seconds["warmup"] = stopwatch.seconds()
    before = replace(problem.counts)
    memory = MemoryPeak(device)
    for index in count() if settings.ends == BUDGET else range(settings.iterations):
        optimiser.forget_gradients()
        start, step = starts.assignment(index)
        iteration = settings.at(step, history.counts.cost)
        with collect_hits() as all_hits:
            stopwatch = Stopwatch(device)
            terms = loss_of(iteration, start)
            history.seconds["forward"] += stopwatch.seconds()
        numbers = dict(zip(terms, _to_floats([*terms.values()]), strict=True))
        failure = _not_a_number(numbers, index, all_hits) if isnan(numbers["total"]) else ""
        if not failure:
            stopwatch = Stopwatch(device)
            terms["total"].backward()
            if optimiser.gradients_are_finite():
                optimiser.step(settings.rate(settings.at(index, history.counts.cost)))
            else:
                failure = f"the gradient is not finite at iteration {index}"
            history.seconds["backward"] += stopwatch.seconds()
        is_over = False
        if settings.ends == HELD_OUT:  # else a GPU would be synchronised for nothing
            stopwatch = Stopwatch(device)
            is_over = patience.is_over(index)
            history.seconds["forward"] += stopwatch.seconds()
        first_loss = starts.first_loss(start)
        if starts.is_alone and failure:
            history.status, history.reason = RunStatus.NAN, failure
        elif starts.is_alone and numbers["total"] > DIVERGENCE_FACTOR * max(first_loss, least_reference):
            history.status = RunStatus.DIVERGED
            history.reason = f"the loss rose from {first_loss:.3g} to {numbers['total']:.3g} by iteration {index}"
        starts.note(inf if failure else numbers["total"])
        history.first_loss = starts.first_loss(start)
        history.counts = problem.counts - before
        line = {
            "iteration": index,
            "seconds": history.seconds["forward"] + history.seconds["backward"],
            "value_evaluations": history.counts.value + history.counts.coarse,
            "gradient_evaluations": history.counts.gradient,
            "cost": history.counts.cost,
            **numbers,
        }
        history.curve.append(line)
        history.peak_memory_bytes = memory.repeatable()
        with memory.pause():
            on_step(line)
        is_spent = line["cost"] >= (settings.budget or inf)
        if history.status is RunStatus.OK and settings.ends == BUDGET:
            history.reason = _budget_problem(history.curve, is_spent)
            history.status = RunStatus.NOT_REACHED if history.reason else RunStatus.OK
        if is_over or is_spent or history.status is not RunStatus.OK:
            break


def _warm_up(loss_of_first: Callable[[], Tensor], history: History) -> None:
    """Computes the first loss and its gradient, and checks the hits of its renderings if the history has notes."""
    with collect_hits() as all_hits:
        loss = loss_of_first()
    if history.notes is not None and not bool(loss.isnan()):  # a NaN is reported by the first iteration
        for hits in all_hits:
            hits.check()
        notes = [f"at the first iteration, {note}" for hits in all_hits if (note := hits.off_surface())]
        history.notes.extend(notes[:1])
    loss.backward()


def _budget_problem(curve: list[dict[str, Any]], is_spent: bool) -> str:
    """Why a budget cannot end a loop: it pays for too few iterations, or nothing is spent any more. Empty if it can."""
    iterations, cost = len(curve), curve[-1]["cost"]
    if iterations > MIN_BUDGET_ITERATIONS and cost == curve[-1 - MIN_BUDGET_ITERATIONS]["cost"]:
        return f"{MIN_BUDGET_ITERATIONS} iterations have evaluated no field, so that the budget is never spent"
    if not is_spent or iterations >= MIN_BUDGET_ITERATIONS:
        return ""
    few = f"{TOO_EXPENSIVE} {iterations} iterations, fewer than {MIN_BUDGET_ITERATIONS}"
    return f"{few}: these need {MIN_BUDGET_ITERATIONS * cost / iterations:.2g} field evaluations"


@torch.no_grad()
def _add_noise(parameters: list[Tensor], deviation: float) -> None:
    draw = torch.Generator().manual_seed(0)
    for parameter in parameters if deviation else ():
        parameter += deviation * torch.randn(parameter.shape, generator=draw, device="cpu").to(parameter)


class _Adam:
    """Adam by torch's function: the class `torch.optim.Adam` imports torch's compiler, which takes a second."""

    def __init__(self, parameters: list[Tensor]) -> None:
        self.parameters = parameters
        self.averages, self.squares = ([torch.zeros_like(parameter) for parameter in parameters] for _ in range(2))
        self.steps = [torch.tensor(0.0, device="cpu") for _ in parameters]

    def forget_gradients(self) -> None:
        for parameter in self.parameters:
            parameter.grad = None

    def gradients_are_finite(self) -> bool:
        gradients = [value.grad for value in self.parameters if value.grad is not None]
        return isfinite(*_to_floats([get_total_norm(gradients, norm_type=inf)]))

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Updates the parameters that have a gradient."""
        states = zip(self.parameters, self.averages, self.squares, self.steps, strict=True)
        updates = [(value, gradient, *state) for value, *state in states if (gradient := value.grad) is not None]
        if updates:
            values, gradients, averages, squares, steps = map(list, zip(*updates, strict=True))
            settings = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-8, "weight_decay": 0.0}
            adam(values, gradients, averages, squares, [], steps, lr=rate, **settings, amsgrad=False, maximize=False)


def _to_floats(numbers: list[Tensor]) -> list[float]:
    """Copies numbers from a device, waiting for it only once."""
    return torch.stack([number.detach().double() for number in numbers]).tolist()


def _not_a_number(numbers: dict[str, float], iteration: int, all_hits: Sequence[Hits]) -> str:
    """The reason for a loss that is not a number: its terms that are not, and hits without a distance."""
    terms = [name for name, number in numbers.items() if isnan(number) and name != "total"]
    subject = f"the {' and the '.join(terms)} term{'s are' if len(terms) > 1 else ' is'}" if terms else "the loss is"
    misses = missing_distance_message(all_hits)
    return f"{subject} not a number at iteration {iteration}{f': {misses}' if misses else ''}"


@dataclass(frozen=True)
class StartSettings:
    """The number of starts, and the iterations of each of them in each round."""

    count: int
    trial: int

    def __post_init__(self) -> None:
        check_at_least("task.starts", self.count, 1, "1 is a single start; conf/methods.yaml has rows with more")
        check_at_least("task.trial", self.trial, 1, "8 separate good starts from bad ones")

    @property
    def rounds(self) -> list[int]:
        """The number of starts in each round; empty for a single start."""
        counts = [self.count]
        while counts[-1] > 1:
            counts.append(-(-counts[-1] // HALVING_FACTOR))
        return counts[:-1]

    @property
    def trials(self) -> int:
        """The iterations of all rounds together."""
        return self.trial * sum(self.rounds)

    def iterations_of_last(self, iterations: int) -> int:
        """The iterations of the last start, out of all iterations."""
        return iterations - self.trials + self.trial * len(self.rounds)

    def check(self, settings: OptimiserSettings) -> None:
        """Raises ValueError if the rounds would use up the iterations, or if their number is not known."""
        if self.count > 1 and settings.ends != ITERATIONS:
            raise ValueError(f"{self.count} starts share a number of iterations: set task.optimiser.ends=iterations")
        if self.trials >= settings.iterations:
            raise ValueError(
                f"task.optimiser.iterations must be more than {self.trials}, not {settings.iterations}: {self.count} "
                f"starts share it, with task.trial={self.trial} for each in rounds of "
                f"{', '.join(map(str, self.rounds))}"
            )


@dataclass
class Starts:
    """Assigns iterations to starts, and keeps the starts with the smallest losses; ground truth is not used."""

    settings: StartSettings
    losses: list[dict[int, float]] = field(init=False)  # by start and step
    remaining: list[int] = field(init=False)  # the best first after a round
    round_start: int = 0  # first iteration of this round
    steps_before: int = 0  # steps of each remaining start before this round
    latest: tuple[int, int] = 0, 0  # the start and the step of the latest assignment
    is_alone: bool = True  # whether the latest assignment had no other start

    def __post_init__(self) -> None:
        self.losses = [{} for _ in range(self.settings.count)]
        self.remaining = list(range(self.settings.count))

    def assignment(self, iteration: int) -> tuple[int, int]:
        """The start of an iteration, and the index of the start's step, from 0."""
        offset = iteration - self.round_start
        self.latest = self.remaining[offset % len(self.remaining)], self.steps_before + offset // len(self.remaining)
        self.is_alone = len(self.remaining) == 1
        return self.latest

    def first_loss(self, start: int) -> float:
        """The first finite loss of a start; infinite before."""
        return next((loss for loss in self.losses[start].values() if isfinite(loss)), inf)

    def note(self, loss: float) -> None:
        """Records the loss of the latest assignment, infinite if it failed; the last loss of a round ends the round."""
        start, step = self.latest
        self.losses[start][step] = loss
        end = self.steps_before + self.settings.trial
        if len(self.remaining) > 1 and all(end - 1 in self.losses[index] for index in self.remaining):
            self.round_start, self.steps_before = self.round_start + len(self.remaining) * self.settings.trial, end
            self.remaining = sorted(self.remaining, key=self._score)[: -(-len(self.remaining) // HALVING_FACTOR)]

    def best(self) -> int:
        """The last start; during the rounds, the best start of the last completed round."""
        return self.remaining[0]

    def _score(self, start: int) -> float:
        """The mean loss of a start at the end of a round; infinite if one failed."""
        last = [self.losses[start][step] for step in range(max(self.steps_before - SCORED_STEPS, 0), self.steps_before)]
        return sum(last) / len(last)
