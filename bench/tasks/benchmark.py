"""Renderers timed in turn in one process: what their renderings and steps cost over those of the run's own renderer."""

from dataclasses import dataclass
from statistics import median

from bench.config import load
from bench.evaluate.reference import reference_for
from bench.machine.environment import using_threads
from bench.machine.limits import LimitReached, Limits
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext, RunInputs
from bench.tasks import workbench
from bench.tasks.workbench import Clocked, Workbench
from renderers.checks import check_at_least, check_positive

BASE = "base"  # the run's renderer among the numbers of the record
DEFINITIONS = {
    "rounds": "how often each renderer was timed, in turn, each round in the opposite order of the last one",
    "forward_seconds, step_seconds": "a rendering without gradient; a step of an optimisation: rendering, losses, "
    "backward pass: median over rounds",
    "forward_cpu, step_cpu": "the same in seconds of all threads together",
    "forward_ratio, step_ratio, forward_cpu_ratio, step_cpu_ratio": "over the first renderer's of the same round: "
    "median; _low and _high: least and largest",
    "work_over_bound": "the operations of a step, divided by those of one value and one gradient per hit",
    **workbench.DEFINITIONS,
}


@dataclass(frozen=True)
class Benchmark:
    """Times the run's renderer and others on one view of the prior's network.

    Args:
        beside: names of the other renderers, files of conf/renderer.
        size: of the image, in pixels per side.
        threads: of the CPU.
        rounds: in each of which every renderer takes one step and renders once.
        limits: on each rendering and each step.
        wrong: difference of depth, in scene units, above which a pixel is wrong.
    """

    beside: list[str]
    size: int
    threads: int
    rounds: int
    limits: Limits
    wrong: float

    def __post_init__(self) -> None:
        check_at_least("task.size", self.size, 8, "128 is quick")
        check_at_least("task.threads", self.threads, 1, "1 is steadiest")
        check_at_least("task.rounds", self.rounds, 1, "5 show the spread")
        check_positive("task.wrong", self.wrong, "0.02 is 1 % of the unit sphere")

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput without a network that was fitted to the scene's shape."""
        inputs.check_fitted()

    def execute(self, run: RunContext) -> None:
        """Writes the costs and errors of all renderers to the record, each under its name."""
        run.record.definitions = DEFINITIONS
        with using_threads(self.threads):
            self._measure(run)

    def _measure(self, run: RunContext) -> None:
        inputs, record = run.inputs, run.record
        camera = inputs.scene.view.camera.resized(self.size, self.size)
        run.progress("making the reference", 0, 1)
        reference = reference_for(inputs.fitted(), camera, inputs.cache)
        renderers = {BASE: inputs.renderer} | {name: load("renderer", name) for name in self.beside}
        benches = {name: Workbench(inputs, r, camera, reference, self.limits) for name, r in renderers.items()}
        clocked: dict[str, list[tuple[Clocked, Clocked]]] = {name: [] for name in benches}
        for done in range(self.rounds):
            run.progress("timing renderers in turn", done, self.rounds)
            for name in list(benches)[:: -1 if done % 2 else 1]:
                try:
                    clocked[name].append((benches[name].forward(1), benches[name].steps(1)))
                except LimitReached as limit:
                    record.status, record.reason = limit.status, f"{name}: {limit}"
                    return
        record.metrics = {"rounds": self.rounds}
        for name, bench in benches.items():
            numbers = _costs(clocked[name], clocked[BASE]) | bench.errors(self.wrong)
            if (over := clocked[name][-1][1].counts.over_bound(bench.decoder.at(bench.code))) is not None:
                numbers["work_over_bound"] = over
            record.metrics |= {f"{name}.{key}": number for key, number in numbers.items()}
        record.status, record.reason = RunStatus.OK, ""


def _costs(rounds: list[tuple[Clocked, Clocked]], base: list[tuple[Clocked, Clocked]]) -> dict[str, float]:
    """The costs of a renderer, and their ratios to those of the same rounds of the first one."""
    costs: dict[str, float] = {}
    for part, name in enumerate(("forward", "step")):
        for key, ends in (("seconds", ""), ("cpu", "_cpu")):
            mine, others = ([getattr(clocked[part], key)[0] for clocked in line] for line in (rounds, base))
            ratios = [one / other for one, other in zip(mine, others, strict=True)]
            costs[f"{name}_{key}"] = median(mine)
            costs[f"{name}{ends}_ratio"] = median(ratios)
            costs |= {f"{name}{ends}_ratio_low": min(ratios), f"{name}{ends}_ratio_high": max(ratios)}
    forward, step = rounds[-1]
    costs |= {"queries": forward.counts.value, "coarse_queries": forward.counts.coarse}
    if step.memory is not None:
        costs["peak_memory_bytes"] = max(steps.memory or 0 for _, steps in rounds)
    return costs
