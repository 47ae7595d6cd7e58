"""Builds the objects that a run's configuration describes."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig

from bench.config import EvaluationSettings, build
from bench.machine.environment import pick_device, using_threads
from bench.progress import Report
from bench.records.record import Record
from bench.setup.auto import AUTO, at_pixel_precision, resolved
from bench.setup.fields import FieldChoice
from bench.shape_prior.autodecoder import Prior
from bench.shape_prior.store import prior_for, prior_settings
from datasets.dataset import Dataset, Split
from datasets.own_photographs import Photographed
from datasets.scene import Scene, make_scene, scene_name
from datasets.views import ViewSampler
from renderers.adaptive_samples import follow
from renderers.checks import BadInput
from renderers.rendering import Renderer, final_notes

WIDE = 256  # neurons per layer: a narrower network is evaluated by one thread
ALL_THREADS = torch.get_num_threads()  # that PyTorch takes by itself


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
    trained: int | None = None  # which of the prior's training shapes the scene's shape is, if it is one

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


def set_up(config: DictConfig, progress: Report) -> RunInputs:
    """Builds everything that a configuration names, and checks all of it before the first slow step.

    Raises:
        ValueError: for anything invalid in it.
    """
    device = pick_device(config.device)
    views = build(config.view, "view", target="datasets.views.ViewSampler")
    renderer, notes = _renderer(config, config.renderer, views)
    dataset = cast(Dataset, build(config.dataset, "dataset", list(config.packages)))
    evaluation = build(config.evaluation, "evaluation", target="bench.config.EvaluationSettings")
    settings = prior_settings(config)
    torch.set_num_threads(config.threads or threads_for(settings.network.width))
    cache = Path(config.priors_dir)
    torch.manual_seed(config.seed)
    trained = config.index if config.split == Split.TRAIN and config.index < settings.shapes else None

    def shape_and_view() -> Scene:
        return make_scene(dataset, views, split=Split(config.split), index=config.index)

    def make_prior() -> Prior:
        with using_threads(config.threads or ALL_THREADS):  # training pays with more of them
            return prior_for(dataset, settings, cache, device, progress)

    return RunInputs(
        renderer=renderer,
        views=views,
        scene_name=_scene_name(dataset, config),
        make_pixel_precise=lambda: _renderer(config, at_pixel_precision(config.renderer), views),
        make_scene=shape_and_view,
        make_prior=make_prior,
        evaluation=evaluation,
        seed=config.seed,
        device=device,
        cache=cache,
        field=FieldChoice(config.field, build(config.models, "models", target="bench.setup.fields.ModelSettings")),
        dataset=dataset,
        notes=tuple(notes),
        photographed=dataset if isinstance(dataset, Photographed) else None,
        trained=trained,
    )


def _scene_name(dataset: Dataset, config: DictConfig) -> str:
    """The name of the scene; photographs show one object."""
    if not isinstance(dataset, Photographed):
        return scene_name(dataset, Split(config.split), config.index)
    if config.index:
        raise ValueError(f"photographs show one object, with index=0, not {config.index}: give another dataset.path")
    return dataset.name


def threads_for(width: int) -> int:
    """How many threads of the CPU a run takes that names none: one for a narrow network, else all that PyTorch takes.

    A rendering evaluates a narrow network so briefly that threads mostly wait for each other: at 64 x 64 pixels and
    4 layers of 128, the loop of a completion took 4.0 s with one thread, and 7.5 s with two that sleep while they wait.

    Args:
        width: neurons per layer.
    """
    return 1 if width < WIDE else ALL_THREADS


def _renderer(config: DictConfig, requested: DictConfig, views: ViewSampler) -> tuple[Renderer, list[str]]:
    """A renderer from its node, with a number for each `auto`, and notes on these."""
    auto = build(config.auto, "auto", target="bench.setup.auto.AutoSettings")
    node, notes = resolved(requested, views, auto)
    renderer = build(node, "renderer", list(config.packages))
    if not isinstance(renderer, Renderer):
        name = type(renderer).__name__
        raise ValueError(f"renderer {name} lacks capabilities, render or silhouette_loss: see renderers/rendering.py")
    if requested.get("n_ray_samples") != AUTO:
        return renderer, notes
    if config.stress is not None:
        raise ValueError(
            "renderer.n_ray_samples=auto follows one optimisation, and a stress has many trials: give a number"
        )
    return follow(renderer), notes
