"""Fits an unknown shape without a prior: by the candidate chosen by early growth, or by a named candidate."""

from dataclasses import replace
from typing import Any

import torch

from bench.evaluate.evaluate import DEFINITIONS, Evaluation, evaluate
from bench.evaluate.state import State
from bench.pictures.filmstrip import Filmstrip
from bench.pictures.run import draw
from bench.pictures.run_figures import InputView, draw_run
from bench.records.record import Record, RunStatus, curve_file
from bench.setup.auto import footprint
from bench.setup.inputs import RunContext
from bench.solve.observed_view import ObservedView
from bench.solve.solve import COST_DEFINITIONS, note_costs, note_result
from bench.tasks.capacity.candidates import by_size
from bench.tasks.capacity.fit import FitProblem, Fitter
from bench.tasks.capacity.growth import Growth, grow
from bench.tasks.capacity.model import Evidence
from bench.tasks.capacity.observations import RayObservations, concatenate_views, hold_out, tiles
from datasets.scene import View

# Of the rays of each tile of a view.
HELD_OUT_FRACTION = 0.2
SIZES = (
    "the numbers of its field that the optimiser may change; those that a file must hold so that it can be evaluated, "
    "of a grid all its samples; the size of that file in float32"
)
FIT_ONLY_KEYS = ("part", "phase", "candidate", "eikonal", "rays_share")  # curves of other runs lack these keys
FIELD_DEFINITIONS = {
    "field": "the candidate that field=auto ended on, or the one that was requested",
    "field_free, field_stored, field_bytes": SIZES,
    "field_error, field_standard_error": "of the held-out observations: as NAME.error of task=capacity, in "
    "scene units; through the renderer as configured, "
    "so that what renderer.epsilon=auto adds to a surface is not in it",
    "field_footprint": "half a pixel (DIST, Eq. 10), in scene units, under which growth ends",
    "field_overhead": "seconds of all fits, also of candidates without improvement, over those of the last one's; "
    "without checkpoints on what is held out",
    "fields_tried": "candidates that were tried",
}


def fit_view(view: ObservedView, true_view: View, run: RunContext, *, iterations: int) -> None:
    """Fits the shape of a run to its view, of which a fraction of each tile is held out; see `solve_by_growth`.

    Args:
        true_view: the images of the view, for pictures.
    """
    inputs = run.inputs
    pictured = InputView(true_view, view.observed.cpu().numpy(), mask=view.mask is not None)
    camera = inputs.scene.view.camera
    half_pixel = footprint(float(camera.intrinsics[0, 0]), float(torch.linalg.vector_norm(camera.center)))
    rays, groups = concatenate_views([view]), tiles(*view.observed.shape)
    observations = hold_out(rays, groups, share=HELD_OUT_FRACTION, entire=(), footprint=half_pixel, seed=inputs.seed)
    solve_by_growth(observations, pictured, run, iterations=iterations)


def solve_by_growth(observations: RayObservations, pictured: InputView, run: RunContext, *, iterations: int) -> None:
    """Fits the shape of a run by early growth, or with the requested field.

    Args:
        observations: for the fit, some of them held out.
        pictured: the observations for pictures.
        iterations: of a complete fit.

    Raises:
        Unsupported: the renderer lacks what the field needs.
    """
    inputs, record, choice = run.inputs, run.record, run.inputs.field
    record.definitions = DEFINITIONS | COST_DEFINITIONS | FIELD_DEFINITIONS
    lines: list[dict[str, Any]] = []
    with curve_file(run.folder) as write_line:

        def on_line(name: str, line: dict[str, Any]) -> None:
            lines.append({**line, "candidate": name})
            write_line(lines[-1])
            run.progress(f"fitting {name}", line["iteration"] + 1, iterations, line["total"])

        settings = replace(choice.models.fit, iterations=iterations)
        fitter = Fitter(observations, settings, inputs.seed, inputs.device, on_line)
        growth = grow(fitter, by_size(choice.candidates, choice.models.size), choice.models.growth)
    note_fits(record, growth.tried, fitter)
    with run.off_clock():
        first, last = State(growth.first, inputs), State(growth.fitted.model.frozen(), inputs)
        record.metrics_start, after = evaluate(first).metrics, evaluate(last)
        notes = (*growth.summary(choice.name), *fitter.notes[:1], *after.notes)
        evidence = growth.fitted.evidence
        error = {} if evidence.error is None else {"field_standard_error": evidence.error.standard_error}
        costs = {"field_overhead": growth.overhead, "fields_tried": len(growth.tried)}
        metrics = {**after.metrics, **evidence.field(), **error, "field_footprint": growth.footprint, **costs}
        note_result(run, replace(after, metrics=metrics, failure=failure_of(growth, after), notes=notes))
        curve = rendered_curve(lines, evidence.candidate)
        filmstrip = Filmstrip(inputs, "by candidate")
        for name, field in growth.fields.items():
            filmstrip.add(name, State(field, inputs))
        draw(run, lambda title: draw_run(run.folder, (first, last), pictured, curve, title), filmstrip)


def rendered_curve(lines: list[dict[str, Any]], candidate: str) -> list[dict[str, Any]]:
    """The curve of a candidate's fit with the renderer: its trial and the rest, with seconds of both together."""
    fit = [line for line in lines if line["phase"] == FitProblem.phase and line["candidate"] == candidate]
    clock, curve = 0.0, []
    for index, line in enumerate(fit):
        step = line["seconds"] - (fit[index - 1]["seconds"] if index else 0.0)
        clock += step if step > 0 else line["seconds"]
        numbers = {name: value for name, value in line.items() if name not in FIT_ONLY_KEYS}
        curve.append({**numbers, "iteration": index, "seconds": clock})
    return curve


def failure_of(growth: Growth, after: Evaluation) -> tuple[RunStatus, str] | None:
    """Status and reason of a failed run, else None. A fit worse than its warm start fails; an equal one does not."""
    evidence, initial = growth.fitted.evidence, growth.initial_error
    if evidence.error is None:
        return RunStatus(evidence.status), evidence.reason
    if after.failure is not None:
        return after.failure
    if initial is not None and evidence.mean > growth.footprint:
        noise = evidence.error.noise_of_difference(initial)
        if evidence.mean - initial.mean > noise:
            ends = f"{initial.mean:.4g} before the first fit, {evidence.mean:.4g} at the end"
            return RunStatus.NOT_REACHED, f"the held-out error rose by more than its noise: {ends}"
    return None


def note_fits(record: Record, fits: list[Evidence], fitter: Fitter) -> None:
    observations = fitter.observations
    iterations, values = sum(fit.iterations for fit in fits), sum(fit.evaluations for fit in fits)
    evaluations = {
        "value": values,
        "gradient": sum(fit.gradients for fit in fits),
        "per_ray": values / max(iterations * observations.rays, 1),
        "rays_per_iteration": observations.rays,
        "observed": int(observations.fitted.observed.sum() + observations.held_out.observed.sum()),
        "iterations": iterations,
    }
    seconds = {"forward": 0.0, "backward": 0.0} | fitter.spent
    note_costs(record, seconds=seconds, flops=int(sum(fit.flops for fit in fits)), evaluations=evaluations)
