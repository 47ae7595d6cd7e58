"""The field that a reconstruction takes with `field=auto`: the smallest that no larger one improves on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.models.model import Size
from bench.models.observations import TILES, tiles
from bench.reconstruct.pixels import Pixels, Stack
from bench.reconstruct.subject import Subject
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext
from bench.solve.optimise import History, optimise
from bench.solve.problem import Objective, OptimiserSettings
from datasets.shot import Shot
from renderers.checks import check_at_least, check_share

ASIDE = 8  # of so many given photographs one is set aside for the trials
DEFINITIONS = {
    "field": "the field that field=auto ended on",
    "field_free, field_stored, field_bytes": "the numbers of its field and its colours, all of which are learnt, and "
    "their size in float32",
    "field_error": "of its trial: the mean difference of colours from 0 to 1 on photographs set aside, black outside",
    "field_overhead": "seconds of all trials and of the loop over those of the loop",
    "fields_tried": "candidates that were tried",
    "seconds.trials": "the loops of the trials of field=auto; their evaluations are not among those of the loop",
}


@runtime_checkable
class Learning(Objective, Protocol):
    """The problem of a candidate; see `bench.reconstruct.problem.ReconstructionProblem`."""

    def colour_errors(self, pixels: Pixels) -> Float[Tensor, " n"]:
        """The error of each pixel's colours, at the current parameters."""
        ...


Make = Callable[[str, Subject], Learning]


@dataclass(frozen=True)
class AutoField:
    """How `field=auto` tries candidates, each from the start, for a share of a whole run.

    Args:
        candidates: their names, each once, in any order; see `bench.reconstruct.models.Appearance.make`.
        trial: share of the iterations.
        patience: successive larger candidates that may be tried without improvement.
    """

    candidates: tuple[str, ...]
    trial: float
    patience: int

    def __post_init__(self) -> None:
        check_at_least("the length of task.auto.candidates", len(self.candidates), 1, "network_2x64, network_4x128")
        if len(set(self.candidates)) < len(self.candidates):
            raise ValueError(f"task.auto.candidates must name each once, not {', '.join(self.candidates)}")
        check_share("task.auto.trial", self.trial, "0.1 shows which one follows the photographs better")
        check_at_least("task.auto.patience", self.patience, 1, "2 looks past one that is no better")

    def choose(
        self, make: Make, sizes: dict[str, int], subject: Subject, settings: OptimiserSettings, run: RunContext
    ) -> "Choice":
        """Tries candidates from the smallest on, and keeps one that lowers the error by more than its noise.

        Errors are of photographs that are given, but not to the trials. The noise is the standard error of the
        difference over the same tiles of these. It is that of the photographs alone: another start, as of another
        seed, may end a trial with another error.

        Args:
            make: the problem of a candidate and photographs.
            sizes: the free numbers of each candidate.
            subject: all photographs; those that are held out are not used.
            settings: of the whole run.
            run: whose progress is reported.
        """
        aside, rest = subject.given[::ASIDE], [shot for place, shot in enumerate(subject.given) if place % ASIDE]
        part = replace(subject, given=tuple(rest))
        brief = replace(settings, iterations=max(round(self.trial * settings.iterations), 1))
        tried: list[Trial] = []
        best, worse = 0, 0
        for name in sorted(self.candidates, key=lambda name: sizes[name]):
            if worse == self.patience:
                break
            torch.manual_seed(run.inputs.seed)  # each begins as it would alone
            tried.append(_tried(name, sizes[name], make(name, part), aside, brief, run))
            better = len(tried) > 1 and tried[-1].better_than(tried[best])
            best, worse = (len(tried) - 1, 0) if better else (best, worse + (len(tried) > 1))
        return Choice(tuple(tried), best, len(aside))


@dataclass(frozen=True)
class Trial:
    """A candidate after its trial: the mean error of each tile, its size, and what the loop cost."""

    name: str
    errors: Float[np.ndarray, " tiles"]
    free: int
    seconds: float
    values: int

    def better_than(self, other: "Trial") -> bool:
        """Whether its error is lower by more than the standard error of the difference."""
        if not np.isfinite(self.errors).all() or not np.isfinite(other.errors).all():
            return bool(np.isfinite(self.errors).all())
        apart = other.errors - self.errors
        return bool(apart.mean() > apart.std(ddof=1) / np.sqrt(len(apart)))


@dataclass(frozen=True)
class Choice:
    """All trials, the place of the one that is kept, and the number of photographs that were set aside for them."""

    trials: tuple[Trial, ...]
    place: int
    aside: int

    @property
    def kept(self) -> Trial:
        """The trial of the field that is taken."""
        return self.trials[self.place]

    @property
    def seconds(self) -> float:
        """Of the loops of all trials."""
        return sum(trial.seconds for trial in self.trials)

    @property
    def note(self) -> str:
        """The result, in words."""
        errors = ", ".join(f"{trial.name} {trial.errors.mean():.3g}" for trial in self.trials)
        values = sum(trial.values for trial in self.trials)
        found = f"field=auto: {self.kept.name}, {self.kept.free:,} numbers"
        if not np.isfinite(self.kept.errors).all():
            found += ", though no trial ended well: lower task.optimiser.learning_rate"
        aside = f"{self.aside} photograph{'s' if self.aside > 1 else ''} set aside"
        spent = f"the trials took {self.seconds:.1f} s and {values:,} values"
        return f"{found}; error of colours on {aside}, after the trials: {errors}; {spent}"

    def metrics(self, loop: float) -> dict[str, Any]:
        """The metrics of `DEFINITIONS`, for a run whose loop took so many seconds."""
        size, error = Size(self.kept.free, self.kept.free), float(self.kept.errors.mean())
        sizes = {"field_free": size.free, "field_stored": size.stored, "field_bytes": size.bytes}
        overhead = {"field_overhead": 1 + self.seconds / max(loop, 1e-9), "fields_tried": len(self.trials)}
        return {"field": self.kept.name, **sizes, "field_error": error, **overhead}


def _tried(
    name: str, free: int, problem: Learning, aside: Sequence[Shot], brief: OptimiserSettings, run: RunContext
) -> Trial:
    """A candidate's trial; one whose loss fails has infinite errors."""
    history = History()

    def on_step(line: dict[str, Any]) -> None:
        run.progress(f"trying {name}", line["iteration"] + 1, brief.iterations, line["total"])

    optimise(problem, brief, run.inputs.device, history=history, on_step=on_step)
    costs = free, history.seconds["forward"] + history.seconds["backward"], history.counts.value
    groups = torch.cat(
        [tiles(shot.camera.height, shot.camera.width) + place * TILES**2 for place, shot in enumerate(aside)]
    )
    if history.status is not RunStatus.OK:
        return Trial(name, np.full(len(aside) * TILES**2, np.inf), *costs)
    errors = problem.colour_errors(Stack.of(aside, None, run.inputs.device).pixels).cpu()
    sums = torch.bincount(groups, errors.double()) / torch.bincount(groups)
    return Trial(name, sums.numpy(), *costs)
