"""The rendering benchmark: a renderer's cost and error on one view of a fitted network (DIST, Table 1)."""

from dataclasses import dataclass
from statistics import median
from typing import Any

from bench.evaluate.reference import reference_for
from bench.machine.environment import gemm_peak, seconds_at_peak
from bench.machine.limits import LimitReached, Limits
from bench.pictures.run_figures import draw_against, save_images
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import counted
from bench.tasks import workbench
from bench.tasks.workbench import Clocked, Workbench
from renderers.camera import Camera
from renderers.checks import check_at_least, check_positive

SMALLER = 8  # factor by which the side of the image shrinks where a limit was reached

DEFINITIONS = {
    "size": "pixels per side of the image for which the other numbers were measured",
    "step_queries, step_gradients": "points whose value was computed in a step, and points through whose value a "
    "non-zero gradient was propagated back",
    "forward_seconds": "rendering without gradient: median of the repeats; _low and _high: least and largest",
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
    **workbench.DEFINITIONS,
}


@dataclass(frozen=True)
class Ablation:
    """Renders a training shape of the prior, forward and backward, and compares it with the reference.

    Where a limit is reached at the requested resolution, the run's status says so, and an eighth of the side is tried
    next, until the measurement finishes or the side is below `smallest`.

    Args:
        repeats: timed repeats; fewer where they take more than a quarter of the limit together, one at smaller sizes.
        limits: on each rendering and each step.
        smallest: fewest pixels per side that are tried.
        wrong: difference of depth, in scene units, above which a pixel is wrong.
    """

    repeats: int
    limits: Limits
    smallest: int
    wrong: float

    def __post_init__(self) -> None:
        check_at_least("task.repeats", self.repeats, 1, "3 show the spread")
        check_at_least("task.smallest", self.smallest, 1, "8 always finishes")
        check_positive("task.wrong", self.wrong, "0.02 is 1 % of the unit sphere")

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput without a network that was fitted to the scene's shape."""
        inputs.check_fitted()

    def execute(self, run: RunContext) -> None:
        """Measures costs and errors, and writes them to the record, images.npz and a picture."""
        inputs, record = run.inputs, run.record
        record.definitions = DEFINITIONS
        requested = inputs.scene.view.camera
        camera, measured = requested, None
        failure: tuple[RunStatus, str] | None = None
        while measured is None:
            try:
                measured = self._measure(run, camera, repeats=1 if failure else self.repeats)
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

    def _measure(self, run: RunContext, camera: Camera, *, repeats: int) -> "Measured":
        """Measures everything at one resolution.

        Raises:
            LimitReached: where a rendering or a step exceeds a limit.
        """
        inputs, size = run.inputs, f"{camera.height} x {camera.width}"
        fitted = inputs.fitted()
        run.progress(f"making the reference at {size}", 0, 1)
        reference = reference_for(fitted, camera, inputs.cache)
        bench = Workbench(inputs, inputs.renderer, camera, reference, self.limits)
        run.progress(f"timing steps at {size}", 0, 1)
        step = bench.steps(repeats)  # first: it costs more, and where it exceeds a limit the rest would be wasted
        run.progress(f"timing renderings at {size}", 0, 1)
        return Measured(bench, bench.forward(repeats), step)

    def _note(self, run: RunContext, measured: "Measured") -> None:
        record, bench = run.record, measured.bench
        machine, again = record.environment, gemm_peak(bench.device)  # measured close to the times
        machine["gemm_peak_flops"] = max(machine["gemm_peak_flops"], again)
        record.metrics = {"size": bench.camera.height, **measured.costs(machine), **bench.errors(self.wrong)}
        record.seconds |= {name: record.metrics[f"{name}_seconds"] for name in ("forward", "backward")}
        record.evaluations = counted(measured.step.counts, bench.decoder.at(bench.code))
        record.evaluations["per_ray"] = measured.forward.counts.value / bench.rays.shape.numel()
        record.peak_memory_bytes = measured.step.memory
        found, true = bench.views()
        save_images(run.folder, found, true)
        draw_against(run.folder / "summary.png", found, true, title=f"{record.name}, {record.scene}: {record.status}")


@dataclass(frozen=True)
class Measured:
    """The measurements at one resolution."""

    bench: Workbench
    forward: Clocked
    step: Clocked

    def costs(self, machine: dict[str, Any]) -> dict[str, float]:
        """The costs by their names in DEFINITIONS; `machine` has its peak rates."""
        times = {"forward": self.forward.seconds, "step": self.step.seconds, "backward": self.step.second}
        costs: dict[str, float] = {
            "queries": self.forward.counts.value,
            "coarse_queries": self.forward.counts.coarse,
            "step_queries": self.step.counts.value,
            "step_coarse_queries": self.step.counts.coarse,
            "step_gradients": self.step.counts.gradient,
            "repeats": len(self.step.seconds),
        }
        for name, seconds in times.items():
            costs |= {f"{name}_seconds": median(seconds), f"{name}_seconds_low": min(seconds)}
            costs[f"{name}_seconds_high"] = max(seconds)
        for name, clocked in (("forward", self.forward), ("step", self.step)):
            if clocked.flops is not None:
                at_peak = seconds_at_peak(machine, clocked.flops, clocked.coarse_flops)
                costs[f"{name}_gemm"] = at_peak / median(clocked.seconds)
        if self.step.memory is not None:
            costs["peak_memory_bytes"] = self.step.memory
        return costs
