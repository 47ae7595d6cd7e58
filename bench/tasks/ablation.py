"""The rendering benchmark: a renderer's cost and error on one view of a fitted network (DIST, Table 1).

With `beside`, several renderers are timed in turn in one process: what they cost over the run's own renderer. With
`device=cuda` all seconds are those of the GPU's own events, after a warm-up at full size; not yet run on a GPU. There
are no CUDA graphs, since the shapes of a march change from one rendering to the next.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import ceil
from statistics import median
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from bench.config import load
from bench.evaluate.reference import Reference, reference_for
from bench.machine.environment import Stopwatch, gemm_peak, seconds_at_peak, using_threads
from bench.machine.limits import LimitReached, Limits
from bench.pictures.run_figures import draw_against, save_images
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.observed_view import central_differences
from bench.solve.solve import check_field_gradient, evaluation_counts
from datasets.scene import View
from renderers.boundary import rendered, silhouette_loss
from renderers.camera import Camera, Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Bounds, Coarse, Counts, Field, Meter, Wrapper, autograd_normals, bounds_of, coarse_of
from renderers.rendering import Observed, Renderer, Rendering, check_kind
from renderers.waits import active_among

BASE = "base"  # the run's renderer, where others are timed beside it
SMALLER = 8  # factor by which the side of the image shrinks where a limit was reached
WARM_UP = 8  # pixels per side of the image that is rendered before the timing, on a CPU
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
    "evaluations.per_ray": "queries divided by rays",
    "evaluations.work_over_bound": "the operations of a step, divided by those of one value and one gradient per hit; "
    "absent without hits",
    "seconds.total": "the whole run, with making or loading shape, network and reference",
    "forward_gemm, step_gemm": "seconds that the floating-point operations take at the machine's peak rate of a matrix "
    "product, in float32 or, of coarse values, in bfloat16, over the median time",
    "peak_memory_bytes": "highest rise of PyTorch's memory on a GPU, in a step; of no CPU, where it does not repeat",
    "lost, false": "missed pixels, which only the float64 reference hits; spurious ones, which only the renderer hits",
    "behind": "share of the field values, coarse ones too, of one more rendering, untimed, that are negative: samples "
    "behind the surface (DIST, Fig. 14)",
    "pixel_errors": "lost, false and wrong together; at the start: hits, those of an image in which nothing is hit",
    "cost": "of one rendering, in field values: a coarse one counts as an eighth",
    "rays, hits": "pixels of the image; pixels that the reference hits",
    "wrong": "pixels that both hit, at depths that differ by more than task.wrong",
    "error_p95": "95th percentile of the difference of depth over the pixels that either hits, where a pixel that only "
    "one of them hits counts as infinite; in scene units",
    "depth_error": "median, 99th percentile and largest difference of depth over pixels that both hit, in scene units",
}
IN_TURN = {
    "rounds": "how often each renderer was timed, in turn, each round in the opposite order of the last one",
    "forward_cpu, step_cpu": "seconds of all threads together: median over rounds",
    "forward_ratio, step_ratio, forward_cpu_ratio, step_cpu_ratio": "over the first renderer's of the same round: "
    "median; _low and _high: least and largest",
    "work_over_bound": "the operations of a step, divided by those of one value and one gradient per hit",
}


@dataclass(frozen=True)
class Ablation:
    """Renders a training shape of the prior, forward and backward, and compares it with the reference.

    Where a limit is reached at the requested resolution, the run's status says so, and an eighth of the side is tried
    next, until the measurement finishes or the side is below `smallest`.

    Args:
        repeats: timed repeats of the renderer alone; fewer where they take more than a quarter of the limit together,
            one at smaller sizes.
        limits: on each rendering and each step.
        smallest: fewest pixels per side that are tried.
        wrong: difference of depth, in scene units, above which a pixel is wrong.
        beside: names of other renderers that are timed in turn with the run's own.
        rounds: of these, in each of which every renderer takes one step and renders once.
        size: of the image, in pixels per side; None: as `view` has it.
        threads: of the CPU; None: those of the run.
        normal_width: of the differences that give the normals of pictures (DIST, Eq. 3: 2 delta), in scene units; None:
            the field's gradients.
    """

    repeats: int
    limits: Limits
    smallest: int
    wrong: float
    beside: list[str] = field(default_factory=list)
    rounds: int = 1
    size: int | None = None
    threads: int | None = None
    normal_width: float | None = None

    def __post_init__(self) -> None:
        check_at_least("task.repeats", self.repeats, 1, "3 show the spread")
        check_at_least("task.smallest", self.smallest, 1, "8 always finishes")
        check_positive("task.wrong", self.wrong, "0.02 is 1 % of the unit sphere")
        check_at_least("task.rounds", self.rounds, 1, "5 show the spread")
        if self.size is not None:
            check_at_least("task.size", self.size, 8, "128 is quick")
        if self.threads is not None:
            check_at_least("task.threads", self.threads, 1, "1 is steadiest")
        if self.normal_width is not None:
            check_positive("task.normal_width", self.normal_width, "0.01 shows the shape; null takes gradients")

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput without a network that was fitted to the scene's shape."""
        inputs.check_fitted()

    def execute(self, run: RunContext) -> None:
        """Measures costs and errors, and writes them to the record, images.npz and a picture."""
        run.record.definitions = DEFINITIONS | (IN_TURN if self.beside else {})
        if self.normal_width is not None:
            note = f"normals of pictures are differences over {self.normal_width:g} scene units (DIST, Eq. 3)"
            run.record.notes = [*run.record.notes, note]
        with using_threads(self.threads or torch.get_num_threads()):
            self._measure(run)

    def _measure(self, run: RunContext) -> None:
        """Measures at the requested resolution, else at the first smaller one at which no limit is reached."""
        record, requested = run.record, run.inputs.scene.view.camera
        requested = requested.resized(self.size, self.size) if self.size else requested
        camera, measured = requested, None
        failure: tuple[RunStatus, str] | None = None
        while measured is None:
            try:
                measured = self._timed(run, camera, repeats=1 if failure else self.repeats)
            except LimitReached as limit:
                failure = failure or (limit.status, str(limit))  # not the exception, which keeps all tensors alive
                smaller = camera.height // SMALLER, camera.width // SMALLER
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
            LimitReached: where a rendering or a step exceeds a limit.
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
            benches[BASE].steps(repeats)  # first: it costs more, and where it exceeds a limit the rest would be wasted
            run.progress(f"timing renderings at {size}", 0, 1)
            benches[BASE].renderings(repeats)
            return benches
        for done in range(self.rounds):
            run.progress("timing renderers in turn", done, self.rounds)
            for name in list(benches)[:: -1 if done % 2 else 1]:
                of = "" if name == BASE else f" of {name}"
                benches[name].renderings(1, of)
                benches[name].steps(1, of)
        return benches

    def _note(self, run: RunContext, benches: "dict[str, Workbench]") -> None:
        record, bench = run.record, benches[BASE]
        machine, again = record.environment, gemm_peak(bench.device)  # measured close to the times
        machine["gemm_peak_flops"] = max(machine["gemm_peak_flops"], again)
        numbers = {
            name: costs(one.forward, one.step, machine) | one.errors(self.wrong) | {"behind": one.behind()}
            for name, one in benches.items()
        }
        record.metrics = {"size": bench.camera.height, **numbers[BASE], "cost": bench.forward.counts.cost}
        record.metrics_start = {"pixel_errors": record.metrics["hits"]}
        record.seconds |= {name: record.metrics[f"{name}_seconds"] for name in ("forward", "backward")}
        record.evaluations = evaluation_counts(bench.step.counts, bench.decoder.at(bench.code))
        record.evaluations["per_ray"] = bench.forward.counts.value / bench.rays.shape.numel()
        record.peak_memory_bytes = bench.step.memory
        if self.beside:
            record.metrics = {"size": bench.camera.height, "rounds": self.rounds}
            for name, one in benches.items():
                found = numbers[name] | ratios(one.forward, bench.forward, "forward")
                found |= ratios(one.step, bench.step, "step")
                if (over := one.step.counts.over_bound(one.decoder.at(one.code))) is not None:
                    found["work_over_bound"] = over
                record.metrics |= {f"{name}.{key}": number for key, number in found.items()}
        found, true = bench.views(self.normal_width)
        save_images(run.folder, found, true)
        draw_against(run.folder / "summary.png", found, true, title=f"{record.name}, {record.scene}: {record.status}")


@dataclass
class Clocked:
    """The costs of repeats of the same work.

    Args:
        seconds: of each.
        second: of the second part of each, the backward pass.
        cpu: seconds of all threads together.
        counts: of the last one.
        memory: bytes by which the largest rose.
        flops, coarse_flops: operations of the last one, those in bfloat16 apart; None where they are not stated.
    """

    seconds: list[float] = field(default_factory=list)
    second: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    counts: Counts = field(default_factory=Counts)
    memory: int | None = None
    flops: int | None = None
    coarse_flops: int = 0


def costs(forward: Clocked, step: Clocked, machine: dict[str, Any]) -> dict[str, float]:
    """The costs of renderings and steps by their names in DEFINITIONS; `machine` has its peak rates."""
    found: dict[str, float] = {
        "queries": forward.counts.value,
        "coarse_queries": forward.counts.coarse,
        "step_queries": step.counts.value,
        "step_coarse_queries": step.counts.coarse,
        "step_gradients": step.counts.gradient,
        "repeats": len(step.seconds),
    }
    for name, seconds in (("forward", forward.seconds), ("step", step.seconds), ("backward", step.second)):
        found |= {f"{name}_seconds": median(seconds), f"{name}_seconds_low": min(seconds)}
        found[f"{name}_seconds_high"] = max(seconds)
    for name, clocked in (("forward", forward), ("step", step)):
        if clocked.flops is not None:
            at_peak = seconds_at_peak(machine, clocked.flops, clocked.coarse_flops)
            found[f"{name}_gemm"] = at_peak / median(clocked.seconds)
    if step.memory is not None:
        found["peak_memory_bytes"] = step.memory
    return found


def ratios(mine: Clocked, base: Clocked, name: str) -> dict[str, float]:
    """The costs of one rendering or step in each round, over the first renderer's in the same round."""
    found = {f"{name}_cpu": median(mine.cpu)}
    for of, times, others in ((name, mine.seconds, base.seconds), (f"{name}_cpu", mine.cpu, base.cpu)):
        over = [one / other for one, other in zip(times, others, strict=True)]
        found |= {f"{of}_ratio": median(over), f"{of}_ratio_low": min(over), f"{of}_ratio_high": max(over)}
    return found


@dataclass
class Signs(Wrapper):
    """A Field that counts its values that are asked for, coarse ones too, and the negative ones among them."""

    inner: Field
    asked: int = 0
    negative: int = 0

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self._noted(self.inner(points))

    def _noted(self, values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        flat, active = values.flatten(), active_among(values.numel())
        asked = flat if active is None else flat[active]
        self.asked += asked.numel()
        self.negative += int((asked < 0).sum())
        return values

    @property
    def coarse(self) -> Coarse | None:
        offered = coarse_of(self.inner)
        return offered and replace(offered, values=lambda points: self._noted(offered.values(points)))

    @property
    def bounds(self) -> Bounds | None:
        return bounds_of(self.inner)


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
        self.forward, self.step = Clocked(), Clocked()
        check_kind(self.renderer, self.decoder.at(self.code))
        check_field_gradient(self.renderer)
        field = self.decoder.at(self.code)
        if self.device.type == "cpu":
            small = camera.resized(WARM_UP, WARM_UP)
            self._step(field, small.rays(), torch.ones(WARM_UP, WARM_UP).bool())
        else:  # which loads kernels and takes memory by the size of the work
            self._step(limits.watch(field, self.device, "a step"), self.rays, self.mask)

    def renderings(self, repeats: int, of: str = "") -> None:
        """Times renderings without gradient; `of` names the renderer where a limit is reached."""

        def work(field: Field) -> float:
            with torch.no_grad():
                self.rendering = rendered(self.renderer, field, self.rays)
            return 0.0

        self._clock(self.forward, f"a rendering{of}", work, repeats)

    def steps(self, repeats: int, of: str = "") -> None:
        """Times steps of an optimisation of the code."""
        self._clock(self.step, f"a step{of}", lambda field: self._step(field, self.rays, self.mask), repeats)

    def errors(self, wrong: float) -> dict[str, float]:
        """The errors of the rendering against the reference, by their names in DEFINITIONS."""
        found, true = self.views()
        error = (found.depth - true.depth).abs()[found.mask & true.mask].double()
        numbers = {
            "rays": found.mask.numel(),
            "hits": int(true.mask.sum()),
            "lost": int((true.mask & ~found.mask).sum()),
            "false": int((found.mask & ~true.mask).sum()),
            "wrong": int((error > wrong).sum()),
        }
        numbers["pixel_errors"] = numbers["lost"] + numbers["false"] + numbers["wrong"]
        beyond = torch.cat([error, torch.full((numbers["lost"] + numbers["false"],), torch.inf, dtype=error.dtype)])
        if beyond.numel():
            numbers["error_p95"] = beyond.sort().values[ceil(0.95 * len(beyond)) - 1].item()
        if error.numel():
            middle, high = error.quantile(torch.tensor([0.5, 0.99], dtype=torch.float64)).tolist()
            numbers |= {"depth_error_median": middle, "depth_error_p99": high, "depth_error_max": error.max().item()}
        return numbers

    def behind(self) -> float:
        """The share of the values of a rendering that are negative."""
        signs = Signs(self.decoder.at(self.code.detach()))
        with torch.no_grad():
            rendered(self.renderer, signs, self.rays)
        return signs.negative / max(signs.asked, 1)

    def views(self, normal_width: float | None = None) -> tuple[View, View]:
        """The rendered view and the reference's, on the CPU; depths in float64, normals in world axes.

        Args:
            normal_width: see `Ablation`; the reference's normals are always gradients.
        """
        assert self.rendering is not None
        hit, cosine = self.rendering.hit, self.camera.double().depth(torch.ones_like(self.reference.distance))
        normals = torch.zeros_like(self.rendering.points)
        field, points = self.decoder.at(self.code.detach()), self.rendering.points[hit]
        if normal_width is None:
            normals[hit] = autograd_normals(field, points)
        else:
            normals[hit] = torch.nn.functional.normalize(central_differences(field, points, normal_width), dim=-1)
        hit, distance = hit.cpu(), self.rendering.distance.cpu().double()
        return (
            View(self.camera, distance * cosine * hit, normals.cpu(), hit),
            View(self.camera, self.reference.distance * cosine, self.reference.normals.float(), self.reference.hit),
        )

    def _step(self, field: Field, rays: Rays, mask: Tensor) -> float:
        """Takes one step and gives the seconds of its backward pass."""
        rendering = rendered(self.renderer, field, rays)
        silhouette = silhouette_loss(self.renderer, field, rays, rendering, Observed(mask.to(self.device)))
        loss = rendering.distance[rendering.hit].sum() + silhouette
        stopwatch = Stopwatch(self.device)
        torch.autograd.grad(loss, self.code, allow_unused=True)
        return stopwatch.seconds()

    def _clock(self, clocked: Clocked, name: str, work: Callable[[Field], float], repeats: int) -> None:
        """Times the same work `repeats` times, or until all took a quarter of the values that one may take."""
        spent = 0
        for _ in range(repeats):
            clocked.counts = Counts()
            field = self.limits.watch(self.decoder.at(self.code), self.device, name)
            stopwatch, ran = Stopwatch(self.device), time.process_time()
            clocked.second.append(work(Meter(field, clocked.counts)))
            clocked.seconds.append(stopwatch.seconds())
            clocked.cpu.append(time.process_time() - ran)
            spent, grew = spent + field.spent, field.memory.repeatable()
            clocked.memory = grew if clocked.memory is None else max(clocked.memory, grew or 0)
            if spent >= self.limits.values / 4:
                break
        shape = self.decoder.at(self.code)
        clocked.flops, clocked.coarse_flops = clocked.counts.flops(shape), clocked.counts.coarse_flops(shape)
