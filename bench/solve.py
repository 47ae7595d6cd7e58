"""Solves an inverse problem: judges, optimises, judges again, draws."""

import json
import time
from collections.abc import Callable
from typing import Any

from bench.film import Film
from bench.gallery import draw_run
from bench.judge import glance, judge
from bench.metrics import DEFINITIONS
from bench.optimise import Course, optimise
from bench.pictures import Given
from bench.records import Record, RunStatus, plain
from bench.stage import Cell
from bench.tasks.problem import InverseTask, NotReached, OptimiserSettings, Problem, check_kind
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
    film = Film(stage)
    camera = stage.scene.view.camera

    def errors_at(iteration: int) -> dict[str, float]:
        film.shoot(iteration, problem.field(), camera)
        chamfer = glance(problem.field(), stage) if iteration else before.metrics["chamfer_l2"]
        return {"chamfer_l2": chamfer}

    course = descend(problem, task.optimiser, cell, errors_at)
    clock = time.perf_counter()
    last = problem.field()
    after = judge(last, stage)
    record.metrics = after.metrics
    record.status, record.reason = verdict(course, empty=after.mesh is None)
    if after.mesh is not None:
        after.mesh.save(cell.folder / "mesh.ply")
    title = f"{record.task}, {record.name}, {record.scene}: {record.status}"
    if stage.evaluation.picture is not None:
        given = Given(stage.scene.view, problem.observed.cpu().numpy(), problem.photographs)
        draw_run(cell.folder, stage, (first, last), given, course.curve, title)
    film.shoot(len(course.curve), last, camera)
    film.save(cell.folder, title)
    record.seconds["evaluation"] += time.perf_counter() - clock
    return last


def descend(
    problem: Problem, settings: OptimiserSettings, cell: Cell, errors_at: Callable[[int], dict[str, float]]
) -> Course:
    """The loop: each line of its curve is written as it comes, and its costs go to the record, also if it is cut short.

    Args:
        problem: what is solved.
        settings: for how long and how fast.
        cell: the run.
        errors_at: gives the errors of the problem as it stands before an iteration, off the clock. A line has the loss
            before its step; the errors that stand beside it are of the same parameters.
    """
    course = Course()
    looks = cell.stage.evaluation.looks(settings.iterations)
    known: dict[int, dict[str, float]] = {}
    cell.record.seconds.setdefault("evaluation", 0.0)

    def look(iteration: int) -> None:
        clock = time.perf_counter()
        known[iteration] = errors_at(iteration)
        cell.record.seconds["evaluation"] += time.perf_counter() - clock

    with (cell.folder / "curve.jsonl").open("w", buffering=1, encoding="utf-8") as curve:

        def on_step(line: dict[str, Any]) -> None:
            line |= known.get(line["iteration"], {})
            curve.write(json.dumps(plain(line), allow_nan=False) + "\n")
            if course.status is RunStatus.OK and line["iteration"] + 1 in looks:
                look(line["iteration"] + 1)
            cell.progress("optimising", line["iteration"] + 1, settings.iterations, line["total"])

        def judge_loss() -> None:
            if (value := problem.objective()) is not None:
                course.objectives.append(value)

        if looks:
            look(0)
        try:
            judge_loss()
            optimise(problem, settings, cell.stage.device, course=course, on_step=on_step)
            judge_loss()
        except NotReached as error:
            course.status, course.reason = RunStatus.NOT_REACHED, str(error)
        finally:
            _note_costs(cell.record, problem, course)
    return course


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


def verdict(course: Course, *, empty: bool = False) -> tuple[RunStatus, str]:
    """The truth picks nothing here: a run fails by its own loss, or by a field that ended without a surface."""
    if course.status is not RunStatus.OK:
        return course.status, course.reason
    if empty:
        return RunStatus.EMPTY, "the field has no surface in the unit sphere"
    first, last = course.objectives or (course.curve[0]["total"], course.curve[-1]["total"])
    if last >= first and len(course.curve) > 1:
        return RunStatus.NOT_REACHED, f"the loss did not fall: {first:.4g} at the start, {last:.4g} at the end"
    return RunStatus.OK, ""
