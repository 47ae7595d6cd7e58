"""The one place where a configuration becomes objects: by the check of a sweep, and by each run."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bench.config import EvaluationSettings, build_once
from bench.machine.environment import pick_device, using_threads
from bench.progress import Report
from bench.setup.auto import Node, at_pixel_precision, resolved
from bench.setup.fields import FieldChoice
from bench.setup.inputs import RunInputs
from bench.shape_prior import Prior, PriorSettings, prior_for
from bench.tasks.task import Checks, TakesField, Task
from datasets.own_photographs import Photographed
from datasets.scene import Dataset, Split, make_scene, scene_name
from datasets.views import ViewSampler
from renderers.rendering import Renderer

WIDE = 256  # neurons per layer: a narrower network is evaluated by one thread
ALL_THREADS = torch.get_num_threads()  # that PyTorch takes by itself
TARGETS = {  # classes of nodes without a _target_
    "view": "datasets.views.ViewSampler",
    "auto": "bench.setup.auto.AutoSettings",
    "prior": "bench.shape_prior.PriorSettings",
    "models": "bench.setup.fields.ModelSettings",
    "evaluation": "bench.config.EvaluationSettings",
}
Noted = tuple[Renderer, list[str]]  # a renderer, and notes on its settings with the value `auto`


@dataclass(frozen=True)
class Cell:
    """All that a run is made of, built and checked; nothing slow was done.

    Args:
        renderer: with notes on its settings with the value `auto`.
        make_pixel_precise: makes the renderer at pixel precision, which few tasks need.
        prior: how the prior is trained, where it has to be.
        place: the split and the number of the scene's shape.
        threads: of the CPU; None leaves it to `threads_for`.
        cache: folder of priors and references.
    """

    task: Task
    renderer: Noted
    make_pixel_precise: Callable[[], Noted]
    views: ViewSampler
    dataset: Dataset
    evaluation: EvaluationSettings
    prior: PriorSettings
    field: FieldChoice
    place: tuple[Split, int]
    seed: int
    device: torch.device
    threads: int | None
    cache: Path

    def start(self, progress: Report) -> RunInputs:
        """What the task works with, in a process that has the run's threads and seed from now on."""
        torch.set_num_threads(self.threads or threads_for(self.prior.network.width))
        torch.manual_seed(self.seed)
        return self.inputs(progress)

    def inputs(self, progress: Report = lambda *_: None) -> RunInputs:
        """What the task works with; `progress` receives that of a training of the prior."""
        (split, index), (renderer, notes) = self.place, self.renderer
        photographed = self.dataset if isinstance(self.dataset, Photographed) else None

        def make_prior() -> Prior:
            with using_threads(self.threads or ALL_THREADS):  # training pays with more of them
                return prior_for(self.dataset, self.prior, self.cache, self.device, progress)

        return RunInputs(
            renderer=renderer,
            views=self.views,
            scene_name=self.dataset.name if photographed else scene_name(self.dataset, split, index),
            make_pixel_precise=self.make_pixel_precise,
            make_scene=partial(make_scene, self.dataset, self.views, split=split, index=index),
            make_prior=make_prior,
            evaluation=self.evaluation,
            seed=self.seed,
            device=self.device,
            cache=self.cache,
            field=self.field,
            dataset=self.dataset,
            notes=tuple(notes),
            photographed=photographed,
            trained=index if split == Split.TRAIN and index < self.prior.shapes else None,
        )


def cell_of(config: Node, built: dict[str, Any] | None = None) -> Cell:
    """Builds everything that a configuration names, and checks all of it before the first slow step.

    Args:
        config: of a run, resolved, as plain data; `bench.config.check_top_level` has checked it.
        built: objects and errors by the text of their nodes, which cells of a sweep share while they are checked.

    Raises:
        ValueError, OSError: for anything invalid in it.
    """
    packages, built = list(config["packages"]), {} if built is None else built
    view, auto = build_once({"view": config["view"], "auto": config["auto"]}, packages, TARGETS, built)

    def renderer(requested: Node) -> Noted:
        """A renderer from its node, with a number for each `auto`, and notes on these."""
        node, notes = resolved(requested, view, auto)
        (made,) = build_once({"renderer": node}, packages, TARGETS, built)
        if not isinstance(made, Renderer):
            name = type(made).__name__
            raise ValueError(
                f"renderer {name} lacks capabilities, render or silhouette_loss: see renderers/rendering.py"
            )
        return made, notes

    noted = renderer(config["renderer"])
    task, dataset, evaluation, prior, models = build_once(
        {name: config[name] for name in ("task", "dataset", "evaluation", "prior", "models")}, packages, TARGETS, built
    )
    cell = Cell(
        task=task,
        device=pick_device(config["device"]),
        views=view,
        renderer=noted,
        make_pixel_precise=lambda: renderer(at_pixel_precision(config["renderer"])),
        dataset=dataset,
        evaluation=evaluation,
        prior=prior,
        field=FieldChoice(config["field"], models),
        place=(Split(config["split"]), config["index"]),
        seed=config["seed"],
        threads=config["threads"],
        cache=Path(config["priors_dir"]),
    )
    _check(cell)
    return cell


def _check(cell: Cell) -> None:
    """Raises ValueError where parts do not fit together."""
    name, (_, index) = type(cell.task).__name__, cell.place
    if not isinstance(cell.task, Task):
        raise ValueError(f"task {name} lacks execute: see bench/tasks/task.py")
    if isinstance(cell.dataset, Photographed) and index:
        raise ValueError(f"photographs show one object, with index=0, not {index}: give another dataset.path")
    if not cell.field.of_prior and not isinstance(cell.task, TakesField):
        raise ValueError(f"the task {name} does not take field={cell.field.name}: remove it")
    inputs = cell.inputs()
    if isinstance(cell.task, Checks):
        cell.task.check(inputs)


def threads_for(width: int) -> int:
    """How many threads of the CPU a run takes that names none: one for a narrow network, else all that PyTorch takes.

    A rendering evaluates a narrow network so briefly that threads mostly wait for each other: at 64 x 64 pixels and
    4 layers of 128, the loop of a completion took 4.0 s with one thread, and 7.5 s with two that sleep while they wait.

    Args:
        width: neurons per layer.
    """
    return 1 if width < WIDE else ALL_THREADS
