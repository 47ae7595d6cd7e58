"""The objects of a run: its task, the task's inputs, and the run in progress.

Only `prepare_run` turns a configuration into objects: for the check of a sweep, and for each run.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch

from bench.config import AUTO, PRIOR_DATASET_KEY, PRIOR_FIELD, EvaluationSettings, build_once
from bench.machine.environment import pick_device
from bench.progress import Report
from bench.records.record import Record
from bench.setup.priors import PriorChoice, prior_keys_in_errors, training_dataset
from bench.shape_prior import Prior, PriorSettings
from bench.tables import extension
from datasets.scene import (
    SPLIT_STRIDE,
    Dataset,
    HasNetwork,
    OneView,
    Photographed,
    Scene,
    Split,
    Surface,
    make_scene,
    sample_surface,
    scene_name,
)
from datasets.views import ViewSampler
from renderers.checks import BadInput
from renderers.rendering import Capabilities, Renderer, final_notes

RENDERER_ATTRIBUTES = ("capabilities", "render", "silhouette_loss")
MIN_MULTITHREADED_WIDTH = 256  # neurons per layer: a narrower network is evaluated by one thread
DEFAULT_THREADS = torch.get_num_threads()  # PyTorch's choice
Node = Mapping[str, Any]  # of a configuration
RendererWithNotes = tuple[Renderer, list[str]]  # notes on the settings with the value `auto`


@dataclass(frozen=True)
class FieldChoice:
    """The field of an unknown shape that a run's configuration selects.

    Args:
        name: "prior"; "auto", the smallest sufficient candidate, found by early growth; or a candidate's name.
        models: the fields to choose from, and the settings of their fits; not read for "prior".

    Raises:
        ValueError: the name is unknown.
    """

    name: str
    models: Any

    def __post_init__(self) -> None:
        if self.name not in (PRIOR_FIELD, AUTO):
            extension("field_name")(self.name)

    @property
    def of_prior(self) -> bool:
        """Whether the field is a code of the dataset's prior."""
        return self.name == PRIOR_FIELD

    @property
    def candidates(self) -> tuple[str, ...]:
        """The names of the candidates that are tried."""
        return self.models.candidates if self.name == AUTO else (self.name,)


@dataclass(frozen=True)
class RunInputs:
    """The inputs of a run."""

    renderer: Renderer
    views: ViewSampler
    scene_name: str
    make_scene: Callable[[], Scene]
    make_prior: Callable[[], Prior]
    make_renderer: Callable[[Callable[[Node], Node]], RendererWithNotes]  # the renderer with changed settings
    evaluation: EvaluationSettings
    seed: int
    device: torch.device
    cache: Path  # folder of priors and references
    field: FieldChoice  # the field of an unknown shape
    prior_choice: PriorChoice
    dataset: Dataset | None = None  # of the scene
    notes: tuple[str, ...] = ()  # on settings with the value `auto`, and on the network of a scene or prior
    threads: int | None = None  # of the CPU; None: see `configure_process`

    @property
    def photographed(self) -> Photographed | None:
        """The dataset, if it has photographs and no true shape; else None."""
        return self.dataset if isinstance(self.dataset, Photographed) else None

    @cached_property
    def scene(self) -> Scene:
        """The scene, made at its first use, since some tasks need none."""
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
        """The prior of the dataset, loaded or trained at its first use, since some tasks need none."""
        with torch.random.fork_rng():  # training a prior must not change later random draws
            return self.make_prior()

    def configure_process(self) -> None:
        """Sets the threads and the seed of this process.

        Without `threads`, a narrow network takes one thread, and others take PyTorch's default. Evaluations of a narrow
        network are so short that threads mostly wait for each other: at 64 x 64 pixels and 4 layers of 128, the loop of
        a completion took 4.0 s with one thread, and 7.5 s with two that sleep while they wait.
        """
        is_narrow = self.prior_choice.width < MIN_MULTITHREADED_WIDTH
        torch.set_num_threads(self.threads or (1 if is_narrow else DEFAULT_THREADS))
        torch.manual_seed(self.seed)

    def check_prior(self) -> None:
        """Raises BadInput for an object of the user without a prior, if the configuration names no other prior."""
        if not self.prior_choice.exists:
            remedy = "field=auto completes a depth image without one"
            if self.photographed is not None:
                remedy = "photographs take one with task=multiview, and none with task=reconstruction"
            raise BadInput(
                f"{self.scene_name} has no prior of its own: set prior.of=sofa, plane, table or car, or prior=deepsdf "
                f"prior.path=FOLDER; {remedy}"
            )

    def check_fitted(self) -> None:
        """Raises BadInput if the prior was not trained on the scene's shape."""
        if self.prior_choice.scene_code is None:
            raise BadInput(
                "the task renders a network at the shape that it was fitted to: add +experiment=fitted, or set "
                "dataset=network dataset.path=FILE for a network of yours"
            )

    def fitted(self) -> Prior:
        """The prior with the code of the scene's shape alone; raises as `check_fitted` does."""
        self.check_fitted()
        index = self.prior_choice.scene_code
        return Prior(self.prior.decoder, self.prior.codes[index : index + 1])


@dataclass(frozen=True)
class RunContext:
    """What a task receives: the run's inputs, its folder, its record, which the task fills, and its progress report."""

    inputs: RunInputs
    folder: Path
    record: Record
    progress: Report

    @contextmanager
    def on_clock(self) -> Iterator[None]:
        """Context for a method without a loop: its seconds count as forward seconds."""
        clock = time.perf_counter()
        try:
            yield
        finally:
            self.record.seconds |= {"forward": time.perf_counter() - clock, "backward": 0.0}

    @contextmanager
    def off_clock(self) -> Iterator[None]:
        """Context for work outside of the loop: its seconds count as evaluation seconds."""
        clock, seconds = time.perf_counter(), self.record.seconds
        try:
            yield
        finally:
            seconds["evaluation"] = seconds.get("evaluation", 0.0) + time.perf_counter() - clock


@runtime_checkable
class Task(Protocol):
    """What a run does: it solves a problem or measures a renderer. It names no renderer.

    A task with `takes_field = True` accepts any field set by `field=`, not only a prior's code. A task with
    `takes_one_view = True` needs no true shape.
    """

    def execute(self, run: RunContext) -> None:
        """Executes the task, and fills the run's record and folder.

        Raises:
            Unsupported: the renderer lacks what the task or its field needs.
        """
        ...


@runtime_checkable
class ValidatesInputs(Protocol):
    """A task that validates its inputs, before any slow step and with `plan=true`."""

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput for inputs that the task cannot use."""
        ...


def prepare_run(
    config: Node, built: dict[str, Any] | None = None, *, progress: Report = lambda *_: None
) -> tuple[Task, RunInputs]:
    """The task and its inputs, with all objects that a configuration names, checked before the first slow step.

    Args:
        config: of a run, resolved, as plain data; `bench.config.check_top_level` has checked it.
        built: objects and errors by the text of their nodes, shared by the cells of a sweep while they are checked.
        progress: receives the progress of a training of the prior.

    Raises:
        ValueError, OSError: the configuration is invalid.
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
        make_scene=partial(_make_scene, dataset, view, split, index, prior),
        make_prior=partial(prior.load, cache, device, threads or DEFAULT_THREADS, progress),
        make_renderer=lambda change: builder.renderer(change(config["renderer"])),
        evaluation=evaluation,
        seed=config["seed"],
        device=device,
        cache=cache,
        field=FieldChoice(config["field"], models),
        prior_choice=prior,
        dataset=dataset,
        notes=(*notes, *prior.notes),
        threads=threads,
    )
    _check(task, inputs, index)
    return task, inputs


@dataclass(frozen=True)
class _Builder:
    """Builds the objects of a configuration; equal nodes are built once, see `bench.config.build_once`."""

    config: Node
    built: dict[str, Any]

    def parts(self, *names: str, **nodes: Any) -> list[Any]:
        """The objects of these nodes of the configuration, and of further nodes."""
        nodes = {name: self.config[name] for name in names} | nodes
        return build_once(nodes, list(self.config["packages"]), self.built)

    def renderer(self, requested: Node) -> RendererWithNotes:
        """A renderer from its node with a number for each `auto`, and notes on these numbers."""
        view, auto = self.parts("view", "auto")
        node, notes = auto.resolve(requested, view) if AUTO in requested.values() else (requested, [])
        (renderer,) = self.parts(renderer=node)
        if not isinstance(renderer, Renderer):
            lacking = [name for name in RENDERER_ATTRIBUTES if not hasattr(renderer, name)]
            raise ValueError(
                f"renderer {type(renderer).__name__} lacks {', '.join(lacking)}: see renderers/rendering.py"
            )
        if not isinstance(renderer.capabilities, Capabilities):
            kind = type(renderer.capabilities).__name__
            raise ValueError(
                f"capabilities of the renderer {type(renderer).__name__} must be a Capabilities, not a {kind}"
            )
        return renderer, notes

    def prior(self, dataset: Dataset, split: Split, index: int) -> PriorChoice:
        """The prior for shape number `index` of a dataset."""
        node, scene_network = self.config["prior"], dataset.network(index) if isinstance(dataset, HasNetwork) else None
        with prior_keys_in_errors(node):
            (settings,) = self.parts("prior")
            prior_dataset = training_dataset(node.get(PRIOR_DATASET_KEY))
            prior_network = scene_network if isinstance(settings, PriorSettings) else settings.network(0)
        if prior_network is not None:
            return PriorChoice(prior_network, scene_code=index if prior_network is scene_network else None)
        fitted = prior_dataset is None and split is Split.TRAIN and index < settings.shapes
        exists = prior_dataset is not None or not isinstance(dataset, Photographed | OneView)
        return PriorChoice(settings, prior_dataset or dataset, index if fitted else None, exists)


def _make_scene(dataset: Dataset, view: ViewSampler, split: Split, index: int, prior: PriorChoice) -> Scene:
    """The scene of a run, with colours if its prior has some."""
    return replace(make_scene(dataset, view, split=split, index=index), texture=prior.texture(dataset, split, index))


def _shape_number(split: str, index: int) -> tuple[Split, int]:
    """The split and index of a shape; raises ValueError if no dataset has it."""
    if split not in list(Split):
        raise ValueError(f"split must be one of {', '.join(Split)}, not {split!r}")
    if index >= SPLIT_STRIDE:
        raise ValueError(f"index must be at most {SPLIT_STRIDE - 1}, not {index}: a split has no more shapes")
    return Split(split), index


def _check(task: Task, inputs: RunInputs, index: int) -> None:
    """Raises ValueError if dataset, task and field do not fit together."""
    name = type(task).__name__
    if isinstance(inputs.dataset, Photographed | OneView) and index:
        raise ValueError(f"{inputs.dataset.name} is one object, with index=0, not {index}: give another dataset.path")
    if isinstance(inputs.dataset, OneView) and not getattr(task, "takes_one_view", False):
        raise ValueError(f"the task {name} needs a true shape, and one view has none: set task=completion")
    if not inputs.field.of_prior and not getattr(task, "takes_field", False):
        raise ValueError(f"the task {name} does not take field={inputs.field.name}: remove it")
    if inputs.views.rays_per_pixel > 1 and not getattr(task, "takes_rays_per_pixel", False):
        remedy = "remove view.rays_per_pixel. conf/README.md names the tasks that take it"
        raise ValueError(f"the task {name} compares one ray per pixel: {remedy}")
    holds_out = getattr(getattr(task, "optimiser", None), "ends", "") == "held_out"
    if holds_out and not (getattr(task, "takes_one_view", False) and inputs.field.of_prior):
        raise ValueError("effort=needed is only for task=completion with field=prior: set effort=full")
    if isinstance(task, ValidatesInputs):
        task.check(inputs)
