"""Fits a rung: a warm start without a renderer, then the renderer's loss; every rung with the same rays and budget."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.auto import rays_share
from bench.ladder.analytic import OnePart
from bench.ladder.choice import Evidence
from bench.ladder.held_out import HeldOutError
from bench.ladder.model import Model, Rung, Seen
from bench.ladder.observations import Observations, generator
from bench.ladder.settings import FitSettings
from bench.ladder.warm_start import WarmStart, scattered
from bench.optimise import Course, optimise
from bench.records import RunStatus
from bench.tasks.code import Terms
from bench.tasks.problem import NotReached, OptimiserSettings, Unsupported, check_kind
from bench.thickness import own
from renderers.field import Counts, Field, Meter
from renderers.rendering import Renderer

EIKONAL_POINTS = 512
SPENT = ("seconds", "evaluations", "gradients", "flops")  # of an evidence
NEAR_ENOUGH = 0.1  # loss: a warm start may begin below it, and then that is what divergence is measured from
SCREENING = 8  # of several starts each has one of so many parts of a warm start, then the best a whole one
EIKONAL_SEED = 7  # of the points; those of iterations differ
LOOKS = {4**power for power in range(1, 12)}  # iterations
PARTS_RATE, WHOLE_RATE = 0.03, 5e-3  # learning rates of warm starts: of parts, and of networks and grids


@dataclass(eq=False)
class Fitted:
    """A rung under way.

    Args:
        rung: what it is.
        previous: the model that it began with, if any.
        model: its field, as it stands.
        renderer: through which it is fitted: its own, where that follows the shape.
        evidence: what it has come to.
        begun: its error before it was fitted, where that was looked at.
    """

    rung: Rung
    previous: Model | None
    model: Model
    renderer: Renderer
    evidence: Evidence
    begun: HeldOutError | None = None

    @property
    def failed(self) -> bool:
        """Whether its loss became NaN or diverged, the renderer does not take it, or nothing was seen of it."""
        return self.evidence.status is not RunStatus.OK


@dataclass(frozen=True)
class Fitter:
    """Fits rungs to the same observations.

    Args:
        observations: what is given and what is held out.
        settings: how.
        seed: of what is drawn.
        device: where.
        on_line: is told of each iteration: the rung and a line of the curve.
        part: of the run, that the lines are of.
    """

    observations: Observations
    settings: FitSettings
    seed: int
    device: torch.device
    on_line: Callable[[str, dict[str, Any]], None]
    part: str = "growth"
    spent: dict[str, float] = field(default_factory=dict)  # seconds of all fits, by what they were for

    def begin(self, rung: Rung, previous: Model | None, *, look: bool = True) -> Fitted:
        """A rung's model after its warm start, and judged if it is to be looked at."""
        clock, ball, points = time.perf_counter(), None, self.observations.points
        if previous is None and rung.follows:
            ball = self.begin(OnePart("sphere"), None, look=False)
            previous = ball.model
        started = time.perf_counter()
        seen = Seen(points.cpu(), previous, self.seed, self.device)
        models = rung.starts(seen)
        placing = time.perf_counter() - started
        target = previous.frozen() if rung.follows and previous is not None else None
        free = self.observations.free
        starts = [(self._taken(rung, model, previous), self._start(model, free, target)) for model in models]
        screened = self.settings.warm_iterations // SCREENING if len(starts) > 1 else 0
        for fitted, start in starts:
            self._warm(fitted, start, screened)
        fitted, start = min(starts, key=lambda pair: inf if pair[0].failed else pair[1].error())
        self._warm(fitted, start, self.settings.warm_iterations)
        spent = [other.evidence for other, _ in starts] + ([] if ball is None else [ball.evidence])
        for name in SPENT:
            setattr(fitted.evidence, name, sum(getattr(evidence, name) for evidence in spent))
        fitted.evidence.seconds += placing
        if previous is not None:
            asked = [seen.counts, *(start.asked for _, start in starts)]
            fitted.evidence.evaluations += sum(counts.value for counts in asked)
            fitted.evidence.flops += sum(counts.flops(previous.frozen()) or 0 for counts in asked)
        if look:
            self._judge(fitted)
            fitted.begun = fitted.evidence.error
        fitted.evidence.wall += time.perf_counter() - clock
        return fitted

    def _start(self, model: Model, free: Float[Tensor, "n 3"], target: Field | None) -> WarmStart:
        return WarmStart(model, self.observations.points, free, target, self.settings.warm_points, self.seed)

    def _taken(self, rung: Rung, model: Model, previous: Model | None) -> Fitted:
        """A rung's model; it has failed where the renderer does not take it."""
        evidence = Evidence(rung.name, model.size, model.bytes, rung.flops)
        fitted = Fitted(rung, previous, model, own(self.observations.renderer), evidence)
        try:
            check_kind(self.observations.renderer, model.frozen())
        except Unsupported as error:
            fitted.evidence.status, fitted.evidence.reason = RunStatus.UNSUPPORTED, str(error)
        return fitted

    def _warm(self, fitted: Fitted, start: WarmStart, iterations: int) -> None:
        if iterations and not fitted.failed:
            rate = PARTS_RATE if fitted.model.metric else WHOLE_RATE
            self._run(fitted, start, OptimiserSettings(iterations, rate, "cosine"), looks=False)

    def fit(self, fitted: Fitted, iterations: int, *, looks: bool) -> None:
        """Goes on with a rung for so many iterations, and judges it; with `looks` on the way, too."""
        if fitted.failed or iterations < 1:
            return
        clock = time.perf_counter()
        through = self.observations.through(fitted.renderer)
        problem = RungProblem(fitted.model, through, self.settings, fitted.evidence.iterations)
        settings = OptimiserSettings(iterations, fitted.model.learning_rate, "ramped")
        fitted.evidence.iterations += self._run(fitted, problem, settings, looks=looks)
        self._judge(fitted)
        fitted.evidence.wall += time.perf_counter() - clock

    def _run(
        self, fitted: Fitted, problem: "RungProblem | WarmStart", settings: OptimiserSettings, *, looks: bool
    ) -> int:
        """Runs the one loop, adds what it cost to the evidence, and gives how many iterations it came to."""
        course, evidence = Course(), fitted.evidence
        before, shape = {name: getattr(evidence, name) for name in SPENT}, fitted.model.field()

        def on_step(line: dict[str, Any]) -> None:
            spent = {"evaluations": course.counts.value, "gradients": course.counts.gradient}
            spent |= {"seconds": line["seconds"], "flops": course.counts.flops(shape) or 0}
            for name, amount in spent.items():
                setattr(evidence, name, before[name] + amount)
            step = line["iteration"] + 1
            if looks and course.status is RunStatus.OK and step in LOOKS and step < settings.iterations:
                self._judge(fitted)
            where = {"part": self.part, "phase": problem.phase, "iteration": evidence.iterations + line["iteration"]}
            share = {"rays_share": problem.share} if isinstance(problem, RungProblem) else {}
            self.on_line(evidence.rung, {**line, **where, **share})

        try:
            optimise(problem, settings, self.device, course=course, on_step=on_step, least_reference=NEAR_ENOUGH)
        except NotReached as error:
            course.status, course.reason = RunStatus.NOT_REACHED, str(error)
        for name, seconds in course.seconds.items():
            self.spent[name] = self.spent.get(name, 0.0) + seconds
        evidence.status, evidence.reason = course.status, course.reason
        if fitted.failed:
            evidence.error = None
        return len(course.curve)

    def _judge(self, fitted: Fitted) -> None:
        """Looks at a rung as it stands."""
        evidence = fitted.evidence
        if not fitted.failed:
            evidence.error = self.observations.error(fitted.model.frozen())
            evidence.looks.append({name: getattr(evidence, name) for name in SPENT} | {"error": evidence.mean})


@dataclass
class RungProblem:
    """The free numbers of a rung; see `bench.tasks.problem.Descent`."""

    model: Model
    observations: Observations
    settings: FitSettings
    begun: int  # iterations that were before
    share: float = 0.0  # of the rays, in an iteration
    error: float = inf  # that was left at the one before, in scene units
    counts: Counts = field(default_factory=Counts)
    phase: ClassVar[str] = "fit"

    @property
    def parameters(self) -> list[Tensor]:
        """What is free."""
        return self.model.parameters

    def loss(self, iteration: int) -> Terms:
        """The renderer's terms, that of the gradient's length, and their sum."""
        counted, place, settings = Meter(self.model.field(), self.counts), self.begun + iteration, self.settings
        self.error = self.error if iteration else inf  # the first is run twice: once before the clock
        self.share = rays_share(settings.fewest_rays, self.observations.footprint, self.error)
        terms = self.observations.terms(counted, place, self.share)
        self.error = self.observations.left(terms)
        if not self.model.metric and settings.eikonal_weight:
            points = scattered(self.observations.points, EIKONAL_POINTS, generator(EIKONAL_SEED, place))
            terms["eikonal"] = settings.eikonal_weight * _slope_error(counted, points)
        return {"total": torch.stack(list(terms.values())).sum(), **terms}


def _slope_error(shape: Field, points: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """The mean square of |grad f| - 1 (Gropp et al. 2020)."""
    leaf = points.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(shape(leaf).sum(), leaf, create_graph=True)
    return (torch.linalg.vector_norm(gradient, dim=-1) - 1).square().mean()
