"""Model selection: fits fields from four parameters to the papers' network to views of a shape, and chooses one."""

from dataclasses import dataclass, replace
from typing import Any

from bench.evaluate.evaluate import DEFINITIONS, evaluate
from bench.evaluate.state import State
from bench.pictures.filmstrip import Filmstrip
from bench.pictures.size_chart import draw_candidates
from bench.records.record import curve_file
from bench.setup.auto import at_pixel_precision
from bench.setup.inputs import RunContext
from bench.solve.observed_view import DEPTH_LOSSES
from bench.solve.solve import COST_DEFINITIONS, check_field_gradient, note_result
from bench.tasks.capacity.candidates import PAPER_NETWORK, by_size, candidate
from bench.tasks.capacity.field import SIZES, note_fits
from bench.tasks.capacity.fit import Fitted, Fitter
from bench.tasks.capacity.growth import Growth, grow
from bench.tasks.capacity.model import Evidence, Size
from bench.tasks.capacity.observations import Views
from bench.tasks.capacity.settings import SIZE_WORDS
from bench.tasks.capacity.study import CheckSettings, Choice, check, choose, fit_all, refit
from renderers.checks import check_at_least, check_choice, check_fraction, check_positive
from renderers.rendering import final_notes
from renderers.silhouette import SilhouetteLoss

MIN_SECONDS = 1e-9  # avoids division by zero if the clock did not advance
CHOICE_DEFINITIONS = {
    "recommended_field, recommended_error": "the smallest candidate, by recommended_by, whose held-out error is within "
    "one standard error of the best one's or under the footprint; its error",
    "recommended_by": "models.size: stored numbers, free numbers or bytes",
    "recommended_free, recommended_stored, recommended_bytes": "its sizes, as NAME.free",
    "recommended_within, recommended_enough": "1 where the first, the second of these holds",
    "best_field": "the candidate of the least held-out error",
    "footprint": "half a pixel where the shape may be nearest (DIST, Eq. 10, theta = 0), in scene units",
    "NAME.error": "of held-out rays: distance along the field's normal between the observed and the rendered point, at "
    "most 10 footprints; 10 footprints where only one hits; mean over the rays on which either hits, in scene units. "
    "It also chooses which candidate a later one begins with; held_out_seeds do not depend on that",
    "NAME.standard_error": "of that mean, by the jackknife over views",
    "NAME.failed": "why its fit failed",
    "NAME.free, NAME.stored, NAME.bytes": SIZES,
    "NAME.sparse_bytes": "of a grid: size of a file with the fitted samples, a bit per sample that tells which they "
    "are, and the previous field, from which the other samples can be computed; no choice uses it",
    "NAME.iterations, NAME.falling": "of its fit, without a round that was taken back; whether the error still fell in "
    "the last of task.rounds, each of which doubles the iterations",
    "NAME.flops_per_query": "floating-point operations per value, an estimate for formulas",
    "NAME.seconds, NAME.evaluations, NAME.flops": "of its fit, with finding its start and the warm start, "
    "without checkpoints",
    "NAME.seconds_at_auto, NAME.flops_at_auto, NAME.evaluations_at_auto": "at the first checkpoint with the error of "
    "field=auto, or less than a standard error above it; none where there is none",
    "saved_...": "of the papers' network, over the recommended candidate's; seconds only where the network was fitted",
    "auto....": "the result of early growth (field=auto); its costs are of all candidates that it tried",
    "auto.overhead": "seconds of all fits of early growth over those of its final candidate's, without checkpoints",
    "frugal....": "the recommended candidate fitted again at pixel precision: renderer.epsilon=auto, "
    "renderer.steps=auto and the rays of an iteration from the loss",
    "held_out_seeds": "random draws of views that no fit has used",
    "NAME.held_within, NAME.held_enough": "share of these draws on which the candidate is within one standard error of "
    "the draw's best one; on which its error is under the footprint",
    "recommended_confirmed": "1 where a rule of the recommended candidate holds on four fifths of the draws; 0 where "
    "that is true of no candidate, and the best one is recommended",
}


@dataclass(frozen=True)
class Capacity:
    """Fits all candidates to views of a shape, and recommends the smallest that is sufficient.

    Args:
        depth_loss, depth_weight, silhouette, silhouette_weight: see `bench.tasks.completion.Completion`.
        rounds: maximum rounds of a fit, of which the first has `models.fit.iterations`; see
            `bench.tasks.capacity.fit.Fitter.finish`.
        held_out_rays: maximum number of rays of each view that measure an error.
        frugal_rays: initial fraction of the rays in the recommended candidate's fit at pixel precision.
        checks: settings of the checks of the choice on further views.
    """

    depth_loss: str
    depth_weight: float
    silhouette: SilhouetteLoss
    silhouette_weight: float
    rounds: int
    held_out_rays: int
    frugal_rays: float
    checks: CheckSettings

    def __post_init__(self) -> None:
        check_at_least("task.rounds", self.rounds, 1, "1 fits once, 5 up to 16 times as long")
        check_at_least("task.held_out_rays", self.held_out_rays, 100, "2304 are 48 x 48")
        check_fraction("task.frugal_rays", self.frugal_rays, "0.125 begins with an eighth of the rays")
        check_choice("task.depth_loss", self.depth_loss, DEPTH_LOSSES)
        for name in ("depth_weight", "silhouette_weight"):
            check_positive(f"task.{name}", getattr(self, name), "10 works for both")

    def execute(self, run: RunContext) -> None:
        """Fits all candidates, chooses one, checks the choice, and compares the chosen field with the truth."""
        inputs, record = run.inputs, run.record
        check_field_gradient(inputs.renderer)
        record.definitions = DEFINITIONS | COST_DEFINITIONS | CHOICE_DEFINITIONS
        models, filmstrip = inputs.field.models, Filmstrip(inputs, "by candidate")
        settings = (models.views, self, inputs.renderer, inputs.device, self.held_out_rays)
        views = Views(inputs.scene.raycaster, inputs.views, *settings)
        max_iterations = 2 ** (self.rounds - 1) * models.fit.iterations
        with curve_file(run.folder) as write_line:

            def on_line(name: str, line: dict[str, Any]) -> None:
                write_line({"candidate": name, **line})
                run.progress(f"fitting {name}", line["iteration"] + 1, max_iterations, line["total"])

            candidates = by_size(models.candidates, models.size)
            fitter = Fitter(views.observations(inputs.seed), models.fit, inputs.seed, inputs.device, on_line)
            renderer, settings_notes = inputs.make_renderer(at_pixel_precision)  # before the fits: it may be refused
            growth = grow(fitter, candidates, models.growth)
            fits: list[Fitted] = []
            for fitted in fit_all(fitter, candidates, self.rounds):
                fits.append(fitted)
                record.metrics |= costs(fitted.candidate.name, fitted.evidence)  # in case the run is stopped
                filmstrip.add(fitted.candidate.name, State(fitted.model.frozen(), inputs))
                run.progress("fitting all candidates", len(fits), len(candidates), fitted.evidence.mean)
            evidence = [fitted.evidence for fitted in fits]
            note_fits(record, [*growth.tried, *evidence], fitter)
            check(fits, views, self.checks, seed=inputs.seed)
            choice = choose(evidence, views.footprint, models.size)
            chosen = next(fitted for fitted in fits if fitted.evidence is choice.chosen)
            frugal = refit(chosen, fitter, renderer, fewest_rays=self.frugal_rays)
            metrics = choice_metrics(choice, evidence, growth) | costs("frugal", frugal)
        evaluation, name = evaluate(State(chosen.model.frozen(), inputs)), chosen.candidate.name
        checks = {"footprint": views.footprint, "held_out_seeds": self.checks.seeds}
        metrics = evaluation.metrics | checks | metrics
        comments = [f"pixel precision: {note}" for note in (*settings_notes, precision_text(frugal, chosen.evidence))]
        notes = summary(choice, growth), *final_notes(chosen.renderer), *comments, *evaluation.notes
        note_result(run, replace(evaluation, metrics=metrics, notes=notes))
        filmstrip.save(run.folder, f"{record.title}: needs {name.replace('_', ' ')}", name)
        if inputs.evaluation.picture is not None:
            draw_candidates(run.folder, record.metrics, record.title)


def costs(name: str, evidence: Evidence) -> dict[str, Any]:
    """A fit's error and costs as metrics NAME.…; for a failed fit, its reason."""
    sizes = {measure: evidence.size.by(measure) for measure in SIZE_WORDS}
    if evidence.size.sparse_bytes is not None:
        sizes["sparse_bytes"] = evidence.size.sparse_bytes
    sizes["flops_per_query"] = evidence.flops_per_query
    fit_costs = {key: getattr(evidence, key) for key in ("seconds", "evaluations", "flops", "iterations", "falling")}
    error = evidence.error
    failure = {"failed": f"{evidence.status}: {evidence.reason}"} if error is None else {}
    errors = {} if error is None else {"error": error.mean, "standard_error": error.standard_error}
    held = {key: getattr(evidence, key) for key in ("held_within", "held_enough")}
    errors |= {key: fraction for key, fraction in held.items() if fraction is not None}
    return {f"{name}.{key}": value for key, value in {**sizes, **fit_costs, **errors, **failure}.items()}


def choice_metrics(choice: Choice, evidence: list[Evidence], growth: Growth) -> dict[str, Any]:
    """The choice and the evidence of every candidate, as metrics."""
    chosen, last = choice.chosen, growth.fitted.evidence
    metrics = {
        "recommended_field": chosen.candidate,
        "recommended_by": choice.measure,
        **{f"recommended_{measure}": chosen.size.by(measure) for measure in SIZE_WORDS},
        "recommended_error": chosen.mean,
        "recommended_within": int(choice.within),
        "recommended_enough": int(choice.enough),
        "recommended_confirmed": int(choice.confirmed),
        "best_field": choice.best.candidate,
    }
    for fit in evidence:
        metrics |= costs(fit.candidate, fit)
    metrics |= {"auto.field": last.candidate, **costs("auto", last), "auto.overhead": growth.overhead}
    metrics |= {f"auto.{name}": growth.total(name) for name in ("seconds", "evaluations", "flops")}
    if last.error is not None:
        target = last.mean + last.error.standard_error
        for fit in evidence:
            first: dict[str, float] = next((reached for reached in fit.checkpoints if reached["error"] <= target), {})
            for key in ("seconds", "flops", "evaluations"):
                metrics[f"{fit.candidate}.{key}_at_auto"] = first.get(key)
    return metrics | savings(chosen, evidence)


def savings(chosen: Evidence, evidence: list[Evidence]) -> dict[str, float]:
    """Costs of the papers' network over the chosen candidate's; runtime only if it was fitted in this run."""
    fitted = next((fit for fit in evidence if fit.candidate == PAPER_NETWORK and fit.error is not None), None)
    papers = candidate(PAPER_NETWORK)
    size = Size(papers.stored, papers.stored)
    ratios = {measure: size.by(measure) / chosen.size.by(measure) for measure in SIZE_WORDS}
    ratios["flops_per_query"] = papers.flops / chosen.flops_per_query
    if fitted is not None:
        ratios["seconds"] = fitted.seconds / max(chosen.seconds, MIN_SECONDS)
    return {f"saved_{key}": ratio for key, ratio in ratios.items()}


def precision_text(precise: Evidence, plain: Evidence) -> str:
    if precise.error is None:
        return f"the fit ended as {precise.status}: {precise.reason}"
    fraction = precise.evaluations / max(plain.evaluations, 1)
    error = f"error (x1000) {1000 * precise.mean:.3g} instead of {1000 * plain.mean:.3g}"
    return f"{error}, {100 * fraction:.0f} % of the field values"


def summary(choice: Choice, growth: Growth) -> str:
    chosen, best = choice.chosen, choice.best
    rules = {"within one standard error of the best": choice.within, "under half a pixel": choice.enough}
    why = " and ".join(rule for rule, holds in rules.items() if holds)
    hint = "; no candidate is under half a pixel: more iterations may help" if best.mean > growth.footprint else ""
    noise = best.error.standard_error
    return (
        f"needs {chosen.candidate}, {chosen.size}, the smallest by {SIZE_WORDS[choice.measure]}: "
        f"held-out error (x1000) {1000 * chosen.mean:.3g} is {why} ({best.candidate}, "
        f"{1000 * best.mean:.3g} +- {1000 * noise:.2g}){hint}; field=auto ends on "
        f"{growth.fitted.evidence.candidate}, {1000 * growth.fitted.evidence.mean:.3g}"
    )
