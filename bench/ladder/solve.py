"""Solves a task whose unknown is a shape with a field of the ladder in the place of a prior's code: `field=auto`."""

import json
import time
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import torch

from bench.film import Film
from bench.gallery import draw_run
from bench.judge import judge
from bench.ladder.fit import Fitter, RungProblem
from bench.ladder.growth import Growth, grow
from bench.ladder.observations import Observations
from bench.ladder.settings import PRIOR
from bench.metrics import DEFINITIONS
from bench.pictures import Given
from bench.records import RunStatus, plain
from bench.solve import COSTS, solve
from bench.stage import Cell
from bench.tasks.problem import InverseTask, check_field_gradient
from datasets.scene import Scene
from renderers.rendering import Renderer

ENDED = {
    "field": "the rung that field=auto ended on, or the one that was asked for",
    "field_parameters": "its free numbers",
    "field_error, field_standard_error": "of what was held out of the observations: as RUNG.error of task=capacity, in "
    "scene units; of photographs the mean difference of colours from 0 to 1; through the renderer as it was "
    "asked for, so that what renderer.epsilon=auto adds to a surface is not in it",
    "field_footprint": "half a pixel (DIST, Eq. 10), in scene units, under which growth ends; 0 for photographs",
    "field_overhead": "seconds of all fits, also of rungs that were tried in vain, over those of the last rung's; "
    "without looks at what is held out",
    "field_overhead_judged": "the same with looks and with what it takes to begin",
    "fields_tried": "rungs that were tried",
}


@runtime_checkable
class Grows(InverseTask, Protocol):
    """A task whose unknown may be any field: each is fitted for the task's iterations, at a rate of its own."""

    def observations(
        self, scene: Scene, renderer: Renderer, *, seed: int, device: torch.device
    ) -> tuple[Observations, Given]:
        """What a field is fitted to, of which some is held out, and what is shown of it in pictures."""
        ...


def solve_shape(task: Grows, cell: Cell) -> None:
    """Executes a task whose unknown is a shape: with a prior's code, or with the field that the run asks for.

    Raises:
        Unsupported: where the renderer cannot do what the task or its field needs.
    """
    if cell.stage.field == PRIOR:
        solve(task, cell)
    else:
        solve_by_growth(task, cell)


def solve_by_growth(task: Grows, cell: Cell) -> None:
    """Executes a task by early growth, or with the one field that was asked for.

    Raises:
        Unsupported: where the renderer has no gradient towards the field.
    """
    stage, record = cell.stage, cell.record
    check_field_gradient(stage.renderer)
    record.definitions = DEFINITIONS | COSTS | ENDED
    observations, given = task.observations(stage.scene, stage.renderer, seed=stage.seed, device=stage.device)
    lines: list[dict[str, Any]] = []
    rungs = stage.ladder.asked(stage.field)
    with (cell.folder / "curve.jsonl").open("w", buffering=1, encoding="utf-8") as curve:

        def on_line(name: str, line: dict[str, Any]) -> None:
            lines.append({**line, "rung": name})
            curve.write(json.dumps(plain(lines[-1]), allow_nan=False) + "\n")
            cell.progress(name, line["iteration"] + 1, task.optimiser.iterations, line["total"])

        settings = replace(stage.ladder.fit, iterations=task.optimiser.iterations)
        fitter = Fitter(observations, settings, stage.seed, stage.device, on_line)
        growth = grow(fitter, rungs, stage.ladder.growth)
    clock = time.perf_counter()
    _note_costs(cell, fitter, growth, observed=int(given.observed.sum()))
    first, last = growth.first, growth.fitted.model.frozen()
    record.metrics_start, after = judge(first, stage).metrics, judge(last, stage)
    record.metrics = after.metrics | ended(growth)
    record.status, record.reason = verdict(growth, empty=after.mesh is None)
    record.notes = [*record.notes, *growth.told(stage.field)]
    if after.mesh is not None:
        after.mesh.save(cell.folder / "mesh.ply")
    title = f"{record.task}, {record.name}, {record.scene}: {record.status}"
    if stage.evaluation.picture is not None:
        draw_run(cell.folder, stage, (first, last), given, rendered(lines, growth.fitted.evidence.rung), title)
    film = Film(stage, "by rung")
    for name, field in growth.fields.items():
        film.shoot(name, field, stage.scene.view.camera)
    film.save(cell.folder, title)
    record.seconds["evaluation"] = time.perf_counter() - clock


def rendered(lines: list[dict[str, Any]], rung: str) -> list[dict[str, Any]]:
    """The lines of a rung's fit through the renderer, its trial and the rest, with one clock."""
    fit = [line for line in lines if line["phase"] == RungProblem.phase and line["rung"] == rung]
    clock, told = 0.0, []
    for place, line in enumerate(fit):
        own = line["seconds"] - (fit[place - 1]["seconds"] if place else 0.0)
        clock += own if own > 0 else line["seconds"]
        numbers = {
            name: value
            for name, value in line.items()
            if name not in ("part", "phase", "rung", "eikonal", "rays_share")
        }
        told.append({**numbers, "iteration": place, "seconds": clock})
    return told


def ended(growth: Growth) -> dict[str, Any]:
    """What growth ended on, as metrics."""
    evidence = growth.fitted.evidence
    error = {} if evidence.error is None else {"field_standard_error": evidence.error.standard_error}
    return {
        "field": evidence.rung,
        "field_parameters": evidence.parameters,
        "field_error": evidence.mean,
        **error,
        "field_footprint": growth.footprint,
        "field_overhead": growth.overhead,
        "field_overhead_judged": growth.overhead_judged,
        "fields_tried": len(growth.tried),
    }


def verdict(growth: Growth, *, empty: bool) -> tuple[RunStatus, str]:
    """What became of a run: a rung that cannot come nearer than its start without a renderer has not failed."""
    evidence, begun = growth.fitted.evidence, growth.begun
    if evidence.error is None:
        return evidence.status, evidence.reason
    if empty:
        return RunStatus.EMPTY, "the field has no surface in the unit sphere"
    if begun is not None and evidence.mean > growth.footprint:
        noise = evidence.error.noise_of_difference(begun)
        if evidence.mean - begun.mean > noise:
            ends = f"{begun.mean:.4g} before the first fit, {evidence.mean:.4g} at last"
            return RunStatus.NOT_REACHED, f"the held-out error rose by more than its noise: {ends}"
    return RunStatus.OK, ""


def _note_costs(cell: Cell, fitter: Fitter, growth: Growth, *, observed: int) -> None:
    record, iterations = cell.record, sum(evidence.iterations for evidence in growth.tried)
    rays = max(iterations * fitter.observations.rays, 1)
    record.seconds |= {"forward": 0.0, "backward": 0.0} | fitter.spent
    record.flops = int(growth.total("flops"))
    record.evaluations = {
        "value": int(growth.total("evaluations")),
        "gradient": int(growth.total("gradients")),
        "per_ray": growth.total("evaluations") / rays,
        "rays_per_iteration": fitter.observations.rays,
        "observed": observed,
        "iterations": iterations,
    }
    seconds = record.seconds["forward"] + record.seconds["backward"]
    if seconds > 0:
        record.gemm_fraction = record.flops / seconds / record.environment["gemm_peak_flops"]
