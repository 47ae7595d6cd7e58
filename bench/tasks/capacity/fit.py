"""Fits a candidate: first without a renderer, then with its loss. All candidates are fitted to the same rays."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.records.record import RunStatus
from bench.shape_prior import near_surface_first
from bench.solve.latent_code import Terms, total
from bench.solve.optimise import CannotContinue, History, OptimiserSettings, optimise
from bench.solve.pixel_draw import generator_of
from bench.tasks.capacity.candidates import primitive_candidate
from bench.tasks.capacity.model import Candidate, Evidence, Model, StartInputs
from bench.tasks.capacity.observations import RayObservations
from bench.tasks.capacity.settings import FitSettings, rays_share
from renderers.field import Counts, Field, Meter, gradients_at
from renderers.rendering import Renderer, Unsupported, check_kind, with_empty_memory

EIKONAL_POINTS = 512
COSTS = ("seconds", "evaluations", "gradients", "flops")  # attributes of Evidence
LEAST_REFERENCE = 0.1  # lower bound of the first loss in the divergence test
SCREENING = 8  # each of several starts gets 1/8 of a warm start, then the best start a complete one
EIKONAL_SEED = 7
CHECKPOINTS = {4**power for power in range(1, 12)}  # iterations after which a candidate is evaluated
PRIMITIVE_WARM_RATE, OTHER_WARM_RATE = 0.03, 5e-3  # learning rates of warm starts
SURFACE_WIDTH = 0.05  # scene units, see `near_surface_first`
NEAR_SAMPLE_STD = 0.05  # scene units, of half of the points from the surface
SAMPLE_SPHERE_RADIUS = 1.1  # scene units: the other points fill this sphere; rays start on the unit sphere


@dataclass(eq=False)
class Fitted:
    """A candidate during its fit: the previous model, its current field, and its result and cost so far.

    It has a copy of the renderer, so that a thickness measured on the shape is its own.
    """

    candidate: Candidate
    previous: Model | None
    model: Model
    renderer: Renderer
    evidence: Evidence

    @property
    def failed(self) -> bool:
        """Whether the loss became NaN or diverged, the renderer does not support the field, or the fit stopped."""
        return self.evidence.status is not RunStatus.OK


@dataclass(frozen=True)
class Fitter:
    """Fits candidates to the same observations; `on_line` receives a candidate's name and each line of its curve."""

    observations: RayObservations
    settings: FitSettings
    seed: int
    device: torch.device
    on_line: Callable[[str, dict[str, Any]], None]
    stage: str = "growth"  # of the run, in each line of the curve
    spent: dict[str, float] = field(default_factory=dict)  # seconds of all fits, by phase
    notes: list[str] = field(default_factory=list)  # on the hits of first renderings, see `History`

    def begin(self, candidate: Candidate, previous: Model | None, *, evaluate: bool = True) -> Fitted:
        """A candidate's model after its warm start; `evaluate` also computes its held-out error."""
        sphere, points = None, self.observations.points
        if previous is None and candidate.follows:
            sphere = self.begin(primitive_candidate("sphere"), None, evaluate=False)
            previous = sphere.model
        started = time.perf_counter()
        inputs = StartInputs(points.cpu(), previous, self.seed, self.device)
        models = candidate.starts(inputs)
        start_seconds = time.perf_counter() - started
        target = None if previous is None or not candidate.follows else Meter(previous.frozen(), inputs.counts)
        data = (points, self.observations.free, target, self.settings.warm_points, self.seed)
        starts = [(self._new_fit(candidate, model, previous), WarmStart(model, *data)) for model in models]
        screening = self.settings.warm_iterations // SCREENING if len(starts) > 1 else 0
        for fitted, start in starts:
            self._warm_start(fitted, start, screening)
        fitted, start = min(starts, key=lambda pair: inf if pair[0].failed else pair[1].error())
        self._warm_start(fitted, start, self.settings.warm_iterations)
        all_evidence = [start.evidence for start, _ in starts] + ([] if sphere is None else [sphere.evidence])
        for name in COSTS:
            setattr(fitted.evidence, name, sum(getattr(evidence, name) for evidence in all_evidence))
        fitted.evidence.seconds += start_seconds
        if previous is not None:
            fitted.evidence.evaluations += inputs.counts.value
            fitted.evidence.flops += inputs.counts.flops(previous.frozen()) or 0
        if evaluate:
            self._evaluate(fitted)
        return fitted

    def _new_fit(self, candidate: Candidate, model: Model, previous: Model | None) -> Fitted:
        """A candidate's model as a Fitted; it has failed if the renderer does not support its kind of field."""
        evidence = Evidence(candidate.name, model.size, candidate.flops)
        fitted = Fitted(candidate, previous, model, with_empty_memory(self.observations.renderer), evidence)
        try:
            check_kind(self.observations.renderer, model.frozen())
        except Unsupported as error:
            fitted.evidence.status, fitted.evidence.reason = RunStatus.UNSUPPORTED, str(error)
        return fitted

    def _warm_start(self, fitted: Fitted, start: "WarmStart", iterations: int) -> None:
        if iterations and not fitted.failed:
            rate = PRIMITIVE_WARM_RATE if fitted.model.metric else OTHER_WARM_RATE
            self._run(fitted, start, OptimiserSettings(iterations, rate, "cosine"), checkpoints=False)

    def fit(self, fitted: Fitted, iterations: int, *, checkpoints: bool) -> None:
        """Continues a candidate's fit, then evaluates it; `checkpoints` also evaluates it during the fit."""
        if fitted.failed or iterations < 1:
            return
        observations = self.observations.with_renderer(fitted.renderer)
        problem = FitProblem(fitted.model, observations, self.settings, fitted.evidence.iterations)
        settings = OptimiserSettings(iterations, fitted.model.learning_rate, "ramped")
        fitted.evidence.iterations += self._run(fitted, problem, settings, checkpoints=checkpoints)
        self._evaluate(fitted)

    def finish(self, fitted: Fitted, rounds: int) -> None:
        """Fits a candidate in rounds that double its iterations, until one lowers its error by at most its noise.

        The error is that of held-out rays, and its noise one standard error of the difference. Rounds of equal length
        would gain less and less, and end slow fits early. The first round is not tested, since a warm start imitates a
        field that may be better. A later round that raises the error or fails is undone; its cost counts.
        `evidence.falling` is true if the last of all rounds lowered the error: the fit had not ended.
        """
        evidence = fitted.evidence
        self.fit(fitted, self.settings.iterations, checkpoints=True)
        for _ in range(1, rounds):
            earlier, iterations = evidence.error, evidence.iterations
            if earlier is None:
                return
            saved = [parameter.detach().clone() for parameter in fitted.model.parameters]
            self.fit(fitted, iterations, checkpoints=True)
            gain = earlier.mean - evidence.mean
            evidence.falling = evidence.error is not None and gain > evidence.error.noise_of_difference(earlier)
            if not evidence.falling:
                if gain <= 0:
                    for parameter, value in zip(fitted.model.parameters, saved, strict=True):
                        parameter.data.copy_(value)
                    evidence.error, evidence.iterations = earlier, iterations
                    evidence.status, evidence.reason = RunStatus.OK, ""
                return

    def _run(
        self, fitted: Fitted, problem: "FitProblem | WarmStart", settings: OptimiserSettings, *, checkpoints: bool
    ) -> int:
        """Runs the optimisation loop, adds its cost to the evidence, and returns the number of its iterations."""
        history, evidence = History(notes=self.notes), fitted.evidence
        earlier, shape = {name: getattr(evidence, name) for name in COSTS}, fitted.model.field()

        def on_step(line: dict[str, Any]) -> None:
            spent = {"evaluations": history.counts.value, "gradients": history.counts.gradient}
            spent |= {"seconds": line["seconds"], "flops": history.counts.flops(shape) or 0}
            for name, amount in spent.items():
                setattr(evidence, name, earlier[name] + amount)
            step = line["iteration"] + 1
            if checkpoints and history.status is RunStatus.OK and step in CHECKPOINTS and step < settings.iterations:
                self._evaluate(fitted)
            where = {"part": self.stage, "phase": problem.phase, "iteration": evidence.iterations + line["iteration"]}
            share = {"rays_share": problem.share} if isinstance(problem, FitProblem) else {}
            self.on_line(evidence.candidate, {**line, **where, **share})

        try:
            optimise(problem, settings, self.device, history=history, on_step=on_step, least_reference=LEAST_REFERENCE)
        except CannotContinue as error:
            history.status, history.reason = RunStatus.NOT_REACHED, str(error)
        for name, seconds in history.seconds.items():
            self.spent[name] = self.spent.get(name, 0.0) + seconds
        evidence.status, evidence.reason = history.status, history.reason
        if fitted.failed:
            evidence.error = None
        return len(history.curve)

    def _evaluate(self, fitted: Fitted) -> None:
        evidence = fitted.evidence
        if not fitted.failed:
            evidence.error = self.observations.error(fitted.model.frozen())
            evidence.checkpoints.append({name: getattr(evidence, name) for name in COSTS} | {"error": evidence.mean})


@dataclass
class FitProblem:
    """Fits the parameters of a candidate with a renderer; see `bench.solve.optimise.Optimisable`."""

    model: Model
    observations: RayObservations
    settings: FitSettings
    iterations_before: int  # of earlier fits of the candidate
    share: float = 0.0  # fraction of the rays in the last iteration
    error: float = inf  # of the last iteration, in scene units
    counts: Counts = field(default_factory=Counts)
    phase: ClassVar[str] = "fit"

    @property
    def parameters(self) -> list[Tensor]:
        return self.model.parameters

    def loss(self, iteration: int) -> Terms:
        metered, settings = Meter(self.model.field(), self.counts), self.settings
        step = self.iterations_before + iteration
        self.error = self.error if iteration else inf  # iteration 0 runs twice, first as warm-up
        self.share = rays_share(settings.fewest_rays, self.observations.footprint, self.error)
        terms = self.observations.terms(metered, step, self.share)
        self.error = self.observations.depth_error(terms)
        if not self.model.metric and settings.eikonal_weight:
            points = scatter_points(self.observations.points, EIKONAL_POINTS, generator_of(EIKONAL_SEED, step))
            norms = torch.linalg.vector_norm(gradients_at(metered, points), dim=-1)
            terms["eikonal"] = settings.eikonal_weight * (norms - 1).square().mean()
        return {"total": total(terms), **terms}


@dataclass
class WarmStart:
    """Fits a model's parameters to points; see `bench.solve.optimise.Optimisable`.

    A field with a formula is fitted to the observed points, where it should be 0, and to points known to lie outside,
    where it should not be negative. Other fields are fitted to the values of a target field.

    Args:
        target: the field whose values are fitted; None fits to the points.
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
        """The loss of the current model on the first draw, not counted as cost."""
        return float(self._loss(self.model.field(), 0))

    @property
    def parameters(self) -> list[Tensor]:
        return self.model.parameters

    def loss(self, iteration: int) -> dict[str, Tensor]:
        return {"total": self._loss(Meter(self.model.field(), self.counts), iteration)}

    def _loss(self, shape: Field, iteration: int) -> Float[Tensor, ""]:
        draw = generator_of(self.seed, iteration)
        if self.target is not None:
            points = scatter_points(self.surface, self.count, draw)
            with torch.no_grad():
                target = self.target(points)
            return near_surface_first((shape(points) - target).abs(), target, SURFACE_WIDTH).mean()
        surface_error = shape(_draw_points(self.surface, self.count, draw)).abs().mean()
        free_error = (-shape(_draw_points(self.free, self.count, draw))).clamp_min(0).mean()
        return surface_error + free_error


def scatter_points(surface: Float[Tensor, "n 3"], count: int, draw: torch.Generator) -> Float[Tensor, "count 3"]:
    """Draws points, half of them near points of a surface, the others uniformly in a sphere around the scene."""
    near_count = count // 2
    uniform = torch.nn.functional.normalize(torch.randn(count - near_count, 3, generator=draw), dim=-1)
    uniform *= SAMPLE_SPHERE_RADIUS * torch.rand(count - near_count, 1, generator=draw) ** (1 / 3)
    noise = NEAR_SAMPLE_STD * torch.randn(near_count, 3, generator=draw)
    near = _draw_points(surface, near_count, draw) + noise.to(surface.device)
    return torch.cat([near, uniform.to(surface.device)])


def _draw_points(points: Float[Tensor, "n 3"], count: int, draw: torch.Generator) -> Float[Tensor, "count 3"]:
    return points[torch.randint(len(points), (count,), generator=draw).to(points.device)]
