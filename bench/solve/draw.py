"""Solves an inverse problem and draws it."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch

from bench.evaluate.state import State
from bench.pictures.filmstrip import Filmstrip, Shown
from bench.pictures.run_figures import save_gallery
from bench.records.format import values_in_words
from bench.setup.inputs import RunContext
from bench.shape_prior import Prior
from bench.solve.optimise import OptimiserSettings
from bench.solve.solve import Problem, metric_definitions, solve
from datasets.scene import Scene
from renderers.rendering import Renderer


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
    """Solves a problem (see `solve`), draws it into the run's folder, and returns the final state.

    Args:
        gallery: whether pictures for galleries are written, if the configuration has a size for them.
    """
    inputs = run.inputs
    filmstrip = Filmstrip(inputs)
    solution = solve(make_problem, settings, run, definitions, filmstrip.add)
    problem, states = solution.problem, solution.states
    with run.off_clock():
        draw(
            run,
            lambda title: problem.draw(run.folder, states, solution.curve, title),
            filmstrip,
            truth=problem.shown,
        )
        if gallery and inputs.evaluation.gallery is not None:
            before, after = solution.meshes
            save_gallery(run.folder, inputs, problem.observed, {"start": before, "found": after})
    return states[1]


def draw(
    run: RunContext, draw_pictures: Callable[[str], None], filmstrip: Filmstrip, truth: Shown | None = None
) -> None:
    """Writes pictures and filmstrip of a run, after its result is in the record.

    Args:
        draw_pictures: writes the pictures with a title; not called if pictures are off.
        truth: see `Filmstrip.save`.
    """
    title, compared = run.record.outcome, run.record.compared()
    if run.inputs.evaluation.picture is not None:
        errors = [f"{label}: {values_in_words(values)}" for label, values, _ in compared[:1]]
        draw_pictures("\n".join([title, *errors]))
    filmstrip.save(run.folder, title, truth=truth)
