"""Fits a rung: a warm start without a renderer, then the renderer's loss; every rung with the same rays and budget."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.auto import rays
from bench.ladder.choice import Evidence
from bench.ladder.model import Model, Rung, Seen
from bench.ladder.observations import Drawn, Observations, generator
from bench.ladder.warm_start import WarmStart, scattered
from bench.optimise import Course, optimise
from bench.records import RunStatus
from bench.tasks.problem import OptimiserSettings, Unsupported, check_kind
from renderers.checks import check_at_least
from renderers.field import Counts, Field, Meter
from renderers.rendering import Renderer

EIKONAL_POINTS = 512
QUERIES = 8  # field values a ray, about, of a tracer
LOOKS = {4**power for power in range(1, 12)}  # iterations
PARTS_RATE, WHOLE_RATE = 0.03, 5e-3  # learning rates of warm starts: of parts, and of networks and grids


@dataclass(frozen=True)
class FitSettings:
    """How each rung is fitted.

    Args:
        iterations: of the renderer's loss.
        rays: drawn in each.
        fewest_rays: with which it begins where their number follows the loss (`bench.auto.rays`); None: all the same.
        warm_iterations, warm_points: of the start without a renderer, to the observed points and the previous field.
        depth_weight, silhouette_weight: see `bench.tasks.completion.Completion`.
        eikonal_weight: of the mean square of |grad f| - 1 (Gropp et al. 2020), for fields that are no distance by
            themselves.
    """

    iterations: int
    rays: int
    fewest_rays: int | None
    warm_iterations: int
    warm_points: int
    depth_weight: float
    silhouette_weight: float
    eikonal_weight: float

    def __post_init__(self) -> None:
        for name in ("iterations", "rays", "warm_points"):
            check_at_least(f"task.fit.{name}", getattr(self, name), 1, "conf/task/capacity.yaml has values that work")
        if self.fewest_rays is not None and not 1 <= self.fewest_rays <= self.rays:
            raise ValueError(
                f"task.fit.fewest_rays must lie between 1 and rays={self.rays}, not {self.fewest_rays}: 128"
            )
        check_at_least("task.fit.warm_iterations", self.warm_iterations, 0, "0 switches the warm start off")
        for name in ("depth_weight", "silhouette_weight", "eikonal_weight"):
            check_at_least(f"task.fit.{name}", getattr(self, name), 0, "0 switches the term off")


@dataclass
class Fitted:
    """A rung under way."""

    model: Model
    evidence: Evidence
    done: int = 0  # iterations

    @property
    def failed(self) -> bool:
        """Whether its loss became NaN or diverged."""
        return self.evidence.status is not RunStatus.OK


@dataclass(frozen=True)
class Fitter:
    """Fits rungs to the same observations.

    Args:
        observations: what is given and what is held out.
        renderer: through which it is seen.
        settings: how.
        seed: of what is drawn.
        device: where.
        on_line: is told of each iteration: the rung and a line of the curve.
    """

    observations: Observations
    renderer: Renderer
    settings: FitSettings
    seed: int
    device: torch.device
    on_line: Callable[[str, dict[str, Any]], None]
    spent: dict[str, float] = field(default_factory=dict)  # seconds of all fits, by what they were for

    @property
    def warm_share(self) -> float:
        """Field values of a warm start over those of a whole fit, about."""
        settings = self.settings
        return settings.warm_iterations * settings.warm_points / (settings.iterations * settings.rays * QUERIES)

    def begin(self, rung: Rung, previous: Model | None) -> Fitted:
        """A rung's model after its warm start, judged."""
        seen = Seen(self.observations.points.cpu(), previous, self.seed, self.device)
        started = [self._started(rung, model, previous) for model in rung.starts(seen)]
        fitted, _ = min(started, key=lambda pair: pair[1])
        evidence = fitted.evidence
        evidence.seconds, evidence.evaluations, evidence.flops = (
            sum(getattr(other.evidence, name) for other, _ in started) for name in ("seconds", "evaluations", "flops")
        )
        self._judge(fitted)
        return fitted

    def _started(self, rung: Rung, model: Model, previous: Model | None) -> tuple[Fitted, float]:
        """A model after its warm start, and what that came to."""
        fitted = Fitted(model, Evidence(rung.name, model.size, model.bytes, rung.flops))
        try:
            check_kind(self.renderer, model.frozen())
        except Unsupported as error:
            fitted.evidence.status, fitted.evidence.reason = RunStatus.UNSUPPORTED, str(error)
            return fitted, inf
        target = None if model.metric or previous is None else previous.frozen()
        start = WarmStart.of(model, self.observations, target, count=self.settings.warm_points, seed=self.seed)
        if self.settings.warm_iterations:
            rate = PARTS_RATE if model.metric else WHOLE_RATE
            self._run(fitted, start, OptimiserSettings(self.settings.warm_iterations, rate, "cosine"), looks=False)
        return fitted, inf if fitted.failed else start.error()

    def fit(self, fitted: Fitted, iterations: int, *, schedule: str, looks: bool) -> None:
        """Goes on with a rung for so many iterations, and judges it; with `looks` on the way, too."""
        if fitted.failed or iterations < 1:
            return
        drawn = Drawn(self.observations.given, self.observations.through_sphere(), self.settings.rays, self.seed)
        problem = RungProblem(fitted.model, drawn, self.observations, self.settings, fitted.done)
        settings = OptimiserSettings(iterations, fitted.model.learning_rate, schedule)
        self._run(fitted, problem, settings, looks=looks)
        fitted.done += iterations
        self._judge(fitted)

    def _run(
        self, fitted: Fitted, problem: "RungProblem | WarmStart", settings: OptimiserSettings, *, looks: bool
    ) -> None:
        """Runs the one loop, and adds what it cost to the evidence."""
        course, evidence = Course(least_reference=self._pixel_loss()), fitted.evidence
        before = evidence.seconds, evidence.evaluations, evidence.flops

        def on_step(line: dict[str, Any]) -> None:
            evidence.seconds = before[0] + line["seconds"]
            evidence.evaluations = before[1] + course.counts.value
            evidence.flops = before[2] + (course.counts.flops(fitted.model.field()) or 0)
            step = line["iteration"] + 1
            if looks and course.status is RunStatus.OK and step in LOOKS and step < settings.iterations:
                self._judge(fitted)
            self.on_line(evidence.rung, {**line, "iteration": fitted.done + line["iteration"]})

        optimise(problem, settings, self.device, course=course, on_step=on_step)
        for name, seconds in course.seconds.items():
            self.spent[name] = self.spent.get(name, 0.0) + seconds
        evidence.status, evidence.reason = course.status, course.reason
        if fitted.failed:
            evidence.error = None

    def _pixel_loss(self) -> float:
        """The loss where every ray is wrong by the footprint: a warm start may begin below it."""
        return (self.settings.depth_weight + self.settings.silhouette_weight) * self.observations.footprint

    def _judge(self, fitted: Fitted) -> None:
        """Looks at a rung as it stands."""
        evidence = fitted.evidence
        if not fitted.failed:
            evidence.error = self.observations.held_out.error(fitted.model.frozen(), self.renderer)
            spent = {"seconds": evidence.seconds, "evaluations": evidence.evaluations, "flops": evidence.flops}
            evidence.looks.append({**spent, "error": evidence.mean})


@dataclass
class RungProblem:
    """The free numbers of a rung; see `bench.tasks.problem.Problem`."""

    model: Model
    drawn: Drawn
    observations: Observations
    settings: FitSettings
    begun: int  # iterations that were before
    error: float = inf  # mean error of the depths at the last iteration, in scene units
    counts: Counts = field(default_factory=Counts)
    photographs: None = None

    @property
    def parameters(self) -> list[Tensor]:
        """What is free."""
        return self.model.parameters

    @property
    def rays_per_iteration(self) -> int:
        """That are drawn."""
        return self.drawn.count

    @property
    def observed(self) -> Bool[Tensor, " n"]:
        """Rays whose depth is given."""
        return self.drawn.view.observed

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The renderer's terms, that of the gradient's length, and their sum."""
        counted, own, settings = Meter(self.model.field(), self.counts), self.begun + iteration, self.settings
        terms = self.drawn.rays(own, self._count()).compare(counted, own)
        if settings.depth_weight:
            self.error = float(terms["depth"].detach()) / settings.depth_weight
        if not self.model.metric and settings.eikonal_weight:
            points = scattered(self.observations.points, EIKONAL_POINTS, generator(self.drawn.seed, own))
            terms["eikonal"] = settings.eikonal_weight * _slope_error(counted, points)
        return {"total": torch.stack(list(terms.values())).sum(), **terms}

    def _count(self) -> int:
        """Rays of this iteration."""
        if self.settings.fewest_rays is None:
            return self.drawn.count
        return rays(self.drawn.count, self.settings.fewest_rays, self.observations.footprint, self.error)

    def objective(self) -> None:
        """Losses of different iterations are comparable."""

    def field(self) -> Field:
        """As it stands."""
        return self.model.frozen()


def _slope_error(shape: Field, points: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """The mean square of |grad f| - 1 (Gropp et al. 2020)."""
    leaf = points.detach().requires_grad_()
    (gradient,) = torch.autograd.grad(shape(leaf).sum(), leaf, create_graph=True)
    return (torch.linalg.vector_norm(gradient, dim=-1) - 1).square().mean()
