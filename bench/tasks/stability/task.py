"""Stress tests: the severity at which half of a renderer's trials fail."""

from collections import Counter
from dataclasses import dataclass, field, replace
from operator import attrgetter

import numpy as np

from bench.machine.limits import Limits
from bench.records.format import breakdown, plural
from bench.records.record import RunStatus, curve_file
from bench.setup.inputs import RunContext, RunInputs
from bench.tasks.stability import fit, judge
from bench.tasks.stability.axes import Stress
from bench.tasks.stability.distortions import NETWORK_DISTORTIONS
from bench.tasks.stability.picture import draw_breakdown
from bench.tasks.stability.search import Bisection, Search, SearchSettings
from bench.tasks.stability.trial import Conditions, Criteria, Failure, FitSettings, Trial
from datasets.scene import HasNetwork
from renderers.checks import BadInput, check_at_least
from renderers.rendering import Renderer, Unsupported

DEFINITIONS = {
    "breakdown": "severity at which half of the trials succeed, in the unit of task.stress.sweep: the median of the "
    "posterior, for a logistic curve with a lapse of 2 %; none where it is outside the sweep",
    "breakdown_low, breakdown_high": "ends of its 95 % interval, the milder first; none where it is outside the sweep, "
    "and where repeats of a trial cannot differ (task.stress.repeats=1)",
    "level, level_low, level_high": "the same from 0, the mild end of the sweep, to 1, the severe one, and beyond",
    "width": "of the logistic curve, in levels; the most probable of five; none without repeats",
    "trials": "renderings, gradients or fits that were made",
    "grid_trials": "trials of a full grid of task.search.levels and repeats",
    "mild_successes, mild_trials, severe_successes, severe_trials": "at the two ends of the sweep",
    "failed_...": "trials that failed in this way; each counts once, as its most frequent kind of failure",
    "evaluations_per_ray": "field values per ray; median of the trials at the mild end",
}
MEASURE_DEFINITIONS = {"rendering": judge.RENDERING_NUMBERS, "gradient": judge.GRADIENT_NUMBERS, "fit": fit.DEFINITIONS}


@dataclass(frozen=True)
class Stability:
    """Finds the breakdown of a renderer under one stress, by an adaptive search.

    Args:
        stress: the axis of the test.
        search: resolution and length of the search.
        fit_search: the same for measure=fit, whose trials take longer.
        criteria: criteria of success.
        fit: the fit of measure=fit.
        resolution: height and width of a rendering, in pixels.
        limits: limits of each trial; for a fit, of all its steps together.
    """

    stress: Stress | None
    search: SearchSettings
    fit_search: SearchSettings
    criteria: Criteria
    fit: FitSettings
    resolution: int
    limits: Limits

    def __post_init__(self) -> None:
        if self.stress is None:
            raise ValueError(
                "task=stability needs a stress: set stress=thin_plate, or another: conf/README.md lists all"
            )
        check_at_least("task.resolution", self.resolution, 8, "64 resolves thin parts")

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput for a user's network under a stress that does not use it."""
        if not isinstance(inputs.dataset, HasNetwork):
            return
        scene, stresses = self.stress.scene, ", ".join(NETWORK_DISTORTIONS)
        if scene not in NETWORK_DISTORTIONS:
            raise BadInput(f"the stress {scene} renders no network: remove field=file, or set stress={stresses}")
        if scene == "far_code" and inputs.prior.decoder.code_is_position:
            raise BadInput("the network has no code that the stress far_code could change: set stress=noisy_weights")

    def execute(self, run: RunContext) -> None:
        """Searches; fills the record, writes a line per trial to curve.jsonl, and draws both sides of the breakdown."""
        record, renderer = run.record, run.inputs.renderer
        prior = run.inputs.prior if self.stress.needs_prior else None
        conditions = Conditions(self.resolution, self.fit, self.criteria, self.limits, run.inputs.device, prior)
        record.definitions = DEFINITIONS | MEASURE_DEFINITIONS[self.stress.measure]
        record.scene = record.dataset.replace("_", " ")
        self._check(renderer)
        search = Bisection(self._settings) if self.stress.repeats == 1 else Search(self._settings)
        trials = _Trials()
        with curve_file(run.folder) as write_line:
            while (index := search.next()) is not None:
                level = float(search.levels[index])
                repeat = trials.successes_at(level)[1]
                outcome = self.stress.trial(renderer, level, repeat, conditions)
                search.note(index, outcome.success)
                trials.add(Trial(level, self.stress.sweep.severity(level), repeat, outcome))
                write_line(trials.line())
                run.progress("searching", len(trials.all), search.max_trials, None)
        record.metrics = self._metrics(search, trials)
        record.evaluations = {"per_ray": record.metrics["evaluations_per_ray"]}
        record.status, record.reason = trials.status()
        record.notes = [*record.notes, *trials.warnings()]
        if around := trials.around(search.result().level):
            counts = [trials.failures_in_words(trial.level) for trial in around]
            title = [f"{record.scene}: {record.name} {breakdown(record.metrics, vars(self.stress.sweep))}"]
            title += [f"{trials.failures_in_words()}; a breakdown is the severity at which half of the trials fail"]
            title += [self.criteria.of_renderings]
            unit = self.stress.sweep.unit
            record.pictures = draw_breakdown(run.folder, around, counts, unit=unit, title="\n".join(title))

    def _check(self, renderer: Renderer) -> None:
        """Raises Unsupported before the first trial if the renderer rejects the setting at the mild end."""
        try:
            self.stress.stressed(renderer, self.stress.sweep.mild)
        except (ValueError, TypeError) as error:
            raise Unsupported(f"{type(renderer).__name__} refuses {self.stress.setting}: {error}") from None

    @property
    def _settings(self) -> SearchSettings:
        return self.fit_search if self.stress.measure == "fit" else self.search

    def _metrics(self, search: Search | Bisection, trials: "_Trials") -> dict[str, float | None]:
        breakdown, severity = search.result(), self.stress.sweep.severity
        levels = {"": breakdown.level, "_low": breakdown.low, "_high": breakdown.high}
        (mild, milds), (severe, severes) = trials.successes_at(0), trials.successes_at(1)
        failed = Counter(trial.outcome.failure for trial in trials.all)
        at_mild = [trial.outcome.numbers for trial in trials.all if trial.level == 0]
        costs = [numbers["evaluations_per_ray"] for numbers in at_mild if "evaluations_per_ray" in numbers]
        return {
            **{f"breakdown{end}": severity(x) if x is not None and 0 <= x <= 1 else None for end, x in levels.items()},
            **{f"level{end}": level for end, level in levels.items()},
            "width": breakdown.width,
            "trials": len(trials.all),
            "grid_trials": search.grid_trials,
            "mild_successes": mild,
            "mild_trials": milds,
            "severe_successes": severe,
            "severe_trials": severes,
            "evaluations_per_ray": float(np.median(costs)) if costs else None,
            **{f"failed_{kind.replace(' ', '_')}": failed[kind] for kind in Failure if kind and failed[kind]},
        }


@dataclass
class _Trials:
    """All trials of a search, and those that its pictures may show, with images."""

    all: list[Trial] = field(default_factory=list)
    with_images: list[Trial] = field(default_factory=list)

    def add(self, trial: Trial) -> None:
        self.with_images += [trial] if trial.outcome.images else []
        self.all.append(replace(trial, outcome=replace(trial.outcome, images={})))

    def around(self, level: float) -> list[Trial]:
        """The severest success up to this level, and the mildest failure from it on; either may be missing."""
        works = [trial for trial in self.with_images if trial.outcome.success and trial.level <= level]
        breaks = [trial for trial in self.with_images if not trial.outcome.success and trial.level >= level]
        by_level = attrgetter("level")
        return [*([max(works, key=by_level)] if works else []), *([min(breaks, key=by_level)] if breaks else [])]

    def status(self) -> tuple[RunStatus, str]:
        """The status of the run and its reason: crashed if every trial raised an error."""
        if all(trial.outcome.failure is Failure.CRASHED for trial in self.all):
            return RunStatus.CRASHED, f"every trial raised an error: {self.all[-1].outcome.message}"
        return RunStatus.OK, ""

    def warnings(self) -> list[str]:
        """Reasons to doubt the breakdown: trials that raised errors, or success that grows with severity."""
        raised = [trial.outcome.message for trial in self.all if trial.outcome.failure is Failure.CRASHED]
        notes = [f"{len(raised)} of {len(self.all)} trials raised an error, the last: {raised[-1]}"] if raised else []
        (mild, milds), (severe, severes) = self.successes_at(0), self.successes_at(1)
        if severe * milds > mild * severes:
            notes.append("success does not fall with severity: more trials succeed at the severe end than at the mild")
        return notes

    def failures_in_words(self, level: float | None = None) -> str:
        """The failed trials of a level, or of all levels, such as "3 of 4 trials failed"."""
        outcomes = [trial.outcome.success for trial in self.all if level in (None, trial.level)]
        return f"{outcomes.count(False)} of {plural(len(outcomes), 'trial')} failed"

    def successes_at(self, level: float) -> tuple[int, int]:
        outcomes = [trial.outcome.success for trial in self.all if trial.level == level]
        return sum(outcomes), len(outcomes)

    def line(self) -> dict[str, object]:
        last = self.all[-1]
        numbers = {"level": last.level, "severity": last.severity, "success": last.outcome.success}
        failed = {"failure": str(last.outcome.failure), "message": last.outcome.message}
        return {"trial": len(self.all) - 1, **numbers, **failed, **last.outcome.numbers}
