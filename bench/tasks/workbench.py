"""A renderer on one view of a fitted network, timed under limits and compared with the reference."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil

import torch
from torch import Tensor

from bench.evaluate.reference import Reference
from bench.machine.environment import synchronise
from bench.machine.limits import Limits
from bench.setup.inputs import RunInputs
from bench.solve.problem import check_field_gradient, check_kind
from datasets.scene import View
from renderers.boundary import rendered, silhouette_loss
from renderers.camera import Camera, Rays
from renderers.field import Counts, Field, Meter, autograd_normals
from renderers.rendering import Observed, Renderer, Rendering

WARM_UP = 8  # pixels per side of the image that is rendered before the timing

DEFINITIONS = {
    "queries": "points whose field value was computed in one rendering without gradient; counted at the field",
    "coarse_queries, step_coarse_queries": "beside these, points whose value was computed more cheaply, in bfloat16, "
    "where it decides nothing; in a rendering, and in a step",
    "peak_memory_bytes": "largest growth of the process's resident memory (CPU) or of PyTorch's (GPU) in a step",
    "lost, false": "missed pixels, which only the float64 reference hits; spurious ones, which only the renderer hits",
    "rays, hits": "pixels of the image; pixels that the reference hits",
    "wrong": "pixels that both hit, at depths that differ by more than task.wrong",
    "error_p95": "95th percentile of the difference of depth over the pixels that either hits, where a pixel that only "
    "one of them hits counts as infinite; in scene units",
    "depth_error": "median, 99th percentile and largest difference of depth over pixels that both hit, in scene units",
}


@dataclass(frozen=True)
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

    seconds: list[float]
    second: list[float]
    cpu: list[float]
    counts: Counts
    memory: int | None
    flops: int | None
    coarse_flops: int = 0


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
        check_kind(self.renderer, self.decoder.at(self.code))
        check_field_gradient(self.renderer)
        small = camera.resized(WARM_UP, WARM_UP)
        self._step(self.decoder.at(self.code), small.rays().to(self.device), torch.ones(WARM_UP, WARM_UP).bool())

    def forward(self, repeats: int) -> Clocked:
        """Times renderings without gradient."""

        def work(field: Field) -> float:
            with torch.no_grad():
                self.rendering = rendered(self.renderer, field, self.rays)
            return 0.0

        return self._clock("a rendering", work, repeats)

    def steps(self, repeats: int) -> Clocked:
        """Times steps of an optimisation of the code."""
        return self._clock("a step", lambda field: self._step(field, self.rays, self.mask), repeats)

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
        beyond = torch.cat([error, torch.full((numbers["lost"] + numbers["false"],), torch.inf, dtype=error.dtype)])
        if beyond.numel():
            numbers["error_p95"] = beyond.sort().values[ceil(0.95 * len(beyond)) - 1].item()
        if error.numel():
            middle, high = error.quantile(torch.tensor([0.5, 0.99], dtype=torch.float64)).tolist()
            numbers |= {"depth_error_median": middle, "depth_error_p99": high, "depth_error_max": error.max().item()}
        return numbers

    def views(self) -> tuple[View, View]:
        """The rendered view and the reference's, on the CPU; depths in float64, normals in world axes."""
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
        """Takes one step and gives the seconds of its backward pass."""
        rendering = rendered(self.renderer, field, rays)
        silhouette = silhouette_loss(self.renderer, field, rays, rendering, Observed(mask.to(self.device)))
        loss = rendering.distance[rendering.hit].sum() + silhouette
        synchronise(self.device)
        start = time.perf_counter()
        torch.autograd.grad(loss, self.code, allow_unused=True)
        synchronise(self.device)
        return time.perf_counter() - start

    def _clock(self, name: str, work: Callable[[Field], float], repeats: int) -> Clocked:
        """Times the same work `repeats` times, or until all took a quarter of the values that one may take."""
        seconds: list[float] = []
        second: list[float] = []
        cpu: list[float] = []
        counts, memory, spent = Counts(), None, 0
        while len(seconds) < repeats and spent < self.limits.values / 4:
            counts = Counts()
            field = self.limits.watch(self.decoder.at(self.code), self.device, name)
            synchronise(self.device)
            start, ran = time.perf_counter(), time.process_time()
            second.append(work(Meter(field, counts)))
            synchronise(self.device)
            seconds.append(time.perf_counter() - start)
            cpu.append(time.process_time() - ran)
            spent += field.spent
            memory = field.memory.growth() if memory is None else max(memory, field.memory.growth() or 0)
        shape = self.decoder.at(self.code)
        return Clocked(seconds, second, cpu, counts, memory, counts.flops(shape), counts.coarse_flops(shape))
