"""The fields with colours for a reconstruction, and the choice among them by `field=auto`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.config import AUTO, PRIOR_FIELD
from bench.evaluate.state import REACH
from bench.records.format import plural
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext
from bench.solve.optimise import History, OptimiserSettings, optimise
from bench.tasks.capacity.candidates import initial_fourier, initial_hash_grid
from bench.tasks.capacity.growth import Trials, climb
from bench.tasks.capacity.held_out import HeldOutError
from bench.tasks.capacity.model import Evidence, Size
from bench.tasks.capacity.names import parse_field_name
from bench.tasks.capacity.observations import TILES_PER_SIDE, tiles
from bench.tasks.reconstruction.pixels import Stack
from bench.tasks.reconstruction.problem import Learnt, ReconstructionProblem
from bench.tasks.reconstruction.subject import Subject
from datasets.shot import Shot
from renderers.checks import BadInput, check_at_least, check_fraction, check_positive
from renderers.fields.networks.coloured import ColouredDistance, ColouredEncoded, ColouredGrid, ColouredOccupancy

NETWORK_FORMS = "network_LAYERSxWIDTH, fourier_LAYERSxWIDTH, hash_LEVELSxLOG2ENTRIES"
FORMS = f"task=reconstruction takes {NETWORK_FORMS}, occupancy_WIDTH or grid_N"
HASH_WIDTH = 64  # neurons per layer of a hash grid's networks, as in Mueller et al. 2022
VALIDATION_STEP = 8  # the trials do not learn from every 8th input photograph: it measures their error
# Errors after 40 iterations do not predict which size ends best; after 80 they mostly do (six validation shapes).
MIN_TRIAL_ITERATIONS = 80
DEFINITIONS = {
    "field": "the field that field=auto ended on",
    "field_free, field_stored, field_bytes": "the numbers of its field and its colours, all of which are learnt, and "
    "their size in float32",
    "field_error": "of its trial: the mean difference of colours from 0 to 1 on photographs set aside, black outside",
    "field_overhead": "seconds of all trials and of the loop over those of the loop",
    "fields_tried": "candidates that were tried",
    "field_evaluations": "field evaluations of the trials, which are not among those of the loop",
    "seconds.trials": "the loops of the trials of field=auto",
}


@dataclass(frozen=True)
class Appearance:
    """The settings of fields with colours, except their size.

    Args:
        octaves: octaves of a distance network's positional encoding.
        directional: whether colours of a distance network depend on the view direction.
        radius: radius of the initial sphere, in scene units.
        slope_width: see `renderers.fields.networks.coloured.ColouredEncoded`.
    """

    octaves: int
    directional: bool
    radius: float
    slope_width: float = 0.0

    def __post_init__(self) -> None:
        check_at_least("task.appearance.octaves", self.octaves, 0, "5 follow details of a pixel at 128 x 128")
        check_positive("task.appearance.radius", self.radius, "0.5 lies within most objects")
        check_at_least("task.appearance.slope_width", self.slope_width, 0, "0.066 is two cells of the finest grid")

    def make(self, name: str) -> Learnt:
        """Builds the initial field of a name.

        Raises:
            BadInput: for the name of a field without colours.
        """
        kind, sizes = (name, ()) if name in (PRIOR_FIELD, AUTO) else parse_field_name(name)
        if self.slope_width and kind not in ("hash", "fourier"):
            raise BadInput(
                f"field={name} has exact slopes: remove task.appearance.slope_width, or take field=hash_8x12"
            )
        if kind == "network":
            layers, width = sizes
            shape = {"layers": layers, "width": width, "octaves": self.octaves}
            return ColouredDistance(**shape, radius=self.radius, directional=self.directional)
        if kind == "occupancy":
            return ColouredOccupancy(width=sizes[0], radius=self.radius)
        if kind in ("hash", "fourier"):
            hashed = kind == "hash"
            encoding = initial_hash_grid(*sizes) if hashed else initial_fourier(sizes[1] // 2)
            layers, width = (1, HASH_WIDTH) if hashed else sizes
            common = {"radius": self.radius, "directional": self.directional, "slope_width": self.slope_width}
            return ColouredEncoded(encoding, layers=layers, width=width, **common)
        if kind == "grid":
            return ColouredGrid(samples=sizes[0], radius=self.radius, reach=REACH)
        raise BadInput(f"field={name} has no colours: {FORMS}")


Make = Callable[[str, Subject], ReconstructionProblem]


@dataclass(frozen=True)
class AutoField:
    """The settings of `field=auto`: each candidate is learnt from the start, for a fraction of a run's iterations.

    Args:
        candidates: names of fields, each once, in any order; see `Appearance.make`.
        trial: fraction of the iterations, which are at least `MIN_TRIAL_ITERATIONS`.
        patience: number of successive larger candidates that may be tried without improvement.
    """

    candidates: tuple[str, ...]
    trial: float
    patience: int

    def __post_init__(self) -> None:
        check_at_least("the length of task.auto.candidates", len(self.candidates), 1, "network_2x64, network_4x128")
        if len(set(self.candidates)) < len(self.candidates):
            raise ValueError(f"task.auto.candidates must name each once, not {', '.join(self.candidates)}")
        check_fraction("task.auto.trial", self.trial, "0.1 shows which one follows the photographs better")
        check_at_least("task.auto.patience", self.patience, 1, "2 looks past one that is no better")

    def choose(
        self, make: Make, sizes: dict[str, int], subject: Subject, settings: OptimiserSettings, run: RunContext
    ) -> "Choice":
        """Tries candidates from the smallest to larger ones, by `bench.tasks.capacity.growth.climb`.

        Errors are measured on input photographs that the trials do not learn from, in groups of tiles: at the end of a
        trial, and after half of it, which shows whether the error still falls. A trial whose optimisation fails has no
        error.

        Args:
            make: builds the problem of a candidate and photographs.
            sizes: the number of free parameters of each candidate.
            subject: all photographs; the held-out ones are not used.
            settings: the settings of the full run.
        """
        validation, device = subject.input_shots[::VALIDATION_STEP], run.inputs.device
        fitted = tuple(shot for index, shot in enumerate(subject.input_shots) if index % VALIDATION_STEP)
        trial_subject = replace(subject, input_shots=fitted)
        pixels = Stack.build(validation, None, device).pixels
        iterations = max(round(self.trial * settings.iterations), MIN_TRIAL_ITERATIONS)
        iterations = min(iterations, settings.iterations)
        budget = settings.budget and settings.budget * iterations / settings.iterations
        trial_settings = replace(settings, iterations=iterations, budget=budget)

        def trial(name: str, trials: Trials) -> Evidence:
            torch.manual_seed(run.inputs.seed)  # each trial starts as it would alone
            problem, history = make(name, trial_subject), History()
            halfway: list[HeldOutError] = []

            def error() -> HeldOutError:
                return tiled(problem.colour_errors(pixels).cpu(), validation)

            def on_step(line: dict[str, Any]) -> None:
                run.progress(f"trying {name}", line["iteration"] + 1, trial_settings.iterations, line["total"])
                if line["iteration"] + 1 == iterations // 2:
                    halfway.append(error())

            optimise(problem, trial_settings, device, history=history, on_step=on_step)
            evidence = Evidence(name, Size(sizes[name], sizes[name]), status=history.status)
            evidence.seconds = history.seconds["forward"] + history.seconds["backward"]
            evidence.evaluations = history.counts.value
            if history.status is RunStatus.OK:
                evidence.error = error()
                evidence.falling = all(  # also after a budget that ended the trial in its first half
                    half.mean - evidence.mean > evidence.error.noise_of_difference(half) for half in halfway
                )
            return evidence

        ordered = sorted(self.candidates, key=lambda name: sizes[name])
        return Choice(climb(ordered, trial, patience=self.patience), len(validation))


@dataclass(frozen=True)
class Choice:
    """All trials, and the number of photographs that measured their errors."""

    trials: Trials
    validation_count: int

    @property
    def kept(self) -> Evidence:
        """The candidate with the least error while that still falls; then the smallest that no larger one improves on.

        A short trial cannot show that a small field suffices: the longer a run, the further its error is behind.
        """
        least = min(self.trials.tried, key=lambda trial: trial.mean)
        return least if least.falling else self.trials.kept[-1]

    @property
    def seconds(self) -> float:
        return sum(trial.seconds for trial in self.trials.tried)

    @property
    def evaluations(self) -> int:
        """Field evaluations of all trials."""
        return sum(trial.evaluations for trial in self.trials.tried)

    @property
    def note(self) -> str:
        errors = ", ".join(f"{trial.candidate} {trial.mean:.3g}" for trial in self.trials.tried)
        text = f"field=auto: {self.kept.candidate}, {self.kept.size.free:,} numbers"
        if self.kept.error is None:
            text += ", though no trial ended well: lower task.optimiser.learning_rate, or raise a task.optimiser.budget"
        photographs = f"{plural(self.validation_count, 'photograph')} set aside"
        spent = f"the trials took {self.seconds:.1f} s and {self.evaluations:,} field evaluations"
        return f"{text}; error of colours on {photographs}, after the trials: {errors}; {spent}"

    def metrics(self, runtime: float) -> dict[str, Any]:
        """The metrics of `DEFINITIONS`, for a run with this runtime in seconds."""
        costs = {"field_overhead": 1 + self.seconds / max(runtime, 1e-9), "fields_tried": len(self.trials.tried)}
        return self.kept.field() | costs | {"field_evaluations": self.evaluations}


def tiled(errors: Float[Tensor, " pixels"], shots: Sequence[Shot]) -> HeldOutError:
    """The mean over tiles of each tile's mean error; `errors` has the pixels of all photographs in a row."""
    tile_numbers = [
        tiles(shot.camera.height, shot.camera.width) + k * TILES_PER_SIDE**2 for k, shot in enumerate(shots)
    ]
    groups = torch.cat(tile_numbers)
    means = (torch.bincount(groups, errors.double()) / torch.bincount(groups)).numpy()
    ones = np.ones_like(means)
    return HeldOutError(np.stack([means, ones, 0 * ones, ones], axis=1), 1.0)
