"""Solves an inverse problem: judges, optimises, judges again, draws."""

import json
import time
from typing import Any

from bench.gallery import draw_run
from bench.judge import Judgement, glance, judge
from bench.metrics import DEFINITIONS
from bench.optimise import Course, optimise
from bench.records import Record, RunStatus, plain
from bench.stage import Cell
from bench.tasks.problem import InverseTask, OptimiserSettings, Problem, check_kind
from renderers.field import Field

COSTS = {
    "evaluations.value": "points whose field value was computed in the optimisation loop, counted at the field",
    "evaluations.gradient": "points through whose field value a gradient other than zero was propagated back",
    "evaluations.observed": "pixels whose depth was given",
    "evaluations.per_ray": "value evaluations divided by rays times iterations",
    "seconds.warmup": "one step's forward and backward pass before the clock, whose work is not counted",
    "seconds.forward": "rendering and loss, over all iterations; the device is synchronised at both ends",
    "seconds.backward": "back-propagation and the optimiser's step, over all iterations",
    "seconds.evaluation": "meshes, metrics and pictures, off the loop's clock",
    "seconds.total": "the whole run, with shapes and prior made or loaded",
    "peak_memory_bytes": "highest rise, during the loop, of the process's resident memory (CPU) or PyTorch's (GPU)",
    "flops": "evaluations times the operations of the field that each costs",
    "gemm_fraction": "flops over the loop's seconds, divided by the machine's best float32 matrix product rate",
}


def solve(task: InverseTask, cell: Cell) -> Field:
    """Executes an inverse task, and gives the field that it ended with.

    Raises:
        Unsupported: where the renderer cannot do what the task or its field needs.
    """
    stage, record = cell.stage, cell.record
    record.definitions = DEFINITIONS | COSTS
    problem = task.problem(stage.scene, stage.prior, stage.renderer, seed=stage.seed, device=stage.device)
    first = problem.field()
    check_kind(stage.renderer, first)
    clock = time.perf_counter()
    before = judge(first, stage)
    record.metrics_start, record.seconds["evaluation"] = before.metrics, time.perf_counter() - clock
    course = Course()
    try:
        _optimise(problem, task.optimiser, cell, course)
    finally:
        _note_costs(record, problem, course)
    clock = time.perf_counter()
    last = problem.field()
    after = judge(last, stage)
    record.metrics = after.metrics
    record.status, record.reason = _verdict(course, after)
    if after.mesh is not None:
        after.mesh.save(cell.folder / "mesh.ply")
    title = f"{record.task}, {record.name}, {record.scene}: {record.status}"
    if stage.evaluation.picture is not None:
        draw_run(cell.folder, stage, (first, last), problem.observed.cpu().numpy(), course.curve, title)
    record.seconds["evaluation"] += time.perf_counter() - clock
    return last


def _optimise(problem: Problem, settings: OptimiserSettings, cell: Cell, course: Course) -> None:
    """The loop, with each line of its curve written as it comes.

    A line has the loss before its step; the Chamfer distance that stands beside it is of the same parameters.
    """
    looks = cell.stage.evaluation.looks(settings.iterations)
    known: dict[int, float] = {0: cell.record.metrics_start["chamfer_l2"]} if looks else {}
    with (cell.folder / "curve.jsonl").open("w", buffering=1, encoding="utf-8") as curve:

        def on_step(line: dict[str, Any]) -> None:
            if line["iteration"] in known:
                line["chamfer_l2"] = known[line["iteration"]]
            coming = line["iteration"] + 1
            if coming in looks:
                clock = time.perf_counter()
                known[coming] = glance(problem.field(), cell.stage)
                cell.record.seconds["evaluation"] += time.perf_counter() - clock
            curve.write(json.dumps(plain(line), allow_nan=False) + "\n")
            cell.progress("optimising", coming, settings.iterations, line["total"])

        optimise(problem, settings, cell.stage.device, course=course, on_step=on_step)


def _note_costs(record: Record, problem: Problem, course: Course) -> None:
    """Also for a loop that was cut short, as far as it came."""
    iterations = max(len(course.curve), 1)
    record.seconds |= course.seconds
    record.evaluations = {
        "value": course.counts.value,
        "gradient": course.counts.gradient,
        "per_ray": course.counts.value / problem.rays_per_iteration / iterations,
        "rays_per_iteration": problem.rays_per_iteration,
        "observed": int(problem.observed.sum()),
        "iterations": len(course.curve),
    }
    record.peak_memory_bytes = course.peak_memory_bytes
    record.flops = course.counts.flops(problem.field())
    seconds = course.seconds["forward"] + course.seconds["backward"]
    if record.flops is not None and seconds > 0:
        record.gemm_fraction = record.flops / seconds / record.environment["gemm_peak_flops"]


def _verdict(course: Course, after: Judgement) -> tuple[RunStatus, str]:
    """The truth picks nothing here: a run fails by its own loss and its own surface."""
    if course.status is not RunStatus.OK:
        return course.status, course.reason
    if after.mesh is None:
        return RunStatus.EMPTY, "the field has no surface in the unit sphere"
    first, last = course.curve[0]["total"], course.curve[-1]["total"]
    if last >= first and len(course.curve) > 1:
        return RunStatus.NOT_REACHED, f"the loss did not fall: {first:.4g} at the start, {last:.4g} at the end"
    return RunStatus.OK, ""
