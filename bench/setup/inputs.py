"""What a task works with: its inputs, and the run under way."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch

from bench.config import EvaluationSettings
from bench.progress import Report
from bench.records.record import Record
from bench.setup.fields import FieldChoice
from bench.shape_prior import Prior
from datasets.own_photographs import Photographed
from datasets.scene import Dataset, Scene
from datasets.views import ViewSampler
from renderers.checks import BadInput
from renderers.rendering import Renderer, final_notes


@dataclass(frozen=True)
class RunInputs:
    """What a run works with."""

    renderer: Renderer
    views: ViewSampler
    scene_name: str
    make_scene: Callable[[], Scene]
    make_prior: Callable[[], Prior]
    evaluation: EvaluationSettings
    seed: int
    device: torch.device
    cache: Path  # folder of priors and references
    field: FieldChoice  # what an unknown shape is made of
    dataset: Dataset | None = None  # of the scene
    notes: tuple[str, ...] = ()  # on settings with the value `auto`
    make_pixel_precise: Callable[[], tuple[Renderer, list[str]]] | None = None
    photographed: Photographed | None = None  # the dataset, where it has photographs and no true shape
    trained: int | None = None  # number of the scene's shape in the prior's training; None where it was not in it

    @cached_property
    def scene(self) -> Scene:
        """The scene, made at its first use: not every task needs one."""
        return self.make_scene()

    @cached_property
    def pixel_precise(self) -> tuple[Renderer, list[str]]:
        """The renderer at pixel precision, with no more steps than that takes, and notes on these settings."""
        return (self.renderer, []) if self.make_pixel_precise is None else self.make_pixel_precise()

    @property
    def last_notes(self) -> list[str]:
        """Notes at the end of a run: repairs of the scene's mesh, if it was made, and the final number of samples."""
        repairs = self.scene.mesh.repairs if "scene" in vars(self) else ()
        return [*repairs, *final_notes(self.renderer)]

    @cached_property
    def prior(self) -> Prior:
        """The prior of the dataset, loaded or trained at its first use: not every task needs one."""
        with torch.random.fork_rng():  # training a prior must not change later random draws
            return self.make_prior()

    def check_fitted(self) -> int:
        """The place of the scene's shape among the codes of the prior.

        Raises:
            BadInput: where the prior was not trained on that shape.
        """
        if self.trained is None:
            raise BadInput("the task renders a network at the shape that it was fitted to: add +experiment=fitted")
        return self.trained

    def fitted(self) -> Prior:
        """The prior with the code of the scene's shape alone; raises as `check_fitted` does."""
        code = self.check_fitted()
        return Prior(self.prior.decoder, self.prior.codes[code : code + 1])


@dataclass(frozen=True)
class RunContext:
    """A run in progress: its inputs, its folder, its record, which is filled as it goes, and its progress report."""

    inputs: RunInputs
    folder: Path
    record: Record
    progress: Report

    @contextmanager
    def off_clock(self) -> Iterator[None]:
        """Within it, what is not part of the loop's time: its seconds count as the evaluation's."""
        clock = time.perf_counter()
        yield
        seconds = self.record.seconds
        seconds["evaluation"] = seconds.get("evaluation", 0.0) + time.perf_counter() - clock
