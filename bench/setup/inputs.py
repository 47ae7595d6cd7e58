"""What a run is made of: its task, what the task works with, and the run under way.

`cell_of` is the one place where a configuration becomes objects: for the check of a sweep, and for each run.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from bench.config import OF, EvaluationSettings, build_once
from bench.machine.environment import pick_device
from bench.progress import Report
from bench.records.record import Record
from bench.setup.auto import Node, at_pixel_precision, resolved
from bench.setup.fields import FieldChoice
from bench.setup.priors import PriorChoice, learnt_dataset, naming_prior_keys
from bench.shape_prior import Prior, PriorSettings
from datasets.network_files import HasNetwork
from datasets.own_photographs import Photographed
from datasets.scene import SPLIT_STRIDE, Dataset, OneView, Scene, Split, Surface, make_scene, sample_surface, scene_name
from datasets.views import ViewSampler
from renderers.checks import BadInput
from renderers.field import Field
from renderers.rendering import Renderer, final_notes

WIDE = 256  # neurons per layer: a narrower network is evaluated by one thread
ALL_THREADS = torch.get_num_threads()  # that PyTorch takes by itself
Noted = tuple[Renderer, list[str]]  # a renderer, and notes on its settings with the value `auto`


@dataclass(frozen=True)
class RunInputs:
    """What a run works with."""

    renderer: Renderer
    views: ViewSampler
    scene_name: str
    make_scene: Callable[[], Scene]
    make_prior: Callable[[], Prior]
    make_pixel_precise: Callable[[], Noted]  # the renderer at pixel precision, with no more steps than that takes
    evaluation: EvaluationSettings
    seed: int
    device: torch.device
    cache: Path  # folder of priors and references
    field: FieldChoice  # what an unknown shape is made of
    prior_choice: PriorChoice
    dataset: Dataset | None = None  # of the scene
    notes: tuple[str, ...] = ()  # on settings with the value `auto`, and on the network of a scene or prior

    @property
    def photographed(self) -> Photographed | None:
        """The dataset, where it has photographs and no true shape."""
        return self.dataset if isinstance(self.dataset, Photographed) else None

    @cached_property
    def scene(self) -> Scene:
        """The scene, made at its first use: not every task needs one."""
        return self.make_scene()

    @cached_property
    def true_surface(self) -> Surface:
        """The samples of the true surface that all metrics of the run use."""
        return sample_surface(self.scene.mesh, self.evaluation.points, self.seed)

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

    def check_prior(self) -> None:
        """Raises BadInput for an object of one's own, which has no prior, where none is named."""
        if not self.prior_choice.exists:
            without = "field=auto completes a depth image without one"
            if self.photographed is not None:
                without = "photographs take one with task=multiview, and none with task=reconstruction"
            raise BadInput(
                f"{self.scene_name} has no prior of its own: set prior.of=sofa, plane, table or car, or prior=deepsdf "
                f"prior.path=FOLDER; {without}"
            )

    def check_fitted(self) -> int:
        """The number of the scene's shape among the codes of the prior.

        Raises:
            BadInput: where the prior was not trained on that shape.
        """
        if self.prior_choice.scene_code is None:
            raise BadInput(
                "the task renders a network at the shape that it was fitted to: add +experiment=fitted, or set "
                "dataset=network dataset.path=FILE for a network of yours"
            )
        return self.prior_choice.scene_code

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
    def on_clock(self) -> Iterator[None]:
        """Within it, the work of a method without a loop: its seconds count as forward ones."""
        clock = time.perf_counter()
        yield
        self.record.seconds |= {"forward": time.perf_counter() - clock, "backward": 0.0}

    @contextmanager
    def off_clock(self) -> Iterator[None]:
        """Within it, what is not part of the loop's time: its seconds count as the evaluation's."""
        clock = time.perf_counter()
        yield
        seconds = self.record.seconds
        seconds["evaluation"] = seconds.get("evaluation", 0.0) + time.perf_counter() - clock


@runtime_checkable
class Task(Protocol):
    """A benchmark problem for a renderer and a scene. It names no renderer.

    One with `takes_field = True` works with any field, as set by `field=`, in place of a prior's code; one with
    `takes_one_view = True` needs no true shape.
    """

    def execute(self, run: RunContext) -> None:
        """Executes the task, and fills the run's record and folder.

        Raises:
            Unsupported: where the renderer cannot do what the task or its field needs.
        """
        ...


@runtime_checkable
class Checks(Protocol):
    """A task that not all inputs will do for, which is told before anything slow, and by `plan=true`."""

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput for inputs that the task cannot use."""
        ...


@runtime_checkable
class Judges(Protocol):
    """A task that judges a final field otherwise than `bench.evaluate.evaluate.evaluate` does."""

    def judged(self, field: Field, run: RunContext) -> dict[str, float]:
        """The metrics of a field that a run of the task ended on."""
        ...


@dataclass(frozen=True)
class Cell:
    """A task and what it works with, built and checked; nothing slow was done.

    Args:
        threads: of the CPU; None: see `start`.
    """

    task: Task
    inputs: RunInputs
    threads: int | None

    def start(self) -> None:
        """Gives this process the run's threads and seed.

        A run that names no threads takes one for a narrow network, else all that PyTorch takes. A rendering evaluates a
        narrow network so briefly that threads mostly wait for each other: at 64 x 64 pixels and 4 layers of 128, the
        loop of a completion took 4.0 s with one thread, and 7.5 s with two that sleep while they wait.
        """
        torch.set_num_threads(self.threads or (1 if self.inputs.prior_choice.width < WIDE else ALL_THREADS))
        torch.manual_seed(self.inputs.seed)


def cell_of(config: Node, built: dict[str, Any] | None = None, *, progress: Report = lambda *_: None) -> Cell:
    """Builds everything that a configuration names, and checks all of it before the first slow step.

    Args:
        config: of a run, resolved, as plain data; `bench.config.check_top_level` has checked it.
        built: objects and errors by the text of their nodes, which cells of a sweep share while they are checked.
        progress: receives that of a training of the prior.

    Raises:
        ValueError, OSError: for anything invalid in it.
    """
    builder = _Builder(config, {} if built is None else built)
    renderer, notes = builder.renderer(config["renderer"])
    task, dataset, view, evaluation, models = builder.parts("task", "dataset", "view", "evaluation", "models")
    split, index = _shape_number(config["split"], config["index"])
    prior = builder.prior(dataset, split, index)
    device, cache, threads = pick_device(config["device"]), Path(config["priors_dir"]), config["threads"]
    inputs = RunInputs(
        renderer=renderer,
        views=view,
        scene_name=dataset.name if isinstance(dataset, Photographed | OneView) else scene_name(dataset, split, index),
        make_scene=partial(_scene, dataset, view, split, index, prior),
        make_prior=partial(prior.load, cache, device, threads or ALL_THREADS, progress),  # training pays with more
        make_pixel_precise=partial(builder.renderer, at_pixel_precision(config["renderer"])),
        evaluation=evaluation,
        seed=config["seed"],
        device=device,
        cache=cache,
        field=FieldChoice(config["field"], models),
        prior_choice=prior,
        dataset=dataset,
        notes=(*notes, *prior.notes),
    )
    _check(task, inputs, index)
    return Cell(task, inputs, threads)


@dataclass(frozen=True)
class _Builder:
    """Builds the parts of a configuration; equal nodes are built once, see `bench.config.build_once`."""

    config: Node
    built: dict[str, Any]

    def parts(self, *names: str, **nodes: Any) -> list[Any]:
        """The objects of these nodes of the configuration, and of further nodes."""
        nodes = {name: self.config[name] for name in names} | nodes
        return build_once(nodes, list(self.config["packages"]), self.built)

    def renderer(self, requested: Node) -> Noted:
        """A renderer from its node, with a number for each `auto`, and notes on these."""
        node, notes = resolved(requested, *self.parts("view", "auto"))
        (renderer,) = self.parts(renderer=node)
        if not isinstance(renderer, Renderer):
            name = type(renderer).__name__
            raise ValueError(
                f"renderer {name} lacks capabilities, render or silhouette_loss: see renderers/rendering.py"
            )
        return renderer, notes

    def prior(self, dataset: Dataset, split: Split, index: int) -> PriorChoice:
        """The prior for shape number `index` of a dataset."""
        node, shown = self.config["prior"], dataset.network(index) if isinstance(dataset, HasNetwork) else None
        with naming_prior_keys(node):
            (settings,) = self.parts("prior")
            learnt = learnt_dataset(node.get(OF))
            network = shown if isinstance(settings, PriorSettings) else settings.network(0)
        if network is not None:
            return PriorChoice(network, scene_code=index if network is shown else None)
        fitted = learnt is None and split is Split.TRAIN and index < settings.shapes
        exists = learnt is not None or not isinstance(dataset, Photographed | OneView)
        return PriorChoice(settings, learnt or dataset, index if fitted else None, exists)


def _scene(dataset: Dataset, view: ViewSampler, split: Split, index: int, prior: PriorChoice) -> Scene:
    """The scene of a run, in colours where its prior has some."""
    return replace(make_scene(dataset, view, split=split, index=index), texture=prior.texture(dataset, split, index))


def _shape_number(split: str, index: int) -> tuple[Split, int]:
    """The split and number of a shape; raises ValueError where no dataset has it."""
    if split not in list(Split):
        raise ValueError(f"split must be one of {', '.join(Split)}, not {split!r}")
    if index >= SPLIT_STRIDE:
        raise ValueError(f"index must be at most {SPLIT_STRIDE - 1}, not {index}: a split has no more shapes")
    return Split(split), index


def _check(task: Task, inputs: RunInputs, index: int) -> None:
    """Raises ValueError where parts do not fit together."""
    name = type(task).__name__
    if isinstance(inputs.dataset, Photographed | OneView) and index:
        raise ValueError(f"{inputs.dataset.name} is one object, with index=0, not {index}: give another dataset.path")
    if isinstance(inputs.dataset, OneView) and not getattr(task, "takes_one_view", False):
        raise ValueError(f"the task {name} needs a true shape, and one view has none: set task=completion")
    if not inputs.field.of_prior and not getattr(task, "takes_field", False):
        raise ValueError(f"the task {name} does not take field={inputs.field.name}: remove it")
    if isinstance(task, Checks):
        task.check(inputs)
