"""The objects that a run's configuration describes, built and ready."""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig

from bench.autodecoder import Prior, PriorSettings
from bench.config import EvaluationSettings, build
from bench.environment import pick_device
from bench.prior_store import prior_for
from bench.progress import Report
from bench.records import Record
from datasets.dataset import Dataset, Split
from datasets.scene import Scene, make_scene
from datasets.views import ViewSampler
from renderers.rendering import Renderer


@dataclass(frozen=True)
class Stage:
    """What a run works with."""

    renderer: Renderer
    scene: Scene
    views: ViewSampler
    prior: Prior
    evaluation: EvaluationSettings
    seed: int
    device: torch.device
    cache: Path  # where what is slow to make is kept
    trained: int | None = None  # which of the prior's training shapes the scene's shape is, if it is one

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
    packages = list(config.packages)
    renderer = build(config.renderer, "renderer", packages)
    if not isinstance(renderer, Renderer):
        name = type(renderer).__name__
        raise ValueError(f"renderer {name} lacks capabilities, render or silhouette_loss: see renderers/rendering.py")
    dataset = cast(Dataset, build(config.dataset, "dataset", packages))
    views = build(config.view, "view", target="datasets.views.ViewSampler")
    evaluation = build(config.evaluation, "evaluation", target="bench.config.EvaluationSettings")
    settings = prior_settings(config)
    scene = make_scene(dataset, views, split=Split(config.split), index=config.index)
    prior = prior_for(dataset, settings, Path(config.priors_dir), device, progress)
    torch.manual_seed(config.seed)  # here, since a prior that is trained first must change nothing of what follows
    trained = config.index if config.split == Split.TRAIN and config.index < settings.shapes else None
    return Stage(renderer, scene, views, prior, evaluation, config.seed, device, Path(config.priors_dir), trained)


def prior_settings(config: DictConfig) -> PriorSettings:
    """The `prior` node."""
    return build(config.prior, "prior", target="bench.autodecoder.PriorSettings")
