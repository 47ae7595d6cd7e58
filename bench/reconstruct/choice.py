"""The fields with colours that a shape can be learnt as, and the one that a reconstruction takes with `field=auto`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.state import REACH
from bench.models.growth import Trials, climb
from bench.models.held_out import HeldOutError
from bench.models.model import Evidence, Size
from bench.models.observations import TILES_PER_SIDE, tiles
from bench.reconstruct.pixels import Stack
from bench.reconstruct.problem import Learnt, ReconstructionProblem
from bench.reconstruct.subject import Subject
from bench.records.format import plural
from bench.records.record import RunStatus
from bench.setup.auto import AUTO
from bench.setup.fields import PRIOR, parse_field_name
from bench.setup.inputs import RunContext
from bench.solve.optimise import History, OptimiserSettings, optimise
from datasets.shot import Shot
from renderers.checks import BadInput, check_at_least, check_positive, check_share
from renderers.fields.coloured import ColouredDistance, ColouredGrid, ColouredOccupancy

FORMS = "task=reconstruction takes network_LAYERSxWIDTH, occupancy_WIDTH or grid_N"
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


@dataclass(frozen=True)
class Appearance:
    """What fields with colours are made of, beside their size.

    Args:
        octaves: of the positional encoding of a distance network.
        directional: whether colours of a distance network depend on the view direction.
        radius: of the sphere that all begin as, in scene units.
    """

    octaves: int
    directional: bool
    radius: float

    def __post_init__(self) -> None:
        check_at_least("task.appearance.octaves", self.octaves, 0, "5 follow details of a pixel at 128 x 128")
        check_positive("task.appearance.radius", self.radius, "0.5 lies within most objects")

    def make(self, name: str) -> Learnt:
        """The field of that name at its start.

        Raises:
            BadInput: for a name that has no colours.
        """
        kind, sizes = (name, ()) if name in (PRIOR, AUTO) else parse_field_name(name)
        if kind == "network":
            layers, width = sizes
            shape = {"layers": layers, "width": width, "octaves": self.octaves}
            return ColouredDistance(**shape, radius=self.radius, directional=self.directional)
        if kind == "occupancy":
            return ColouredOccupancy(width=sizes[0], radius=self.radius)
        if kind == "grid":
            return ColouredGrid(samples=sizes[0], radius=self.radius, reach=REACH)
        raise BadInput(f"field={name} has no colours: {FORMS}")


Make = Callable[[str, Subject], ReconstructionProblem]


@dataclass(frozen=True)
class AutoField:
    """How `field=auto` tries candidates, each from the start, for a share of a whole run.

    Args:
        candidates: their names, each once, in any order; see `Appearance.make`.
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
        """Tries candidates from the smallest on, and keeps the one that `bench.models.growth.climb` ends on.

        Errors are of photographs that are given, but not to the trials; groups are tiles of these. A trial whose loss
        fails has no error.

        Args:
            make: the problem of a candidate and photographs.
            sizes: the free numbers of each candidate.
            subject: all photographs; those that are held out are not used.
            settings: of the whole run.
        """
        aside, rest = subject.given[::ASIDE], [shot for place, shot in enumerate(subject.given) if place % ASIDE]
        part, device = replace(subject, given=tuple(rest)), run.inputs.device
        brief = replace(settings, iterations=max(round(self.trial * settings.iterations), 1))

        def trial(name: str, trials: Trials) -> Evidence:
            torch.manual_seed(run.inputs.seed)  # each begins as it would alone
            problem, history = make(name, part), History()

            def on_step(line: dict[str, Any]) -> None:
                run.progress(f"trying {name}", line["iteration"] + 1, brief.iterations, line["total"])

            optimise(problem, brief, device, history=history, on_step=on_step)
            found = Evidence(name, Size(sizes[name], sizes[name]), status=history.status)
            found.seconds = history.seconds["forward"] + history.seconds["backward"]
            found.evaluations = history.counts.value
            if history.status is RunStatus.OK:
                found.error = tiled(problem.colour_errors(Stack.of(aside, None, device).pixels).cpu(), aside)
            return found

        ordered = sorted(self.candidates, key=lambda name: sizes[name])
        return Choice(climb(ordered, trial, patience=self.patience), len(aside))


@dataclass(frozen=True)
class Choice:
    """All trials, and the number of photographs that were set aside for them."""

    trials: Trials
    aside: int

    @property
    def kept(self) -> Evidence:
        """The trial of the field that is taken."""
        return self.trials.kept[-1]

    @property
    def seconds(self) -> float:
        """Of the loops of all trials."""
        return sum(trial.seconds for trial in self.trials.tried)

    @property
    def note(self) -> str:
        """The result, in words."""
        errors = ", ".join(f"{trial.candidate} {trial.mean:.3g}" for trial in self.trials.tried)
        values = sum(trial.evaluations for trial in self.trials.tried)
        found = f"field=auto: {self.kept.candidate}, {self.kept.size.free:,} numbers"
        if self.kept.error is None:
            found += ", though no trial ended well: lower task.optimiser.learning_rate"
        aside = f"{plural(self.aside, 'photograph')} set aside"
        spent = f"the trials took {self.seconds:.1f} s and {values:,} values"
        return f"{found}; error of colours on {aside}, after the trials: {errors}; {spent}"

    def metrics(self, loop: float) -> dict[str, Any]:
        """The metrics of `DEFINITIONS`, for a run whose loop took so many seconds."""
        overhead = {"field_overhead": 1 + self.seconds / max(loop, 1e-9), "fields_tried": len(self.trials.tried)}
        return self.kept.field() | overhead


def tiled(errors: Float[Tensor, " pixels"], shots: Sequence[Shot]) -> HeldOutError:
    """The mean over tiles of the mean error of their pixels, which are those of all photographs in a row."""
    places = [tiles(shot.camera.height, shot.camera.width) + k * TILES_PER_SIDE**2 for k, shot in enumerate(shots)]
    groups = torch.cat(places)
    means = (torch.bincount(groups, errors.double()) / torch.bincount(groups)).numpy()
    one = np.ones_like(means)
    return HeldOutError(np.stack([means, one, 0 * one, one], axis=1), 1.0)
