"""The objects that a run's configuration describes, built and ready."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig

from bench.auto import AUTO, frugal, resolved
from bench.autodecoder import Prior, PriorSettings
from bench.config import EvaluationSettings, build
from bench.environment import pick_device
from bench.ladder.settings import PRIOR, LadderSettings
from bench.prior_store import prior_for
from bench.progress import Report
from bench.records import Record
from bench.thickness import ending, follow
from datasets.dataset import Dataset, Split
from datasets.scene import Scene, make_scene, scene_name
from datasets.views import ViewSampler
from renderers.rendering import Renderer


@dataclass(frozen=True)
class Stage:
    """What a run works with."""

    renderer: Renderer
    views: ViewSampler
    scene_name: str
    make_scene: Callable[[], Scene]
    make_prior: Callable[[], Prior]
    evaluation: EvaluationSettings
    seed: int
    device: torch.device
    cache: Path  # where what is slow to make is kept
    notes: tuple[str, ...] = ()  # what settings came to that follow from others
    make_frugal: Callable[[], tuple[Renderer, list[str]]] | None = None
    ladder: LadderSettings | None = None  # the fields to choose from, where none is a prior's
    field: str = PRIOR  # what a shape that is looked for is made of
    trained: int | None = None  # which of the prior's training shapes the scene's shape is, if it is one

    @cached_property
    def scene(self) -> Scene:
        """The scene, made when it is first asked for: not every task needs one."""
        return self.make_scene()

    @cached_property
    def frugal(self) -> tuple[Renderer, list[str]]:
        """The renderer with no more precision than a pixel, and no more steps than that takes; these, in words."""
        return (self.renderer, []) if self.make_frugal is None else self.make_frugal()

    @property
    def last_notes(self) -> list[str]:
        """What is known at the end: repairs of the scene's mesh, if it was made, and what settings came to."""
        repairs = self.scene.mesh.repairs if "scene" in vars(self) else ()
        return [*repairs, *ending(self.renderer)]

    @cached_property
    def prior(self) -> Prior:
        """The prior of the dataset, loaded or trained when it is first asked for: not every task needs one."""
        with torch.random.fork_rng():  # a prior that is trained first must change nothing of what follows
            return self.make_prior()

    def fitted(self) -> Prior:
        """The prior with the code of the scene's shape alone.

        Raises:
            ValueError: where the prior was not trained on that shape.
        """
        if self.trained is None:
            raise ValueError("task renders a network at a shape it was fitted to: add +common=fitted")
        return Prior(self.prior.decoder, self.prior.codes[self.trained : self.trained + 1])


@dataclass(frozen=True)
class Cell:
    """One run under way: what it works with, where its files go, and its record, which is filled as it goes."""

    stage: Stage
    folder: Path
    record: Record
    progress: Report


def set_up(config: DictConfig, progress: Report) -> Stage:
    """Builds everything that a configuration names; checks all of it before the first slow step.

    Raises:
        ValueError: for anything in it that cannot be.
    """
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    device = pick_device(config.device)
    views = build(config.view, "view", target="datasets.views.ViewSampler")
    renderer, notes = _renderer(config, config.renderer, views)
    dataset = cast(Dataset, build(config.dataset, "dataset", list(config.packages)))
    evaluation = build(config.evaluation, "evaluation", target="bench.config.EvaluationSettings")
    ladder: LadderSettings = build(config.ladder, "ladder", target="bench.ladder.settings.LadderSettings")
    if config.field != PRIOR:
        ladder.asked(config.field)
    settings = prior_settings(config)
    cache = Path(config.priors_dir)
    torch.manual_seed(config.seed)
    trained = config.index if config.split == Split.TRAIN and config.index < settings.shapes else None

    def shape_and_view() -> Scene:
        return make_scene(dataset, views, split=Split(config.split), index=config.index)

    def make_prior() -> Prior:
        return prior_for(dataset, settings, cache, device, progress)

    return Stage(
        renderer=renderer,
        views=views,
        scene_name=scene_name(dataset, Split(config.split), config.index),
        make_frugal=lambda: _renderer(config, frugal(config.renderer), views),
        make_scene=shape_and_view,
        make_prior=make_prior,
        evaluation=evaluation,
        seed=config.seed,
        device=device,
        cache=cache,
        notes=tuple(notes),
        ladder=ladder,
        field=config.field,
        trained=trained,
    )


def _renderer(config: DictConfig, asked: DictConfig, views: ViewSampler) -> tuple[Renderer, list[str]]:
    """A `renderer` node, built with a number for each `auto`, and what these are, in words."""
    auto = build(config.auto, "auto", target="bench.auto.AutoSettings")
    node, notes = resolved(asked, views, auto)
    renderer = build(node, "renderer", list(config.packages))
    if not isinstance(renderer, Renderer):
        name = type(renderer).__name__
        raise ValueError(f"renderer {name} lacks capabilities, render or silhouette_loss: see renderers/rendering.py")
    if asked.get("samples") != AUTO:
        return renderer, notes
    if config.stress is not None:
        raise ValueError("renderer.samples=auto follows one optimisation, and a stress has many trials: give a number")
    return follow(renderer), notes


def prior_settings(config: DictConfig) -> PriorSettings:
    """The `prior` node."""
    return build(config.prior, "prior", target="bench.autodecoder.PriorSettings")
