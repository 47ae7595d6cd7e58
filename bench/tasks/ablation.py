"""The rendering benchmark: a renderer's cost and error on one view of a fitted network (DIST, Table 1).

With `beside`, several renderers are timed in turn in one process, and compared with the run's renderer. With
`device=cuda`, CUDA events measure all seconds, after a warm-up at full size; not yet run on a GPU. CUDA graphs are not
used, because the sizes of a march's tensors differ between renderings.
"""

import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from math import ceil
from statistics import median
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from bench.config import load
from bench.evaluate.reference import Reference, reference_for
from bench.machine.environment import Stopwatch, gemm_peak, seconds_at_peak, using_threads
from bench.machine.limits import LimitReached, Limits
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import check_field_gradient, evaluation_counts
from bench.tables import extension
from datasets.scene import View
from renderers.boundary import render_checked, silhouette_loss
from renderers.camera import Camera, Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Coarse, Counts, Field, Meter, Wrapper, autograd_gradients, autograd_normals, coarse_version
from renderers.rendering import RayObservation, Renderer, Rendering, Status, check_kind
from renderers.tracing.waits import active_mask

BASE = "base"  # the run's renderer, if it is compared with others
SHRINK_FACTOR = 8  # after a limit was reached, the image's side is divided by this
GRADIENT_DRAWS = 16  # random signs of the hits' shifts
WARM_UP_PIXELS = 8  # side of the image that is rendered before the timing, on a CPU
DEFINITIONS = {
    "size": "pixels per side of the image for which the other numbers were measured",
    "queries": "points whose field value was computed in one rendering without gradient; counted at the field, without "
    "those of rays that had ended, which a GPU computes and throws away",
    "coarse_queries, step_coarse_queries": "beside these, points whose value was computed more cheaply, in bfloat16, "
    "where it decides nothing; in a rendering, and in a step",
    "step_queries, step_gradients": "points whose value was computed in a step, and points through whose value a "
    "non-zero gradient was propagated back",
    "forward_seconds": "rendering without gradient: median of the repeats; _low and _high: least and largest; by the "
    "wall clock or, on a GPU, its own events",
    "step_seconds": "a step of an optimisation: rendering with gradient, losses, backward",
    "backward_seconds": "the backward pass of a step",
    "repeats": "how often a step was timed",
    "evaluations.value, evaluations.gradient": "as step_queries and step_gradients",
    "evaluations.cost": "field evaluations of a step: a gradient counts as two, a coarse value as an eighth",
    "evaluations.per_ray": "queries divided by rays",
    "evaluations.work_over_bound": "the operations of a step, divided by those of one value and one gradient per hit; "
    "absent without hits",
    "seconds.total": "the whole run, with making or loading shape, network and reference",
    "forward_gemm, step_gemm": "seconds that the floating-point operations take at the machine's peak rate of a matrix "
    "product, in float32 or, of coarse values, in bfloat16, over the median time",
    "peak_memory_bytes": "highest rise of PyTorch's memory on a GPU, in a step; not measured on a CPU",
    "lost, false": "missed pixels, which only the float64 reference hits; spurious ones, which only the renderer hits",
    "behind": "share of the field values, coarse ones too, of one more rendering, untimed, that are negative: samples "
    "behind the surface (DIST, Fig. 14)",
    "pixel_errors": "lost, false and wrong together; at the start, the number of hits of the reference",
    "cost": "of one rendering, in field values: a coarse one counts as an eighth",
    "rays, hits": "pixels of the image; pixels that the reference hits",
    "wrong": "pixels that both hit, at depths that differ by more than task.wrong",
    "error_p95": "95th percentile of the difference of depth over the pixels that either hits, where a pixel that only "
    "one of them hits counts as infinite; in scene units",
    "out_of_steps": "pixels whose ray used all steps before it converged",
    "gradient_error": "with task.gradient: relative error of the gradient by the network's weights, against implicit "
    "differentiation in float64 (DVR, Eq. 8): root mean square, over random signs, of sums of all common hits' shifts "
    "along their normals; so errors of pixels do not cancel; without coarse values",
    "depth_error": "median, 99th percentile and largest difference of depth over pixels that both hit, in scene units",
}
IN_TURN_DEFINITIONS = {
    "rounds": "how often each renderer was timed, in turn, each round in the opposite order of the last one",
    "forward_cpu, step_cpu": "seconds of all threads together: median over rounds",
    "forward_ratio, step_ratio, forward_cpu_ratio, step_cpu_ratio": "over the first renderer's of the same round: "
    "median; _low and _high: least and largest",
    "work_over_bound": "the operations of a step, divided by those of one value and one gradient per hit",
}


@dataclass(frozen=True)
class Ablation:
    """Renders a training shape of the prior, forward and backward, and compares it with the reference.

    If a limit is reached at the requested resolution, the run's status reports it. An eighth of the side is tried next,
    until the measurement finishes or the side is below `smallest`.

    Args:
        repeats: timed repeats of the renderer alone; fewer if together they take more than a quarter of the limit, one
            at smaller sizes.
        limits: limits of each rendering and each step.
        smallest: minimum pixels per side.
        wrong: difference of depth, in scene units, above which a pixel is wrong.
        beside: names of other renderers that are timed in turn with the run's renderer.
        rounds: number of rounds with `beside`; in each, every renderer takes one step and renders once.
        gradient: whether to measure `gradient_error`, which takes a further step with all weights.
        size: pixels per side of the image; None: the size in `view`.
        threads: number of CPU threads; None: the run's number.
    """

    repeats: int
    limits: Limits
    smallest: int
    wrong: float
    beside: list[str] = field(default_factory=list)
    rounds: int = 1
    gradient: bool = False
    size: int | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        check_at_least("task.repeats", self.repeats, 1, "3 show the spread")
        check_at_least("task.smallest", self.smallest, 1, "8 always finishes")
        check_positive("task.wrong", self.wrong, "0.02 is 1 % of the unit sphere")
        check_at_least("task.rounds", self.rounds, 1, "5 show the spread")
        if self.size is not None:
            check_at_least("task.size", self.size, 8, "128 is quick")
        if self.threads is not None:
            check_at_least("task.threads", self.threads, 1, "1 is steadiest")

    def check(self, inputs: RunInputs) -> None:
        inputs.check_fitted()

    def execute(self, run: RunContext) -> None:
        """Measures costs and errors, and writes them to the record, images.npz and a picture."""
        run.record.definitions = DEFINITIONS | (IN_TURN_DEFINITIONS if self.beside else {})
        with using_threads(self.threads or torch.get_num_threads()):
            self._measure(run)

    def _measure(self, run: RunContext) -> None:
        """Measures at the requested resolution, or at the first smaller one at which no limit is reached."""
        record, requested = run.record, run.inputs.scene.view.camera
        requested = requested.resized(self.size, self.size) if self.size else requested
        camera, measured = requested, None
        failure: tuple[RunStatus, str] | None = None
        while measured is None:
            try:
                measured = self._timed(run, camera, repeats=1 if failure else self.repeats)
            except LimitReached as limit:
                failure = failure or (limit.status, str(limit))  # not the exception, which keeps all tensors alive
                smaller = camera.height // SHRINK_FACTOR, camera.width // SHRINK_FACTOR
                if min(smaller) < self.smallest:
                    break
                camera = camera.resized(*smaller)
        record.status, record.reason = RunStatus.OK, ""
        if failure is not None:
            end = "at no smaller size" if measured is None else f"at {camera.height} x {camera.width}"
            record.status = failure[0]
            record.reason = f"{failure[1]} at {requested.height} x {requested.width}; it finishes {end}"
        if measured is not None:
            self._note(run, measured)

    def _timed(self, run: RunContext, camera: Camera, *, repeats: int) -> "dict[str, Workbench]":
        """Times all renderers at one resolution.

        Raises:
            LimitReached: if a rendering or a step exceeds a limit.
        """
        inputs, size = run.inputs, f"{camera.height} x {camera.width}"
        run.progress(f"making the reference at {size}", 0, 1)
        reference = reference_for(inputs.fitted(), camera, inputs.cache)
        renderers = {BASE: inputs.renderer} | {name: load("renderer", name) for name in self.beside}
        benches = {
            name: Workbench(inputs, renderer, camera, reference, self.limits) for name, renderer in renderers.items()
        }
        if not self.beside:
            run.progress(f"timing steps at {size}", 0, 1)
            benches[BASE].steps(repeats)  # first: it costs more, and if it exceeds a limit, renderings were wasted
            run.progress(f"timing renderings at {size}", 0, 1)
            benches[BASE].renderings(repeats)
            return benches
        for completed in range(self.rounds):
            run.progress("timing renderers in turn", completed, self.rounds)
            for name in list(benches)[:: -1 if completed % 2 else 1]:
                suffix = "" if name == BASE else f" of {name}"
                benches[name].renderings(1, suffix)
                benches[name].steps(1, suffix)
        return benches

    def _note(self, run: RunContext, benches: "dict[str, Workbench]") -> None:
        record, bench = run.record, benches[BASE]
        machine, peak_flops = record.environment, gemm_peak(bench.device)  # measured close to the times
        machine["gemm_peak_flops"] = max(machine["gemm_peak_flops"], peak_flops)
        numbers = {
            name: costs(b.forward, b.step, machine) | b.errors(self.wrong) | {"behind": b.negative_fraction()}
            for name, b in benches.items()
        }
        numbers[BASE] |= bench.gradient() if self.gradient else {}
        record.metrics = {"size": bench.camera.height, **numbers[BASE], "cost": bench.forward.counts.cost}
        record.metrics_start = {"pixel_errors": record.metrics["hits"]}
        record.seconds |= {name: record.metrics[f"{name}_seconds"] for name in ("forward", "backward")}
        record.evaluations = evaluation_counts(bench.step.counts, bench.decoder.at(bench.code))
        record.evaluations["per_ray"] = bench.forward.counts.value / bench.rays.shape.numel()
        record.peak_memory_bytes = bench.step.memory
        if self.beside:
            record.metrics = {"size": bench.camera.height, "rounds": self.rounds}
            for name, timed in benches.items():
                metrics = numbers[name] | ratios(timed.forward, bench.forward, "forward")
                metrics |= ratios(timed.step, bench.step, "step")
                if (work_ratio := timed.step.counts.over_bound(timed.decoder.at(timed.code))) is not None:
                    metrics["work_over_bound"] = work_ratio
                record.metrics |= {f"{name}.{key}": number for key, number in metrics.items()}
        title = f"{record.name}, {record.scene}: {record.status}"
        extension("pictures")(run.inputs).compare(run.folder, *bench.views(), title=title)


@dataclass
class Timings:
    """The costs of repeats of the same work.

    Args:
        cpu_seconds: seconds of all threads together.
        memory: largest rise of memory in a repeat, in bytes.
        flops, coarse_flops: operations of the last repeat in float32 and in bfloat16; None if the field has no count.
    """

    seconds: list[float] = field(default_factory=list)
    backward_seconds: list[float] = field(default_factory=list)
    cpu_seconds: list[float] = field(default_factory=list)
    counts: Counts = field(default_factory=Counts)
    memory: int | None = None
    flops: int | None = None
    coarse_flops: int = 0


def costs(forward: Timings, step: Timings, machine: dict[str, Any]) -> dict[str, float]:
    """The metrics of renderings and steps by their names in DEFINITIONS; `machine` has the machine's peak rates."""
    metrics: dict[str, float] = {
        "queries": forward.counts.value,
        "coarse_queries": forward.counts.coarse,
        "step_queries": step.counts.value,
        "step_coarse_queries": step.counts.coarse,
        "step_gradients": step.counts.gradient,
        "repeats": len(step.seconds),
    }
    for name, seconds in (("forward", forward.seconds), ("step", step.seconds), ("backward", step.backward_seconds)):
        metrics |= {f"{name}_seconds": median(seconds), f"{name}_seconds_low": min(seconds)}
        metrics[f"{name}_seconds_high"] = max(seconds)
    for name, timings in (("forward", forward), ("step", step)):
        if timings.flops is not None:
            at_peak = seconds_at_peak(machine, timings.flops, timings.coarse_flops)
            metrics[f"{name}_gemm"] = at_peak / median(timings.seconds)
    if step.memory is not None:
        metrics["peak_memory_bytes"] = step.memory
    return metrics


def ratios(timings: Timings, base: Timings, name: str) -> dict[str, float]:
    """The runtime of one rendering or step over the first renderer's in the same round, over all rounds."""
    metrics = {f"{name}_cpu": median(timings.cpu_seconds)}
    pairs = {name: (timings.seconds, base.seconds), f"{name}_cpu": (timings.cpu_seconds, base.cpu_seconds)}
    for key, pair in pairs.items():
        over = [seconds / base_seconds for seconds, base_seconds in zip(*pair, strict=True)]
        metrics |= {f"{key}_ratio": median(over), f"{key}_ratio_low": min(over), f"{key}_ratio_high": max(over)}
    return metrics


@dataclass
class SignCounter(Wrapper):
    """A Field that counts its evaluations, also coarse ones, and the negative values among them."""

    inner: Field
    evaluated: int = 0
    negative: int = 0
    keeps_values: ClassVar[bool] = True

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self._counted(self.inner(points))

    def _counted(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        all_values, active = values.flatten(), active_mask(values.numel())
        evaluated = all_values if active is None else all_values[active]
        self.evaluated += evaluated.numel()
        self.negative += int((evaluated < 0).sum())
        return values

    @property
    def coarse(self) -> Coarse | None:
        coarse = coarse_version(self.inner)
        return coarse and replace(coarse, values=lambda points: self._counted(coarse.values(points)))


class Workbench:
    """Renders one view of a network with a renderer, under limits, and times it."""

    def __init__(
        self, inputs: RunInputs, renderer: Renderer, camera: Camera, reference: Reference, limits: Limits
    ) -> None:
        prior, self.device = inputs.fitted(), inputs.device
        self.decoder = prior.decoder.to(self.device).requires_grad_(False)
        self.code = prior.codes[0].detach().clone().to(self.device).requires_grad_(True)
        self.renderer, self.camera, self.reference, self.limits = renderer, camera, reference, limits
        self.rays = camera.rays().to(self.device)
        self.mask = reference.hit.to(self.device)
        self.rendering: Rendering | None = None
        self.forward, self.step = Timings(), Timings()
        check_kind(self.renderer, self.decoder.at(self.code))
        check_field_gradient(self.renderer)
        field = self.decoder.at(self.code)
        if self.device.type == "cpu":
            small = camera.resized(WARM_UP_PIXELS, WARM_UP_PIXELS)
            self._step(field, small.rays(), torch.ones(WARM_UP_PIXELS, WARM_UP_PIXELS).bool())
        else:  # at full size: a GPU loads kernels and allocates memory according to the size
            self._step(limits.watch(field, self.device, "a step"), self.rays, self.mask)

    def renderings(self, repeats: int, suffix: str = "") -> None:
        """Times renderings without gradient; `suffix` names the renderer if a limit is reached."""

        def work(field: Field) -> float:
            with torch.no_grad():
                self.rendering = render_checked(self.renderer, field, self.rays)
            return 0.0

        self._clock(self.forward, f"a rendering{suffix}", work, repeats)

    def steps(self, repeats: int, suffix: str = "") -> None:
        """Times steps of an optimisation of the code."""
        self._clock(self.step, f"a step{suffix}", lambda field: self._step(field, self.rays, self.mask), repeats)

    def errors(self, wrong: float) -> dict[str, float]:
        """The errors of the rendering against the reference, by their names in DEFINITIONS."""
        predicted, reference = self.views()
        error = (predicted.depth - reference.depth).abs()[predicted.mask & reference.mask].double()
        numbers = {
            "rays": predicted.mask.numel(),
            "hits": int(reference.mask.sum()),
            "lost": int((reference.mask & ~predicted.mask).sum()),
            "false": int((predicted.mask & ~reference.mask).sum()),
            "wrong": int((error > wrong).sum()),
        }
        numbers["out_of_steps"] = int((self.rendering.status == Status.OUT_OF_STEPS).sum())
        numbers["pixel_errors"] = numbers["lost"] + numbers["false"] + numbers["wrong"]
        all_errors = torch.cat([error, torch.full((numbers["lost"] + numbers["false"],), torch.inf, dtype=error.dtype)])
        if all_errors.numel():
            numbers["error_p95"] = all_errors.sort().values[ceil(0.95 * len(all_errors)) - 1].item()
        if error.numel():
            middle, high = error.quantile(torch.tensor([0.5, 0.99], dtype=torch.float64)).tolist()
            numbers |= {"depth_error_median": middle, "depth_error_p99": high, "depth_error_max": error.max().item()}
        return numbers

    def negative_fraction(self) -> float:
        """The fraction of negative values among the field evaluations of a rendering."""
        signs = SignCounter(self.decoder.at(self.code.detach()))
        with torch.no_grad():
            render_checked(self.renderer, signs, self.rays)
        return signs.negative / max(signs.evaluated, 1)

    def gradient(self) -> dict[str, float]:
        """The metric `gradient_error`, without limits; empty without weights or common hits."""
        decoder = deepcopy(self.decoder).requires_grad_(True)
        exact, rays = deepcopy(decoder).cpu().double(), self.camera.double().rays()
        rendering = render_checked(self.renderer, decoder.at(self.code.detach()), self.rays)
        both = rendering.hit.cpu() & self.reference.hit
        if not both.any() or not [*decoder.parameters()]:
            return {}
        facing = (self.reference.normals * rays.directions).sum(-1)[both].abs().to(self.rays.directions)
        points, exact_field = rays.at(self.reference.distance)[both], exact.at(self.code.detach().cpu().double())
        moved = (rendering.distance[both.to(self.device)] * facing).cpu().double(), decoder
        reference = exact_field(points) / autograd_gradients(exact_field, points).norm(dim=-1), exact
        squares, generator = torch.zeros(2, dtype=torch.float64), torch.Generator().manual_seed(0)
        for _ in range(GRADIENT_DRAWS):
            signs = torch.randint(0, 2, (len(facing),), generator=generator) * 2.0 - 1
            gradients = [
                torch.autograd.grad(
                    (signs * shifts).sum(), [*net.parameters()], retain_graph=True, materialize_grads=True
                )
                for shifts, net in (moved, reference)
            ]
            renderers, exacts = (torch.cat([g.cpu().double().ravel() for g in each]) for each in gradients)
            squares += torch.stack([(renderers - exacts).square().sum(), exacts.square().sum()])
        return {"gradient_error": float((squares[0] / squares[1]).sqrt())}

    def views(self) -> tuple[View, View]:
        """The rendered view and the reference's, on the CPU; depths in float64, normals in world axes."""
        hit, cosine = self.rendering.hit, self.camera.double().depth(torch.ones_like(self.reference.distance))
        normals = torch.zeros_like(self.rendering.points)
        field, points = self.decoder.at(self.code.detach()), self.rendering.points[hit]
        normals[hit] = autograd_normals(field, points)
        hit, distance = hit.cpu(), self.rendering.distance.cpu().double()
        return (
            View(self.camera, distance * cosine * hit, normals.cpu(), hit),
            View(self.camera, self.reference.distance * cosine, self.reference.normals.float(), self.reference.hit),
        )

    def _step(self, field: Field, rays: Rays, mask: Tensor) -> float:
        """Takes one step, and returns the seconds of its backward pass."""
        rendering = render_checked(self.renderer, field, rays)
        silhouette = silhouette_loss(self.renderer, field, rays, rendering, RayObservation(mask.to(self.device)))
        loss = rendering.distance[rendering.hit].sum() + silhouette
        stopwatch = Stopwatch(self.device)
        torch.autograd.grad(loss, self.code, allow_unused=True)
        return stopwatch.seconds()

    def _clock(self, timings: Timings, name: str, work: Callable[[Field], float], repeats: int) -> None:
        """Times the same work `repeats` times, or until all took a quarter of one repeat's limit of evaluations."""
        evaluations = 0
        for _ in range(repeats):
            timings.counts = Counts()
            field = self.limits.watch(self.decoder.at(self.code), self.device, name)
            stopwatch, cpu_start = Stopwatch(self.device), time.process_time()
            timings.backward_seconds.append(work(Meter(field, timings.counts)))
            timings.seconds.append(stopwatch.seconds())
            timings.cpu_seconds.append(time.process_time() - cpu_start)
            evaluations, memory_rise = evaluations + field.spent, field.memory.repeatable()
            timings.memory = memory_rise if timings.memory is None else max(timings.memory, memory_rise or 0)
            if evaluations >= self.limits.values / 4:
                break
        shape = self.decoder.at(self.code)
        timings.flops, timings.coarse_flops = timings.counts.flops(shape), timings.counts.coarse_flops(shape)
