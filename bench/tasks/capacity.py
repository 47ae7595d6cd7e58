"""How much model a shape needs: fields from four numbers to the papers' network, fitted to the same views."""

import json
from dataclasses import dataclass
from typing import Any

from bench.film import Film
from bench.judge import judge
from bench.ladder.choice import Choice, Evidence
from bench.ladder.fit import Fitter
from bench.ladder.growth import Growth, grow
from bench.ladder.model import FLOAT
from bench.ladder.observations import RayObservations
from bench.ladder.picture import draw_ladder
from bench.ladder.rungs import PAPERS
from bench.ladder.study import CheckSettings, Study
from bench.ladder.views import Views
from bench.metrics import DEFINITIONS
from bench.records import RunStatus, plain
from bench.solve import COSTS
from bench.stage import Cell
from bench.tasks.problem import check_field_gradient
from bench.thickness import ending
from datasets.truth import Truth
from renderers.checks import check_positive, check_share

TINY = 1e-9  # seconds: a clock that did not move
NEEDS = {
    "recommended_field, recommended_parameters, recommended_error": "the smallest rung of the ladder, by free numbers, "
    "whose held-out error is within one standard error of the best rung's or under the footprint; its size, its error",
    "recommended_within, recommended_enough": "1 where the first, the second of these holds",
    "best_field": "the rung of the least held-out error",
    "footprint": "half a pixel where the shape may be nearest (DIST, Eq. 10, theta = 0), in scene units",
    "RUNG.error": "of held-out rays: distance along the field's normal between the observed and the rendered point, at "
    "most 10 footprints; 10 footprints where only one hits; mean over the rays on which either hits, in scene units. "
    "Which rung a later one begins with is chosen by it, too; held_out_seeds are free of that",
    "RUNG.standard_error": "of that mean, by the jackknife over views",
    "RUNG.failed": "why its fit failed",
    "RUNG.parameters, RUNG.bytes, RUNG.flops_per_query": "free numbers; what it takes to keep the field in float32; "
    "floating-point operations of a value, for formulas an estimate",
    "RUNG.seconds, RUNG.evaluations, RUNG.flops": "of its fit, with finding its start and the warm start, "
    "without looks",
    "RUNG.seconds_at_auto, RUNG.flops_at_auto, RUNG.evaluations_at_auto": "when a look first found the error of "
    "field=auto, or less than a standard error more; none where none did",
    "saved_...": "of the papers' network, over that of the recommended rung; seconds only where the network was fitted",
    "auto....": "what early growth (field=auto) ends on; its costs are of all rungs that it tried",
    "auto.overhead": "seconds of all fits of early growth over those of the one that it ended on, without looks at "
    "what is held out",
    "auto.overhead_judged": "the same with looks and with what it takes to begin",
    "frugal....": "the recommended rung fitted again with renderer.epsilon=auto, renderer.steps=auto and the rays of "
    "an iteration from the loss",
    "precision....": "held-out rays rendered at the renderer's own epsilon and steps, and at auto (Eqs. 8, 10)",
    "held_out_seeds": "draws of views that no choice has seen",
    "held_out_seeds_within, held_out_seeds_held": "share of them on which the recommended rung is within one standard "
    "error of the draw's best rung; on which it is, or is under the footprint",
}


@dataclass(frozen=True)
class Capacity:
    """Fits a ladder of fields to views of a shape, and recommends the smallest that will do.

    Args:
        depth_weight, silhouette_weight: see `bench.tasks.completion.Completion`.
        frugal_rays: share of the rays that the frugal fit of the recommended rung begins with.
        checks: by which the choice is checked afterwards.
    """

    depth_weight: float
    silhouette_weight: float
    frugal_rays: float
    checks: CheckSettings

    def __post_init__(self) -> None:
        check_share("task.frugal_rays", self.frugal_rays, "0.125 begins with an eighth of the rays")
        for name in ("depth_weight", "silhouette_weight"):
            check_positive(f"task.{name}", getattr(self, name), "10 works for both")

    def execute(self, cell: Cell) -> None:
        """Fits, chooses, checks, and lets the truth judge what was chosen."""
        stage, record = cell.stage, cell.record
        check_field_gradient(stage.renderer)
        record.definitions = DEFINITIONS | COSTS | NEEDS
        ladder, film = stage.ladder, Film(stage, "by rung")
        views = Views(Truth(stage.scene.mesh), stage.views, ladder.views, self, stage.renderer, stage.device)
        observations = views.observations(stage.seed)
        with (cell.folder / "curve.jsonl").open("w", buffering=1, encoding="utf-8") as curve:

            def on_line(name: str, line: dict[str, Any]) -> None:
                curve.write(json.dumps(plain({"rung": name, **line}), allow_nan=False) + "\n")

            rungs, fitter = ladder.all(), Fitter(observations, ladder.fit, stage.seed, stage.device, on_line)
            frugal, settled = stage.frugal
            study = Study(fitter, frugal, self.frugal_rays)
            growth = grow(fitter, rungs, ladder.growth)
            for fitted in study.climb(rungs):
                record.metrics |= costs(fitted.rung.name, fitted.evidence)  # should the run be stopped
                film.shoot(fitted.rung.name, fitted.model.frozen(), stage.scene.view.camera)
                cell.progress("climbing", len(study.fits), len(rungs), fitted.evidence.mean)
            evidence = [fitted.evidence for fitted in study.fits]
            _note_costs(cell, fitter, observations, [*growth.tried, *evidence])
            choice, chosen = study.choose()
            metrics = needs(choice, evidence, growth) | study.check(chosen, views, self.checks)
            metrics |= costs("frugal", study.refit(chosen)) | study.precision(chosen, observations.held_out.rays)
        judged = judge(chosen.model.frozen(), stage)
        record.metrics = judged.metrics | {"footprint": views.footprint} | metrics
        record.status, record.reason = RunStatus.OK, ""
        if judged.mesh is None:
            record.status, record.reason = RunStatus.EMPTY, "the recommended field has no surface in the unit sphere"
        else:
            judged.mesh.save(cell.folder / "mesh.ply")
        frugality = [f"frugal: {note}" for note in [*settled, *frugal_told(metrics, chosen.rung.name)]]
        record.notes = [*record.notes, told(choice, growth), *ending(chosen.renderer), *frugality]
        title = f"{record.task}, {record.name}, {record.scene}"
        film.save(cell.folder, f"{title}: needs {chosen.rung.name.replace('_', ' ')}", chosen.rung.name)
        if stage.evaluation.picture is not None:
            draw_ladder(cell.folder, record.metrics, title)


def _note_costs(cell: Cell, fitter: Fitter, observations: RayObservations, evidence: list[Evidence]) -> None:
    rays = sum(rung.iterations for rung in evidence) * observations.rays
    values = sum(rung.evaluations for rung in evidence)
    cell.record.seconds |= fitter.spent
    cell.record.flops = sum(rung.flops for rung in evidence)
    cell.record.evaluations = {
        "value": values,
        "gradient": sum(rung.gradients for rung in evidence),
        "per_ray": values / max(rays, 1),
        "observed": int(observations.given.observed.sum() + observations.held_out.observed.sum()),
    }


def costs(name: str, evidence: Evidence) -> dict[str, Any]:
    """A fit's error and costs, as metrics of that name; what it lacks, where it failed."""
    known = {key: getattr(evidence, key) for key in ("parameters", "bytes", "flops_per_query")}
    spent = {key: getattr(evidence, key) for key in ("seconds", "evaluations", "flops")}
    error = evidence.error
    how = {"failed": f"{evidence.status}: {evidence.reason}"} if error is None else {}
    errors = {} if error is None else {"error": error.mean, "standard_error": error.standard_error}
    return {f"{name}.{key}": value for key, value in {**known, **spent, **errors, **how}.items()}


def needs(choice: Choice, evidence: list[Evidence], growth: Growth) -> dict[str, Any]:
    """What a shape needs, with the evidence of every rung, as metrics."""
    chosen, last = choice.chosen, growth.fitted.evidence
    metrics = {
        "recommended_field": chosen.rung,
        "recommended_parameters": chosen.parameters,
        "recommended_error": chosen.mean,
        "recommended_within": int(choice.within),
        "recommended_enough": int(choice.enough),
        "best_field": choice.best.rung,
    }
    for one in evidence:
        metrics |= costs(one.rung, one)
    metrics |= {"auto.field": last.rung, **costs("auto", last), "auto.overhead": growth.overhead}
    metrics["auto.overhead_judged"] = growth.overhead_judged
    metrics |= {f"auto.{name}": growth.total(name) for name in ("seconds", "evaluations", "flops")}
    if last.error is not None:
        target = last.mean + last.error.standard_error
        for one in evidence:
            reached: dict[str, float] = next((look for look in one.looks if look["error"] <= target), {})
            metrics |= {f"{one.rung}.{key}_at_auto": reached.get(key) for key in ("seconds", "flops", "evaluations")}
    return metrics | saved(chosen, evidence)


def saved(chosen: Evidence, evidence: list[Evidence]) -> dict[str, float]:
    """The papers' network over the chosen rung; its time only where it was fitted here."""
    fitted = next((one for one in evidence if one.rung == PAPERS.name and one.error is not None), None)
    network = {"parameters": PAPERS.size, "flops_per_query": PAPERS.flops, "bytes": FLOAT * PAPERS.size}
    if fitted is not None:
        network["seconds"] = fitted.seconds
    return {f"saved_{key}": value / max(getattr(chosen, key), TINY) for key, value in network.items()}


def frugal_told(metrics: dict[str, Any], rung: str) -> list[str]:
    """What the frugal fit came to beside the plain one, and what rendering at its precision changes, in words."""
    if "frugal.error" not in metrics:
        return [f"the fit ended as {metrics['frugal.failed']}"]
    values = metrics["frugal.evaluations"] / max(metrics[f"{rung}.evaluations"], 1)
    lost, gained, hits = (metrics[f"precision.{name}"] for name in ("lost", "gained", "hits"))
    error = f"error (x1000) {1000 * metrics['frugal.error']:.3g} instead of {1000 * metrics[f'{rung}.error']:.3g}"
    return [f"{error}, {100 * values:.0f} % of the field values; of {hits} hits {lost} lost, {gained} gained"]


def told(choice: Choice, growth: Growth) -> str:
    """The recommendation, in words."""
    chosen, best = choice.chosen, choice.best
    rules = {"within one standard error of the best": choice.within, "under half a pixel": choice.enough}
    why = " and ".join(rule for rule, holds in rules.items() if holds)
    short = "; no rung is under half a pixel: longer fits or more rungs may be" if best.mean > growth.footprint else ""
    noise = best.error.standard_error
    return (
        f"needs {chosen.rung}, {chosen.parameters} numbers: its held-out error (x1000) {1000 * chosen.mean:.3g} is "
        f"{why} ({best.rung}, {1000 * best.mean:.3g} +- {1000 * noise:.2g}){short}; field=auto ends on "
        f"{growth.fitted.evidence.rung}, {1000 * growth.fitted.evidence.mean:.3g}"
    )
