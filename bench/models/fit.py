"""Fits a candidate: a warm start without a renderer, then with the renderer's loss; the same rays for all."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.models.candidates import one_part
from bench.models.model import Candidate, Evidence, Model, Seen
from bench.models.observations import RayObservations, generator
from bench.records.record import RunStatus
from bench.setup.auto import rays_share
from bench.setup.fields import FitSettings
from bench.shape_prior import near_surface_first
from bench.solve.latent_code import Terms
from bench.solve.observed_view import gradients_at
from bench.solve.optimise import CannotContinue, FirstChecked, History, OptimiserSettings, optimise
from renderers.field import Counts, Field, Meter
from renderers.rendering import Renderer, Unsupported, check_kind, fresh

EIKONAL_POINTS = 512
SPENT = ("seconds", "evaluations", "gradients", "flops")  # the costs in an Evidence
NEAR_ENOUGH = 0.1  # loss: where a warm start begins below it, divergence is measured from it
SCREENING = 8  # each of several starts gets 1/8 of a warm start, then the best one a whole one
EIKONAL_SEED = 7  # of the points, which differ between iterations
CHECKPOINTS = {4**power for power in range(1, 12)}  # iterations after which a candidate is evaluated
PARTS_RATE, WHOLE_RATE = 0.03, 5e-3  # learning rates of warm starts: of parts, and of networks and grids
SURFACE_WIDTH = 0.05  # scene units: of `near_surface_first`
NEAR = 0.05  # scene units, standard deviation: how far from the surface half of the points are
RADIUS = 1.1  # scene units, of the sphere that holds the others: rays start on the unit sphere


@dataclass(eq=False)
class Fitted:
    """A candidate during its fit: the model that it began with, its current field, and its result and cost so far.

    It is fitted through a renderer with its own measured thickness where that follows the shape.
    """

    candidate: Candidate
    previous: Model | None
    model: Model
    renderer: Renderer
    evidence: Evidence

    @property
    def failed(self) -> bool:
        """Whether its loss became NaN or diverged, the renderer does not support it, or it could not be fitted."""
        return self.evidence.status is not RunStatus.OK


@dataclass(frozen=True)
class Fitter:
    """Fits candidates to the same observations; `on_line` gets a candidate's name and each line of its curve."""

    observations: RayObservations
    settings: FitSettings
    seed: int
    device: torch.device
    on_line: Callable[[str, dict[str, Any]], None]
    part: str = "growth"  # of the run that the lines belong to
    spent: dict[str, float] = field(default_factory=dict)  # seconds of all fits, by phase
    notes: list[str] = field(default_factory=list)  # on the hits of first renderings; see `FirstChecked`

    def begin(self, candidate: Candidate, previous: Model | None, *, evaluate: bool = True) -> Fitted:
        """A candidate's model after its warm start; with `evaluate`, its held-out error is computed as well."""
        sphere, points = None, self.observations.points
        if previous is None and candidate.follows:
            sphere = self.begin(one_part("sphere"), None, evaluate=False)
            previous = sphere.model
        started = time.perf_counter()
        seen = Seen(points.cpu(), previous, self.seed, self.device)
        models = candidate.starts(seen)
        placing = time.perf_counter() - started
        target = None if previous is None or not candidate.follows else Meter(previous.frozen(), seen.counts)
        known, count = (points, self.observations.free, target), self.settings.warm_points
        starts = [
            (self._fitted(candidate, model, previous), WarmStart(model, *known, count, self.seed)) for model in models
        ]
        screened = self.settings.warm_iterations // SCREENING if len(starts) > 1 else 0
        for fitted, start in starts:
            self._warm_start(fitted, start, screened)
        fitted, start = min(starts, key=lambda pair: inf if pair[0].failed else pair[1].error())
        self._warm_start(fitted, start, self.settings.warm_iterations)
        spent = [other.evidence for other, _ in starts] + ([] if sphere is None else [sphere.evidence])
        for name in SPENT:
            setattr(fitted.evidence, name, sum(getattr(evidence, name) for evidence in spent))
        fitted.evidence.seconds += placing
        if previous is not None:
            fitted.evidence.evaluations += seen.counts.value
            fitted.evidence.flops += seen.counts.flops(previous.frozen()) or 0
        if evaluate:
            self._evaluate(fitted)
        return fitted

    def _fitted(self, candidate: Candidate, model: Model, previous: Model | None) -> Fitted:
        """A candidate's model as a Fitted; it has failed where the renderer does not support its kind of field."""
        evidence = Evidence(candidate.name, model.size, candidate.flops)
        fitted = Fitted(candidate, previous, model, fresh(self.observations.renderer), evidence)
        try:
            check_kind(self.observations.renderer, model.frozen())
        except Unsupported as error:
            fitted.evidence.status, fitted.evidence.reason = RunStatus.UNSUPPORTED, str(error)
        return fitted

    def _warm_start(self, fitted: Fitted, start: "WarmStart", iterations: int) -> None:
        if iterations and not fitted.failed:
            rate = PARTS_RATE if fitted.model.metric else WHOLE_RATE
            self._run(fitted, start, OptimiserSettings(iterations, rate, "cosine"), checkpoints=False)

    def fit(self, fitted: Fitted, iterations: int, *, checkpoints: bool) -> None:
        """Continues a candidate's fit, then evaluates it; with `checkpoints`, evaluates it on the way as well."""
        if fitted.failed or iterations < 1:
            return
        through = self.observations.through(fitted.renderer)
        problem = FitProblem(fitted.model, through, self.settings, fitted.evidence.iterations)
        settings = OptimiserSettings(iterations, fitted.model.learning_rate, "ramped")
        fitted.evidence.iterations += self._run(fitted, problem, settings, checkpoints=checkpoints)
        self._evaluate(fitted)

    def finish(self, fitted: Fitted, rounds: int) -> None:
        """Fits a candidate round by round, until a round lowers its held-out error by no standard error of the change.

        The first round is compared with none: a warm start imitates a field that may be better. A later one that raises
        the error, or fails, is taken back, and its cost counts. Where the last of all rounds still lowered the error,
        the evidence says so.
        """
        evidence = fitted.evidence
        self.fit(fitted, self.settings.iterations, checkpoints=True)
        for _ in range(1, rounds):
            before, done = evidence.error, evidence.iterations
            if before is None:
                return
            kept = [one.detach().clone() for one in fitted.model.parameters]
            self.fit(fitted, self.settings.iterations, checkpoints=True)
            gain = before.mean - evidence.mean
            evidence.falling = evidence.error is not None and gain > evidence.error.noise_of_difference(before)
            if not evidence.falling:
                if gain <= 0:
                    for parameter, old in zip(fitted.model.parameters, kept, strict=True):
                        parameter.data.copy_(old)
                    evidence.error, evidence.iterations = before, done
                    evidence.status, evidence.reason = RunStatus.OK, ""
                return

    def _run(
        self, fitted: Fitted, problem: "FitProblem | WarmStart", settings: OptimiserSettings, *, checkpoints: bool
    ) -> int:
        """Runs the optimisation loop, adds its cost to the evidence, and gives the number of iterations that it ran."""
        history, evidence = History(), fitted.evidence
        before, shape = {name: getattr(evidence, name) for name in SPENT}, fitted.model.field()

        def on_step(line: dict[str, Any]) -> None:
            spent = {"evaluations": history.counts.value, "gradients": history.counts.gradient}
            spent |= {"seconds": line["seconds"], "flops": history.counts.flops(shape) or 0}
            for name, amount in spent.items():
                setattr(evidence, name, before[name] + amount)
            step = line["iteration"] + 1
            if checkpoints and history.status is RunStatus.OK and step in CHECKPOINTS and step < settings.iterations:
                self._evaluate(fitted)
            where = {"part": self.part, "phase": problem.phase, "iteration": evidence.iterations + line["iteration"]}
            share = {"rays_share": problem.share} if isinstance(problem, FitProblem) else {}
            self.on_line(evidence.candidate, {**line, **where, **share})

        try:
            checked = FirstChecked(problem, self.notes)
            optimise(checked, settings, self.device, history=history, on_step=on_step, least_reference=NEAR_ENOUGH)
        except CannotContinue as error:
            history.status, history.reason = RunStatus.NOT_REACHED, str(error)
        for name, seconds in history.seconds.items():
            self.spent[name] = self.spent.get(name, 0.0) + seconds
        evidence.status, evidence.reason = history.status, history.reason
        if fitted.failed:
            evidence.error = None
        return len(history.curve)

    def _evaluate(self, fitted: Fitted) -> None:
        """Evaluates a candidate on the held-out rays, and notes a checkpoint."""
        evidence = fitted.evidence
        if not fitted.failed:
            evidence.error = self.observations.error(fitted.model.frozen())
            evidence.checkpoints.append({name: getattr(evidence, name) for name in SPENT} | {"error": evidence.mean})


@dataclass
class FitProblem:
    """Fits the parameters of a candidate with a renderer; see `bench.solve.solve.Objective`."""

    model: Model
    observations: RayObservations
    settings: FitSettings
    iterations_before: int  # iterations before this part of the fit
    share: float = 0.0  # of the rays that the last iteration used
    error: float = inf  # of the last iteration, in scene units
    counts: Counts = field(default_factory=Counts)
    phase: ClassVar[str] = "fit"

    @property
    def parameters(self) -> list[Tensor]:
        """The parameters that the optimiser changes."""
        return self.model.parameters

    def loss(self, iteration: int) -> Terms:
        """The renderer's terms, the eikonal term, and their sum."""
        counted, settings = Meter(self.model.field(), self.counts), self.settings
        place = self.iterations_before + iteration
        self.error = self.error if iteration else inf  # iteration 0 runs twice: once as warm-up
        self.share = rays_share(settings.fewest_rays, self.observations.footprint, self.error)
        terms = self.observations.terms(counted, place, self.share)
        self.error = self.observations.depth_error(terms)
        if not self.model.metric and settings.eikonal_weight:
            points = scattered(self.observations.points, EIKONAL_POINTS, generator(EIKONAL_SEED, place))
            slopes = torch.linalg.vector_norm(gradients_at(counted, points), dim=-1)
            terms["eikonal"] = settings.eikonal_weight * (slopes - 1).square().mean()
        return {"total": torch.stack(list(terms.values())).sum(), **terms}


@dataclass
class WarmStart:
    """Fits a model's parameters to points; see `bench.solve.solve.Objective`.

    A field with a formula is fitted to the observed points, where it should be 0, and to points that are known to lie
    outside, where it should not be negative. Other fields are fitted to the values of a target field.

    Args:
        model: that is fitted.
        surface, free: points of the surface; points outside.
        target: the field whose values are fitted; None fits to the points.
        count: number of points in an iteration, of each kind.
        seed: of the draws.
    """

    model: Model
    surface: Float[Tensor, "n 3"]
    free: Float[Tensor, "m 3"]
    target: Field | None
    count: int
    seed: int
    counts: Counts = field(default_factory=Counts)
    phase: ClassVar[str] = "warm start"

    @torch.no_grad()
    def error(self) -> float:
        """The loss of the current model, on the first draw, not counted."""
        return float(self._loss(self.model.field(), 0))

    @property
    def parameters(self) -> list[Tensor]:
        """The parameters that the optimiser changes."""
        return self.model.parameters

    def loss(self, iteration: int) -> dict[str, Tensor]:
        """The mean error of the values."""
        return {"total": self._loss(Meter(self.model.field(), self.counts), iteration)}

    def _loss(self, shape: Field, iteration: int) -> Float[Tensor, ""]:
        draw = generator(self.seed, iteration)
        if self.target is not None:
            points = scattered(self.surface, self.count, draw)
            with torch.no_grad():
                wanted = self.target(points)
            return near_surface_first((shape(points) - wanted).abs(), wanted, SURFACE_WIDTH).mean()
        off = shape(_some(self.surface, self.count, draw)).abs().mean()
        inside = (-shape(_some(self.free, self.count, draw))).clamp_min(0).mean()
        return off + inside


def scattered(surface: Float[Tensor, "n 3"], count: int, draw: torch.Generator) -> Float[Tensor, "count 3"]:
    """Points, half of them near points of a surface, the others anywhere in a sphere that holds the scene."""
    near = count // 2
    around = torch.nn.functional.normalize(torch.randn(count - near, 3, generator=draw), dim=-1)
    around *= RADIUS * torch.rand(count - near, 1, generator=draw) ** (1 / 3)
    noise = NEAR * torch.randn(near, 3, generator=draw)
    return torch.cat([_some(surface, near, draw) + noise.to(surface.device), around.to(surface.device)])


def _some(points: Float[Tensor, "n 3"], count: int, draw: torch.Generator) -> Float[Tensor, "count 3"]:
    return points[torch.randint(len(points), (count,), generator=draw).to(points.device)]
