"""The optimisation loop. The clock runs around a step's forward and backward pass only."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from bench.machine.environment import MemoryPeak, synchronise
from bench.records.record import RunStatus
from bench.solve.problem import Objective, OptimiserSettings
from renderers.field import Counts

DIVERGED = 100.0  # a loss above this many times its first value, or `least_reference`, has diverged


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
        settings: iterations and learning rate.
        device: that is synchronised when the clock is read.
        history: an empty one, filled during the loop, so that it is complete if the loop is stopped. A loss that
            becomes NaN or diverges ends the loop and sets its status.
        least_reference: for divergence, a smaller first loss counts as this; for starts that are nearly right.
        on_step: called with each line of the curve, to which it may add; off the clock, and its memory is not counted.
    """
    optimiser = torch.optim.Adam(problem.parameters, lr=settings.learning_rate)
    history.seconds["warmup"] = _timed(device, lambda: problem.loss(0)["total"].backward())
    before = Counts(problem.counts.value, problem.counts.gradient)
    memory = MemoryPeak(device)
    for iteration in range(settings.iterations):
        optimiser.param_groups[0]["lr"] = settings.rate(iteration)
        optimiser.zero_grad(set_to_none=True)
        terms: dict[str, torch.Tensor] = {}
        forward = _timed(device, lambda i=iteration, terms=terms: terms.update(problem.loss(i)))
        backward = _timed(device, lambda terms=terms: (terms["total"].backward(), optimiser.step()))
        history.seconds["forward"] += forward
        history.seconds["backward"] += backward
        history.counts = problem.counts - before
        line = {
            "iteration": iteration,
            "seconds": history.seconds["forward"] + history.seconds["backward"],
            "value_evaluations": history.counts.value,
            "gradient_evaluations": history.counts.gradient,
            **{name: term.item() for name, term in terms.items()},
        }
        history.curve.append(line)
        history.peak_memory_bytes = memory.growth()
        over = _failed(history, problem, least_reference)
        with memory.pause():
            on_step(line)
        if over:
            break


def _failed(history: History, problem: Objective, least_reference: float) -> bool:
    """Whether the loop must end; notes the reason in the history."""
    loss, first = history.curve[-1]["total"], max(history.curve[0]["total"], least_reference)
    iteration = history.curve[-1]["iteration"]
    finite = all(bool(parameter.isfinite().all()) for parameter in problem.parameters)
    if loss != loss or not finite:
        what = "the loss" if loss != loss else "a parameter"
        history.status, history.reason = RunStatus.NAN, f"{what} is not a number at iteration {iteration}"
    elif loss > DIVERGED * first:
        history.status = RunStatus.DIVERGED
        begun = history.curve[0]["total"]
        history.reason = f"the loss rose from {begun:.3g} to {loss:.3g} by iteration {iteration}"
    return history.status is not RunStatus.OK


def _timed(device: torch.device, work: Callable[[], Any]) -> float:
    synchronise(device)
    start = time.perf_counter()
    work()
    synchronise(device)
    return time.perf_counter() - start
