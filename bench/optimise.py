"""The one optimisation loop. The clock runs around a step's forward and backward pass, and nothing else."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch

from bench.environment import MemoryPeak, synchronise
from bench.records import RunStatus
from bench.tasks.problem import Descent, OptimiserSettings
from renderers.field import Counts

DIVERGED = 100.0  # times its first value, or what stands for it: a loss above that has diverged


@dataclass
class Course:
    """How an optimisation went."""

    status: RunStatus = RunStatus.OK
    reason: str = ""
    curve: list[dict[str, Any]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: {"warmup": 0.0, "forward": 0.0, "backward": 0.0})
    counts: Counts = field(default_factory=Counts)
    peak_memory_bytes: int | None = None
    objectives: list[float] = field(default_factory=list)  # the problem's own, before and after, where it has one


def optimise(
    problem: Descent,
    settings: OptimiserSettings,
    device: torch.device,
    *,
    course: Course,
    on_step: Callable[[dict[str, Any]], None],
    least_reference: float = 0.0,
) -> None:
    """Runs Adam on the problem's free parameters.

    Args:
        problem: gives the loss; its free parameters are changed in place.
        settings: how long and how fast.
        device: what to wait for when the clock is read.
        course: an empty one, filled as the loop goes, so that it is there for a loop that is cut short. A loss that
            becomes NaN or diverges ends the loop, and stands there as its status.
        least_reference: a first loss below that, of a start that is nearly right, counts as that for divergence.
        on_step: called with each line of the curve, to which it may add; off the clock, and its memory is not counted.
    """
    optimiser = torch.optim.Adam(problem.parameters, lr=settings.learning_rate)
    course.seconds["warmup"] = _timed(device, lambda: problem.loss(0)["total"].backward())
    before = Counts(problem.counts.value, problem.counts.gradient)
    memory = MemoryPeak(device)
    for iteration in range(settings.iterations):
        optimiser.param_groups[0]["lr"] = settings.rate(iteration)
        optimiser.zero_grad(set_to_none=True)
        terms: dict[str, torch.Tensor] = {}
        forward = _timed(device, lambda i=iteration, terms=terms: terms.update(problem.loss(i)))
        backward = _timed(device, lambda terms=terms: (terms["total"].backward(), optimiser.step()))
        course.seconds["forward"] += forward
        course.seconds["backward"] += backward
        course.counts = problem.counts - before
        line = {
            "iteration": iteration,
            "seconds": course.seconds["forward"] + course.seconds["backward"],
            "value_evaluations": course.counts.value,
            "gradient_evaluations": course.counts.gradient,
            **{name: term.item() for name, term in terms.items()},
        }
        course.curve.append(line)
        course.peak_memory_bytes = memory.growth()
        over = _failed(course, problem, least_reference)
        with memory.pause():
            on_step(line)
        if over:
            break


def _failed(course: Course, problem: Descent, least_reference: float) -> bool:
    """Notes in the course why it cannot go on, if so."""
    loss, first = course.curve[-1]["total"], max(course.curve[0]["total"], least_reference)
    iteration = course.curve[-1]["iteration"]
    finite = all(bool(parameter.isfinite().all()) for parameter in problem.parameters)
    if loss != loss or not finite:
        what = "the loss" if loss != loss else "a free parameter"
        course.status, course.reason = RunStatus.NAN, f"{what} is not a number at iteration {iteration}"
    elif loss > DIVERGED * first:
        course.status = RunStatus.DIVERGED
        begun = course.curve[0]["total"]
        course.reason = f"the loss rose from {begun:.3g} to {loss:.3g} by iteration {iteration}"
    return course.status is not RunStatus.OK


def _timed(device: torch.device, work: Callable[[], Any]) -> float:
    synchronise(device)
    start = time.perf_counter()
    work()
    synchronise(device)
    return time.perf_counter() - start
