"""Solves an inverse problem: evaluates it, optimises it, and evaluates it again."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, isnan
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.config import DOUBLING, extension
from bench.evaluate.evaluate import COLOUR_DEFINITIONS, DEFINITIONS, Evaluation, depth_gap_note
from bench.evaluate.state import State
from bench.machine.environment import seconds_at_peak
from bench.records.record import Record, RunStatus, curve_file
from bench.records.shipped import best_possible
from bench.setup.inputs import RunContext, RunInputs
from bench.shape_prior import Prior
from bench.solve.optimise import BUDGET, CannotContinue, History, Optimisable, OptimiserSettings, optimise
from datasets.mesh import Mesh
from datasets.saved_field import FIELD_FILE, save_field
from datasets.scene import Scene, View
from renderers.camera import Camera
from renderers.field import Counts, Field
from renderers.rendering import Renderer, Unsupported, check_kind
from renderers.schedule import schedule_position

CHECKPOINT_BUDGET_SHARES = 0.03, 0.1, 0.2, 0.5
COST_DEFINITIONS = {
    "evaluations.value": "points whose field value was computed in the optimisation loop, counted at the field",
    "evaluations.coarse": "points whose value was computed more cheaply, in bfloat16, where it decides nothing; absent "
    "without any, and not among those of value",
    "evaluations.masked": "not in these: points of rays that had ended, whose values were computed and thrown away, "
    "because a march on a GPU removes finished rays only every eight steps; absent without any",
    "evaluations.gradient": "points through whose field value a gradient other than zero was propagated back",
    "evaluations.cost": "field evaluations: those of value, twice those of gradient, and an eighth of coarse ones",
    "evaluations.observed": "pixels whose depth was given",
    "evaluations.per_ray": "value evaluations divided by rays times iterations",
    "evaluations.work_over_bound": "the operations of all evaluations, divided by those of one value and one gradient "
    "per hit; absent without hits",
    "seconds.warmup": "one forward and backward pass before the first iteration, with the check of its hits; its "
    "evaluations are not counted",
    "seconds.forward": "rendering and loss, over all iterations; the device is synchronised at both ends",
    "seconds.backward": "back-propagation and the optimiser's step, over all iterations",
    "seconds.evaluation": "meshes, metrics and pictures; not part of the loop's time",
    "seconds.total": "the whole run, including making or loading shapes and prior",
    "peak_memory_bytes": "highest rise of PyTorch's memory on a GPU, in the loop; not measured on a CPU",
    "flops": "evaluations times the field's operations per evaluation, coarse ones included",
    "gemm_fraction": "seconds that the flops take at the machine's best rate of a matrix product, in float32 or, of "
    "coarse values, in bfloat16, over the loop's seconds; above 1 where compiled code is faster than PyTorch's product",
}


@runtime_checkable
class Problem(Optimisable, Protocol):
    """An inverse problem: its unknown, and the evaluation of its state."""

    tracked: tuple[str, ...]  # metrics that each checkpoint writes into the curve
    rays_per_iteration: int
    observed: Bool[Tensor, "height width"]  # pixels of the scene's view whose depth is observed

    def objective(self) -> float | None:
        """A measure that must decrease, not counted as cost; None if losses of different iterations are comparable."""
        ...

    def field(self) -> Field:
        """The field of a copy of the current parameters; its evaluations are not counted."""
        ...

    def camera(self) -> Camera | None:
        """The camera of the picture of the current state; None for the scene's camera."""
        ...

    def evaluate(self, state: State) -> Evaluation:
        """The errors of the current state against the ground truth."""
        ...

    def checkpoint(self, state: State) -> dict[str, float]:
        """Only the `tracked` metrics of the current state."""
        ...


@dataclass(frozen=True)
class Solution:
    """A solved problem.

    Args:
        states: before and after the optimisation.
        meshes: of the evaluations before and after; None without a surface.
        curve: a line per iteration.
    """

    problem: Problem
    states: tuple[State, State]
    meshes: tuple[Mesh | None, Mesh | None]
    curve: list[dict[str, Any]]


def check_field_gradient(renderer: Renderer) -> None:
    """Raises Unsupported if a renderer has no gradient towards the field's parameters."""
    if not renderer.capabilities.field_gradient:
        raise Unsupported(f"{type(renderer).__name__} has no gradient towards the field")


@runtime_checkable
class Pictures(Protocol):
    """The pictures of one run, made from its inputs; the extension `pictures`. Never drawn within a timed phase."""

    def add(self, name: int | str, state: State, camera: Camera | None = None) -> None:
        """Adds a picture of a state, such as that of a checkpoint.

        Args:
            name: its label, such as an iteration.
            camera: of the picture; None for the scene's.
        """
        ...

    def draw(self, run: RunContext, solution: Solution, *, gallery: bool) -> None:
        """Writes the pictures of a solved problem into the run's folder, after its result is in the record.

        Args:
            gallery: whether pictures for galleries are written, if the configuration has a size for them.
        """
        ...

    def compare(self, folder: Path, view: View, reference: View, *, title: str) -> None:
        """Writes the pictures of a rendering and of its reference into a run's folder."""
        ...


@runtime_checkable
class InverseTask(Protocol):
    """A task that is an inverse problem of a prior's code; `solve_task` executes it."""

    optimiser: OptimiserSettings

    def problem(self, scene: Scene, prior: Prior, renderer: Renderer, *, seed: int, device: torch.device) -> Problem:
        """The inverse problem of a scene.

        Raises:
            Unsupported: the renderer lacks a gradient that the task needs.
        """
        ...


def solve_task(task: InverseTask, run: RunContext) -> State:
    """Solves a task's inverse problem of a code, and returns the final state."""
    inputs = run.inputs

    def problem() -> Problem:
        return task.problem(inputs.scene, inputs.prior, inputs.renderer, seed=inputs.seed, device=inputs.device)

    return solve_and_draw(problem, task.optimiser, run, metric_definitions(inputs), gallery=True)


def solve_and_draw(
    make_problem: Callable[[], Problem],
    settings: OptimiserSettings,
    run: RunContext,
    definitions: dict[str, str],
    *,
    gallery: bool = False,
) -> State:
    """Solves a problem (see `solve`), draws it (see `Pictures.draw`), and returns the final state."""
    pictures: Pictures = extension("pictures")(run.inputs)
    solution = solve(make_problem, settings, run, definitions, pictures.add)
    with run.off_clock():
        pictures.draw(run, solution, gallery=gallery)
    return solution.states[1]


def solve(
    make_problem: Callable[[], Problem],
    settings: OptimiserSettings,
    run: RunContext,
    definitions: dict[str, str],
    on_state: Callable[[int, State, Camera | None], None],
) -> Solution:
    """Makes a problem, solves it, and fills the run's record and folder.

    Args:
        run: its record receives the definitions first, so that it has them even if making the problem fails.
        definitions: of the metrics of the problem's `evaluate`.
        on_state: receives the iteration and the state of each checkpoint and of the result, with `Problem.camera`.

    Raises:
        Unsupported: the renderer lacks what the problem's field needs.
    """
    inputs, record = run.inputs, run.record
    record.definitions = definitions | COST_DEFINITIONS
    problem = make_problem()
    first = State(problem.field(), inputs)
    check_kind(inputs.renderer, first.field)
    with run.off_clock():
        before = problem.evaluate(first)
    record.metrics_start = before.metrics
    record.metrics_best = {name: best for name, best in best_possible(record.config).items() if name in before.metrics}

    def state() -> State:
        field = problem.field()
        return first if field is first.field else State(field, inputs)  # extracts an unchanged shape only once

    def errors_at(iteration: int) -> dict[str, float]:
        current = state() if iteration else first
        on_state(iteration, current, problem.camera())
        if iteration:
            return problem.checkpoint(current)
        return {name: before.metrics[name] for name in problem.tracked if name in before.metrics}

    history = run_optimisation(problem, settings, run, errors_at)
    with run.off_clock():
        last = state()
        after = problem.evaluate(last)
        note_result(run, replace(after, failure=failure_of(history, after)))
        on_state(len(history.curve), last, problem.camera())
    return Solution(problem, (first, last), (before.mesh, after.mesh), history.curve)


def metric_definitions(inputs: RunInputs) -> dict[str, str]:
    """The definitions of the metrics of a solved code."""
    return DEFINITIONS | COLOUR_DEFINITIONS if inputs.prior_choice.coloured else DEFINITIONS


def save_in_world(folder: Path, to_world: Float[np.ndarray, "4 4"]) -> Mesh | None:
    """Writes `to_world.txt` and `mesh_world.ply`, the transformed mesh, into a run's folder; returns the run's mesh.

    Args:
        to_world: the similarity from the scene's world to the world of a file.
    """
    np.savetxt(folder / "to_world.txt", to_world, fmt="%.17g")
    if not (folder / "mesh.ply").is_file():
        return None
    mesh = Mesh.load(folder / "mesh.ply")
    mesh.moved(to_world).save(folder / "mesh_world.ply")
    return mesh


def note_result(run: RunContext, after: Evaluation) -> None:
    """Writes the result into the record, and its mesh and its field into the run's folder."""
    record = run.record
    record.metrics = after.metrics
    record.status, record.reason = after.failure or (RunStatus.OK, "")
    unsaved = None if after.field is None else save_field(after.field, run.folder / FIELD_FILE)
    record.notes = [*record.notes, *([unsaved] if unsaved else []), *after.notes, *depth_gap_note(after.metrics)]
    if after.mesh is not None:
        record.notes += after.mesh.repairs
        after.mesh.save(run.folder / "mesh.ply")


def run_optimisation(
    problem: Problem,
    settings: OptimiserSettings,
    run: RunContext,
    errors_at: Callable[[int], dict[str, float]],
    *,
    least_reference: float = 0.0,
) -> History:
    """Runs the optimisation loop; writes its curve line by line, and its costs to the record, even if it is stopped.

    Args:
        errors_at: returns the errors of the current state before an iteration, outside the timed part. Loss and errors
            of a line belong to the parameters before its step.
        least_reference: see `bench.solve.optimise.optimise`.
    """
    history = History(notes=[])
    checkpoints = checkpoints_of(run.inputs.evaluation.every, settings)
    checkpoint_errors: dict[int, dict[str, float]] = {}

    def check(iteration: int) -> None:
        with run.off_clock():
            checkpoint_errors[iteration] = errors_at(iteration)

    def note_objective() -> None:
        if (value := problem.objective()) is not None:
            history.objectives.append(value)

    with curve_file(run.folder) as write_line:

        def on_step(line: dict[str, Any]) -> None:
            line |= checkpoint_errors.get(line["iteration"], {})
            write_line(line)
            reached = line["cost"] if settings.ends == BUDGET else line["iteration"] + 1
            due = [checkpoint for checkpoint in checkpoints if checkpoint <= reached]
            del checkpoints[: len(due)]
            if due and history.status is RunStatus.OK and line["cost"] < (settings.budget or inf):
                check(line["iteration"] + 1)
            position = schedule_position(settings.at(line["iteration"], line["cost"]))
            run.progress("optimising", position + 1, settings.iterations, line["total"])

        if checkpoints:
            check(int(checkpoints.pop(0)))
        try:
            note_objective()
            # A loop of drawn pixels has a first loss that may be small by chance.
            reference, device = max([least_reference, *history.objectives]), run.inputs.device
            optimise(problem, settings, device, history=history, on_step=on_step, least_reference=reference)
            note_objective()
        except CannotContinue as error:
            history.status, history.reason = RunStatus.NOT_REACHED, str(error)
        finally:
            run.record.notes = [*run.record.notes, *history.notes]
            _note_history(run.record, problem, history)
    return history


def checkpoints_of(interval: int | str | None, settings: OptimiserSettings) -> list[float]:
    """When the state is evaluated, in rising order: numbers of steps or, if a budget ends the loop, costs."""
    if interval is None:
        return []
    if settings.ends == BUDGET:
        return [0.0, *(share * (settings.budget or inf) for share in CHECKPOINT_BUDGET_SHARES)]
    last = settings.iterations - 1
    if interval == DOUBLING:
        return sorted({0, last} | {2**power for power in range(last.bit_length()) if 2**power < last})
    return sorted({*range(0, last, int(interval)), last})


def note_costs(
    record: Record,
    *,
    seconds: dict[str, float],
    flops: int | None,
    evaluations: dict[str, float],
    coarse_flops: int = 0,
) -> None:
    """Writes a loop's costs into the record; `seconds` has "forward" and "backward", `flops` excludes coarse ones."""
    record.seconds |= seconds
    record.evaluations = evaluations
    loop = seconds["forward"] + seconds["backward"]
    if flops is not None:
        record.flops = flops + coarse_flops
    if flops is not None and loop > 0:
        record.gemm_fraction = seconds_at_peak(record.environment, flops, coarse_flops) / loop


def evaluation_counts(counts: Counts, field: Field) -> dict[str, float]:
    """The evaluation counts of a field for the record; "work_over_bound" only with hits."""
    numbers: dict[str, float] = {"value": counts.value, "gradient": counts.gradient, "cost": counts.cost}
    numbers |= {name: number for name in ("coarse", "masked") if (number := getattr(counts, name))}
    if (over_bound := counts.over_bound(field)) is not None:
        numbers["work_over_bound"] = over_bound
    return numbers


def _note_history(record: Record, problem: Problem, history: History) -> None:
    """Writes the costs of a loop into the record, even if the loop was stopped."""
    iterations = max(len(history.curve), 1)
    evaluations = {
        **evaluation_counts(history.counts, problem.field()),
        "per_ray": history.counts.value / problem.rays_per_iteration / iterations,
        "rays_per_iteration": problem.rays_per_iteration,
        "observed": int(problem.observed.sum()),
        "iterations": len(history.curve),
    }
    record.peak_memory_bytes = history.peak_memory_bytes
    flops, coarse = history.counts.flops(problem.field()), history.counts.coarse_flops(problem.field())
    note_costs(record, seconds=history.seconds, flops=flops, coarse_flops=coarse, evaluations=evaluations)


def failure_of(history: History, after: Evaluation) -> tuple[RunStatus, str] | None:
    """Status and reason of a failed run, else None. They follow from loss and surface, never from the ground truth."""
    if history.status is not RunStatus.OK:
        return history.status, history.reason
    if after.failure is not None:
        return after.failure
    first, last = history.objectives or (history.first_loss, history.curve[-1]["total"])
    measure = "objective" if history.objectives else "loss"
    if isnan(first) or isnan(last):
        return RunStatus.NAN, f"the {measure} is not a number at the {'start' if isnan(first) else 'end'}"
    if last >= first and last > 0 and len(history.curve) > 1:
        return RunStatus.NOT_REACHED, f"the {measure} did not fall: {first:.4g} at the start, {last:.4g} at the end"
    return None
