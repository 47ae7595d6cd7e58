"""The field of an unknown shape without a prior: the candidate that early growth ends on, or a named one."""

from dataclasses import replace
from typing import Any

from bench.evaluate.evaluate import DEFINITIONS, Evaluation, evaluate
from bench.evaluate.state import State
from bench.models.candidates import by_size
from bench.models.fit import FitProblem, Fitter
from bench.models.growth import Growth, grow
from bench.models.model import Evidence
from bench.models.observations import RayObservations
from bench.pictures.filmstrip import Filmstrip
from bench.pictures.run_figures import InputView, draw_run
from bench.records.record import Record, RunStatus, curve_file
from bench.setup.inputs import RunContext
from bench.solve.solve import COSTS, draw, note_costs, note_result

SIZES = (
    "the numbers of its field that the optimiser may change; those that a file must hold so that it can be evaluated, "
    "of a grid all its samples; the size of that file in float32"
)
NOT_RENDERED = ("part", "phase", "candidate", "eikonal", "rays_share")  # keys that curves of other runs lack
ENDED = {
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


def solve_by_growth(observations: RayObservations, given: InputView, run: RunContext, *, iterations: int) -> None:
    """Fits the shape of a run by early growth, or with the one field that was requested.

    Args:
        observations: that a field is fitted to, some of them held out.
        given: what pictures show of them.
        iterations: of a whole fit.

    Raises:
        Unsupported: where the renderer cannot do what the field needs.
    """
    inputs, record, choice = run.inputs, run.record, run.inputs.field
    record.definitions = DEFINITIONS | COSTS | ENDED
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
        metrics, notes = after.metrics | ended(growth), (*growth.summary(choice.name), *fitter.notes[:1], *after.notes)
        note_result(run, replace(after, metrics=metrics, failure=failure_of(growth, after), notes=notes))
        curve = rendered(lines, growth.fitted.evidence.candidate)
        filmstrip = Filmstrip(inputs, "by candidate")
        for name, field in growth.fields.items():
            filmstrip.add(name, State(field, inputs))
        draw(run, lambda title: draw_run(run.folder, (first, last), given, curve, title), filmstrip)


def rendered(lines: list[dict[str, Any]], candidate: str) -> list[dict[str, Any]]:
    """The curve of a candidate's fit through the renderer, its trial and the rest joined, with one clock."""
    fit = [line for line in lines if line["phase"] == FitProblem.phase and line["candidate"] == candidate]
    clock, curve = 0.0, []
    for place, line in enumerate(fit):
        step = line["seconds"] - (fit[place - 1]["seconds"] if place else 0.0)
        clock += step if step > 0 else line["seconds"]
        numbers = {name: value for name, value in line.items() if name not in NOT_RENDERED}
        curve.append({**numbers, "iteration": place, "seconds": clock})
    return curve


def ended(growth: Growth) -> dict[str, Any]:
    """The field that growth ended on, as metrics."""
    evidence = growth.fitted.evidence
    error = {} if evidence.error is None else {"field_standard_error": evidence.error.standard_error}
    return {
        **evidence.field(),
        **error,
        "field_footprint": growth.footprint,
        "field_overhead": growth.overhead,
        "fields_tried": len(growth.tried),
    }


def failure_of(growth: Growth, after: Evaluation) -> tuple[RunStatus, str] | None:
    """Why the run failed, or None: a fit that does not improve on its warm start has not, one that gets worse has."""
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
    """Notes the costs of fits in the record."""
    observations = fitter.observations
    iterations, values = sum(fit.iterations for fit in fits), sum(fit.evaluations for fit in fits)
    evaluations = {
        "value": values,
        "gradient": sum(fit.gradients for fit in fits),
        "per_ray": values / max(iterations * observations.rays, 1),
        "rays_per_iteration": observations.rays,
        "observed": int(observations.given.observed.sum() + observations.held_out.observed.sum()),
        "iterations": iterations,
    }
    seconds = {"forward": 0.0, "backward": 0.0} | fitter.spent
    note_costs(record, seconds=seconds, flops=int(sum(fit.flops for fit in fits)), evaluations=evaluations)
