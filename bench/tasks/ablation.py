"""What a renderer costs on one view of a fitted network, and how far it is from the reference (DIST, Table 1)."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from statistics import median

import torch
from torch import Tensor

from bench.environment import gemm_peak, synchronise
from bench.images import save_images
from bench.limits import LimitReached, Limits
from bench.pictures import draw_against
from bench.records import RunStatus
from bench.reference_store import Reference, reference_for
from bench.stage import Cell, Stage
from bench.tasks.problem import check_field_gradient, check_kind
from datasets.scene import View
from renderers.camera import Camera, Rays
from renderers.checks import check_at_least, check_positive
from renderers.field import Counts, Field, Meter, autograd_normals
from renderers.rendering import Rendering

SMALLER = 8  # times: the side of an image that takes too much, over that of the next one tried
WARM_UP = 8  # pixels a side of the image that is rendered before the clock

DEFINITIONS = {
    "size": "pixels a side of the image that the other numbers are of",
    "queries": "points whose field value was computed while rendering forward, without gradient; counted at the field",
    "step_queries, step_gradients": "points whose value was computed, and through whose value a gradient other than "
    "zero was propagated back, in a step",
    "forward_seconds": "rendering without gradient; median of the repeats, least (_low) and largest (_high) beside it",
    "step_seconds": "a step of an optimisation: rendering with gradient, losses, backward",
    "backward_seconds": "the backward pass of a step",
    "repeats": "how often a step was timed",
    "evaluations.value, evaluations.gradient": "as step_queries and step_gradients",
    "evaluations.per_ray": "queries divided by rays",
    "seconds.total": "the whole run, with shape, network and reference made or loaded",
    "forward_gemm, step_gemm": "floating-point operations over the median time, divided by the machine's best rate of "
    "a float32 matrix product",
    "peak_memory_bytes": "highest rise of the process's resident memory (CPU) or of PyTorch's (GPU) in a step",
    "lost, false": "pixels that the float64 reference hits and the renderer does not, and the other way round",
    "rays, hits": "pixels of that image; those that the reference hits",
    "wrong": "pixels that both hit at depths further apart than task.wrong",
    "error_p95": "difference of depth that 95 % of the pixels that either hits do not exceed, where a pixel that only "
    "one of them hits counts as infinite; in scene units",
    "depth_error": "median, 99th percentile and largest difference of depth over pixels that both hit, in scene units",
}


@dataclass(frozen=True)
class Ablation:
    """Renders a shape that the prior was trained on, forward and back, and compares it with the reference.

    Where a limit is reached at the asked resolution, the run's status says so, and the numbers are those of an image of
    an eighth of the side, and so on.

    Args:
        repeats: of the clock; fewer where they come to a quarter of the limit together, one at a smaller size.
        limits: on each rendering and each step.
        smallest: pixels a side below which no more is tried.
        wrong: difference of depth, in scene units, from which on a pixel is wrong.
    """

    repeats: int
    limits: Limits
    smallest: int
    wrong: float

    def __post_init__(self) -> None:
        check_at_least("task.repeats", self.repeats, 1, "3 show the spread")
        check_at_least("task.smallest", self.smallest, 1, "8 always finishes")
        check_positive("task.wrong", self.wrong, "0.02 is 1 % of the unit sphere")

    def execute(self, cell: Cell) -> None:
        """Measures, and fills the record, images.npz and a picture."""
        stage, record = cell.stage, cell.record
        record.definitions = DEFINITIONS
        asked = stage.scene.view.camera
        camera, measured = asked, None
        failure: tuple[RunStatus, str] | None = None
        while measured is None:
            try:
                measured = self._measure(stage, camera, repeats=1 if failure else self.repeats)
            except LimitReached as limit:
                failure = failure or (limit.status, str(limit))  # not itself: it holds on to all that was computed
                smaller = camera.height // SMALLER, camera.width // SMALLER
                if min(smaller) < self.smallest:
                    break
                camera = camera.resized(*smaller)
        record.status, record.reason = RunStatus.OK, ""
        if failure is not None:
            end = "at no smaller size" if measured is None else f"at {camera.height} x {camera.width}"
            record.status = failure[0]
            record.reason = f"{failure[1]} at {asked.height} x {asked.width}; it finishes {end}"
        if measured is not None:
            self._note(cell, measured)

    def _measure(self, stage: Stage, camera: Camera, *, repeats: int) -> "Measured":
        """All numbers of one resolution.

        Raises:
            LimitReached: where a rendering or a step takes more than it may.
        """
        bench = Workbench(stage, camera, reference_for(stage.fitted(), camera, stage.cache), self.limits)
        step = bench.steps(repeats)  # first, since it takes more, and where it takes too much the rest is in vain
        return Measured(bench, bench.forward(repeats), step)

    def _note(self, cell: Cell, measured: "Measured") -> None:
        record, bench = cell.record, measured.bench
        peak = max(record.environment["gemm_peak_flops"], gemm_peak(bench.device))  # beside what is compared with it
        record.environment["gemm_peak_flops"] = peak
        record.metrics = {"size": bench.camera.height, **measured.costs(peak), **bench.errors(self.wrong)}
        record.seconds |= {name: record.metrics[f"{name}_seconds"] for name in ("forward", "backward")}
        record.evaluations = {"value": measured.step.counts.value, "gradient": measured.step.counts.gradient}
        record.evaluations["per_ray"] = measured.forward.counts.value / bench.rays.shape.numel()
        record.peak_memory_bytes = measured.step.memory
        found, true = bench.views()
        save_images(cell.folder, found, true)
        draw_against(cell.folder / "summary.png", found, true, title=f"{record.name}, {record.scene}: {record.status}")


@dataclass(frozen=True)
class Clocked:
    """What some repeats of the same work took; `second` is a part of it that was timed apart."""

    seconds: list[float]
    second: list[float]
    counts: Counts
    memory: int | None
    flops: int | None


@dataclass(frozen=True)
class Measured:
    """What was measured at one resolution."""

    bench: "Workbench"
    forward: Clocked
    step: Clocked

    def costs(self, peak: float) -> dict[str, float]:
        """The numbers that say what it costs, by their names in DEFINITIONS; `peak` is the machine's best rate."""
        times = {"forward": self.forward.seconds, "step": self.step.seconds, "backward": self.step.second}
        costs: dict[str, float] = {
            "queries": self.forward.counts.value,
            "step_queries": self.step.counts.value,
            "step_gradients": self.step.counts.gradient,
            "repeats": len(self.step.seconds),
        }
        for name, seconds in times.items():
            costs |= {f"{name}_seconds": median(seconds), f"{name}_seconds_low": min(seconds)}
            costs[f"{name}_seconds_high"] = max(seconds)
        for name, clocked in (("forward", self.forward), ("step", self.step)):
            if clocked.flops is not None:
                costs[f"{name}_gemm"] = clocked.flops / median(clocked.seconds) / peak
        if self.step.memory is not None:
            costs["peak_memory_bytes"] = self.step.memory
        return costs


class Workbench:
    """A renderer before one view of a network, with the limits and the clock about it."""

    def __init__(self, stage: Stage, camera: Camera, reference: Reference, limits: Limits) -> None:
        prior, self.device = stage.fitted(), stage.device
        self.decoder = prior.decoder.to(self.device).requires_grad_(False)
        self.code = prior.codes[0].detach().clone().to(self.device).requires_grad_(True)
        self.renderer, self.camera, self.reference, self.limits = stage.renderer, camera, reference, limits
        self.rays = camera.rays().to(self.device)
        self.mask = reference.hit.to(self.device)
        self.rendering: Rendering | None = None
        check_kind(self.renderer, self.decoder.at(self.code))
        check_field_gradient(self.renderer)
        small = camera.resized(WARM_UP, WARM_UP)
        self._step(self.decoder.at(self.code), small.rays().to(self.device), torch.ones(WARM_UP, WARM_UP).bool())

    def forward(self, repeats: int) -> Clocked:
        """Renderings without gradient."""

        def work(field: Field) -> float:
            with torch.no_grad():
                self.rendering = self.renderer.render(field, self.rays)
            return 0.0

        return self._clock(work, repeats)

    def steps(self, repeats: int) -> Clocked:
        """Steps of an optimisation of the code."""
        return self._clock(lambda field: self._step(field, self.rays, self.mask), repeats)

    def errors(self, wrong: float) -> dict[str, float]:
        """The rendering against the reference, by the names in DEFINITIONS."""
        found, true = self.views()
        error = (found.depth - true.depth).abs()[found.mask & true.mask].double()
        numbers = {
            "rays": found.mask.numel(),
            "hits": int(true.mask.sum()),
            "lost": int((true.mask & ~found.mask).sum()),
            "false": int((found.mask & ~true.mask).sum()),
            "wrong": int((error > wrong).sum()),
        }
        beyond = torch.cat([error, torch.full((numbers["lost"] + numbers["false"],), torch.inf, dtype=error.dtype)])
        if beyond.numel():
            numbers["error_p95"] = beyond.sort().values[ceil(0.95 * len(beyond)) - 1].item()
        if error.numel():
            middle, high = error.quantile(torch.tensor([0.5, 0.99], dtype=torch.float64)).tolist()
            numbers |= {"depth_error_median": middle, "depth_error_p99": high, "depth_error_max": error.max().item()}
        return numbers

    def views(self) -> tuple[View, View]:
        """What was rendered, and the reference, on the CPU; depths in float64, normals in world axes."""
        assert self.rendering is not None
        hit, cosine = self.rendering.hit, self.camera.double().depth(torch.ones_like(self.reference.distance))
        normals = torch.zeros_like(self.rendering.points)
        normals[hit] = autograd_normals(self.decoder.at(self.code.detach()), self.rendering.points[hit])
        hit, distance = hit.cpu(), self.rendering.distance.cpu().double()
        return (
            View(self.camera, distance * cosine * hit, normals.cpu(), hit),
            View(self.camera, self.reference.distance * cosine, self.reference.normals.float(), self.reference.hit),
        )

    def _step(self, field: Field, rays: Rays, mask: Tensor) -> float:
        """One step; the seconds of its backward pass."""
        rendering = self.renderer.render(field, rays)
        silhouette = self.renderer.silhouette_loss(field, rays, rendering, mask.to(self.device))
        loss = rendering.distance[rendering.hit].sum() + silhouette
        synchronise(self.device)
        start = time.perf_counter()
        torch.autograd.grad(loss, self.code, allow_unused=True)
        synchronise(self.device)
        return time.perf_counter() - start

    def _clock(self, work: Callable[[Field], float], repeats: int) -> Clocked:
        """Does the same work until it was done often enough, or a quarter of the limit of one is spent on all."""
        seconds: list[float] = []
        second: list[float] = []
        counts, memory = Counts(), None
        while len(seconds) < repeats and (not seconds or sum(seconds) < self.limits.seconds / 4):
            counts = Counts()
            field = self.limits.watch(self.decoder.at(self.code), self.device)
            synchronise(self.device)
            start = time.perf_counter()
            second.append(work(Meter(field, counts)))
            synchronise(self.device)
            seconds.append(time.perf_counter() - start)
            memory = field.memory.growth() if memory is None else max(memory, field.memory.growth() or 0)
        return Clocked(seconds, second, counts, memory, counts.flops(self.decoder.at(self.code)))
