"""Shape and colour from one image, by a network trained on many shapes (DVR, Sec. 4.1)."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.config import AUTO
from bench.evaluate.colours import vertex_colours
from bench.evaluate.evaluate import OWN_PREFIX, Evaluation
from bench.evaluate.state import State
from bench.records.record import RunStatus
from bench.setup.inputs import RunContext, RunInputs
from bench.solve.solve import COST_DEFINITIONS, check_field_gradient, note_result, run_optimisation
from bench.tasks.reconstruction.judge import COLOURED_DEFINITIONS, coloured, judge, judge_mesh
from bench.tasks.reconstruction.pictures import draw_picture, draw_reconstruction, note_surface
from bench.tasks.reconstruction.subject import Subject
from bench.tasks.reconstruction.surfaces import with_colours
from bench.tasks.single_view.baselines import MaskSearch, best_shape, mean_shape, most_similar_shape
from bench.tasks.single_view.images import Imaging, ShapeImages
from bench.tasks.single_view.network import SingleView, SingleViewNetwork
from bench.tasks.single_view.own_image import best_view, read_picture
from bench.tasks.single_view.store import Recipe, overlap
from bench.tasks.single_view.training import Supervision, TrainingSettings
from datasets.photographs import Photography
from datasets.scene import Split, Truth
from datasets.views import check_elevation
from renderers.checks import BadInput, check_at_least, check_choice
from renderers.field import Field
from renderers.rendering import check_kind

NETWORK, CODE, MEAN, NEAREST, BEST = "network", "code", "mean", "nearest", "best"
DEFINITIONS = COLOURED_DEFINITIONS | {
    "iou": "intersection over union of the volumes, by points drawn evenly in the cube (DVR, Sec. 4.1), from 0 to 1; "
    "before: of the mean code of all training images"
}
TRAINING_DEFINITIONS = {
    "seconds.training": "of the network, once for all shapes; not part of the run's time",
    "evaluations.training": "field values that the renderer asked for in the training of the network; not of the run",
}
SHIPPED_ROW = "+method=single_view"  # has the settings of the shipped networks
REMEDY = "add task.train=true, or give the same command to `python -m bench.train` first"
COLOUR_SCORES = ("psnr", "psnr_image", "ssim")
NETWORK_SETTINGS = (  # settings that determine the network
    *("images", "image_pixels", "elevation", "shapes", "views"),
    *("network", "supervision", "training"),
)
FITTED = "fitted_mask_iou"
PICTURE_DEFINITIONS = {
    FITTED: "Of the mask of the given picture and the silhouette of the shape from the best of many views, both scaled "
    "to the same box: number of pixels that are foreground in both divided by the number that are foreground in at "
    "least one. The camera of the picture is not known, so that nothing else can be judged."
}
SEARCHED_VIEWS = 200  # candidates for the view of a picture


@dataclass(frozen=True)
class OneImage:
    """Infers a shape from one image of it; the other images evaluate it.

    Args:
        method: "network"; or without a network, the prior's "code" that matches the image's mask, the "mean" of the
            training shapes, the training shape with the "nearest" image, or the "best" one by the truth.
        images: settings of the images of each shape, from random cameras of `view`.
        image_pixels: height and width of the images.
        elevation: range of the cameras' angles above the horizon, in degrees; `view` has the range of azimuths.
        shapes: number of training shapes.
        views: number of images per training shape, the first ones.
        given: index of the input image.
        network: sizes of the network.
        supervision: observations that the training may use.
        training: settings of the training by `python -m bench.train`.
        search: search of the prior's code.
        train: whether a run trains a missing network; else the run is refused.
        image_path: path of the user's picture, which replaces the dataset's shape; None: no picture.
        mask_path: path of the picture's mask; None: its alpha channel.
    """

    method: str
    images: Photography
    image_pixels: int
    elevation: tuple[float, float]
    shapes: int
    views: int
    given: int
    network: SingleViewNetwork
    supervision: Supervision
    training: TrainingSettings
    search: MaskSearch
    train: bool = False
    image_path: str | None = None
    mask_path: str | None = None

    def __post_init__(self) -> None:
        check_choice("task.method", self.method, (NETWORK, CODE, MEAN, NEAREST, BEST))
        check_at_least("task.image_pixels", self.image_pixels, 16, "64 shows the shape")
        check_at_least("task.shapes", self.shapes, 1, "conf/scale has numbers that work")
        if not 1 <= self.views <= self.images.views:
            raise ValueError(f"task.views must be 1 to task.images.views={self.images.views}, not {self.views}")
        if not 0 <= self.given < self.images.views:
            raise ValueError(
                f"task.given must be 0 to {self.images.views - 1}, not {self.given}: it is an image's number"
            )
        check_elevation("task.elevation", self.elevation)
        if self.image_path is not None and self.method != NETWORK:
            raise ValueError(f"task.image_path needs task.method=network, not {self.method}: a picture has no truth")
        if self.mask_path is not None and self.image_path is None:
            raise ValueError("task.mask_path is the mask of a picture: give task.image_path as well")
        for key, file in (("image_path", self.image_path), ("mask_path", self.mask_path)):
            if file is not None and not Path(file).is_file():
                raise BadInput(f"task.{key}={file} is no file: give the path of one")

    @property
    def knows_colours(self) -> bool:
        return self.supervision.losses.colour > 0

    def recipe(self, inputs: RunInputs, config: dict[str, Any]) -> Recipe:
        """The recipe that determines the network of a run's configuration."""
        check_field_gradient(inputs.renderer)
        sampler = replace(inputs.views, resolution=self.image_pixels, elevation=self.elevation)
        settings = {name: config["task"][name] for name in NETWORK_SETTINGS} | {"view": sampler.identity}
        defaults = {"keep_every": config["task"]["training"]["keep_every"], "schedule": "cosine"}  # not in old hashes
        settings["training"] = {name: x for name, x in settings["training"].items() if defaults.get(name) != x}
        if self.supervision.renders:
            renderer = {k: v for k, v in config["renderer"].items() if not k.startswith("_") or k == "_target_"}
            settings["renderer"] = renderer | ({"auto": config["auto"]} if AUTO in renderer.values() else {})
        return Recipe(
            inputs.dataset,
            self.shapes,
            self.views,
            Imaging(self.images, sampler),
            self.network,
            self.supervision,
            self.training,
            inputs.renderer,
            settings,
        )

    def execute(self, run: RunContext) -> None:
        inputs, record = run.inputs, run.record
        recipe = self.recipe(inputs, record.config)
        record.evaluations = {"value": 0, "gradient": 0}
        if self.image_path is not None:
            self._infer_picture(run, recipe, Path(self.image_path))
            return
        record.definitions = DEFINITIONS | COST_DEFINITIONS | TRAINING_DEFINITIONS
        images, subject = self._images(run, recipe)
        if self.method == NETWORK:
            self._infer_shape(run, recipe, images, subject)
        elif self.method == CODE:
            self._search(run, images, subject)
        else:
            self._look_up(run, recipe, images, subject)

    def field_metrics(self, field: Field, run: RunContext) -> dict[str, float]:
        """The metrics of a run's final field; empty for the user's picture, whose camera is not known."""
        if self.image_path is not None:
            return {}
        images, subject = self._images(run, self.recipe(run.inputs, run.record.config))
        if self.method == NETWORK:
            return self._evaluate(State(field, run.inputs), images, subject).metrics
        mesh = coloured(field, subject, run.inputs)
        return judge_mesh(mesh, subject, run.inputs).metrics | {"iou": overlap(field, images, run.inputs.device)}

    def _images(self, run: RunContext, recipe: Recipe) -> tuple[ShapeImages, Subject]:
        """The images of the scene's shape, and the subject: the input image, with all others held out."""
        config = run.record.config
        images = recipe.imaging.shape_images(recipe.dataset, Split(config["split"]), config["index"])
        shots = images.shots()
        others = tuple(shot for index, shot in enumerate(shots) if index != self.given)
        return images, Subject((shots[self.given],), others or shots, run.inputs.scene.mesh, "")

    def _infer_shape(self, run: RunContext, recipe: Recipe, images: ShapeImages, subject: Subject) -> None:
        """Infers the shape by the network; the initial metrics are the mean code's."""
        inputs, record = run.inputs, run.record
        model, trained = self._network(run, recipe)
        mean = torch.tensor(trained["mean_code"], device=inputs.device)
        check_kind(inputs.renderer, model.at(mean))
        role = "took part in the training, and" if self.supervision.renders else "took no part in the training; it"
        record.notes = [*record.notes, f"the renderer {role} judges as own_"]
        with run.off_clock():
            record.metrics_start = self._evaluate(State(model.at(mean), inputs), images, subject).metrics
        state = _infer_state(run, model, images.image(self.given))
        with run.off_clock():
            note_result(run, self._evaluate(state, images, subject))
            if inputs.evaluation.picture is not None:
                draw_reconstruction(run.folder, state, subject, [], run.record.outcome)

    def _network(self, run: RunContext, recipe: Recipe) -> tuple[SingleView, dict[str, Any]]:
        """The network and the record of its training, which is described in the run's notes."""
        inputs = run.inputs
        path = recipe.find(inputs.cache)
        if path is None and self.train:
            with run.off_clock():
                path = recipe.make(inputs.cache, inputs.device, run.progress)
        if path is None:
            hint = f"; the shipped one of {recipe.dataset.name} has those of {SHIPPED_ROW} at scale=desk"
            hint = hint if recipe.shipped() else ""
            raise BadInput(f"no network was trained for {recipe.dataset.name} with these settings: {REMEDY}{hint}")
        model, training = recipe.load(path)
        run.record.notes = [*run.record.notes, describe_training(training)]
        run.record.seconds |= {"training": training["seconds"]["training"]}
        run.record.evaluations |= {"training": training["evaluations"]["value"]}
        if not self.knows_colours:
            for weights in model.decoder.texture_head.parameters():
                weights.zero_()  # grey, instead of the untrained initial colours
        return model.to(inputs.device), training

    def _infer_picture(self, run: RunContext, recipe: Recipe, path: Path) -> None:
        """Infers the shape of the user's picture, and finds the view that matches the picture best."""
        inputs, record = run.inputs, run.record
        record.scene, record.definitions = path.name, PICTURE_DEFINITIONS | COST_DEFINITIONS | TRAINING_DEFINITIONS
        model, trained = self._network(run, recipe)
        mask = None if self.mask_path is None else Path(self.mask_path)
        picture, warnings = read_picture(path, mask, self.image_pixels, trained["filled"])
        record.notes = [*record.notes, *warnings]
        state = _infer_state(run, model, picture)
        mesh = state.mesh
        with run.off_clock():
            if mesh is None:
                note_result(run, Evaluation({FITTED: 0.0}, None, (RunStatus.EMPTY, "the field has no surface")))
                return
            if self.knows_colours:
                mesh = replace(mesh, colours=vertex_colours(state.field, mesh, inputs.device))
            cameras = [recipe.imaging.sampler.draw(index) for index in range(SEARCHED_VIEWS)]
            camera, mask_iou = best_view(mesh, cameras, picture[3] > 0.5, trained["filled"])
            note_result(run, Evaluation({FITTED: mask_iou}, mesh, field=state.field))
            record.notes.append("it knows shapes of the dataset alone, whatever a picture shows")
            if inputs.evaluation.picture is not None:
                draw_picture(run.folder, mesh, picture, camera, inputs.evaluation.picture, record.outcome)

    def _evaluate(self, state: State, images: ShapeImages, subject: Subject) -> Evaluation:
        """The scores of a network's shape; scores of colours only if its training used colours."""
        evaluation = judge(state, subject)
        excluded = () if self.knows_colours else COLOUR_SCORES
        scores = {name: x for name, x in evaluation.metrics.items() if name.removeprefix(OWN_PREFIX) not in excluded}
        return replace(evaluation, metrics=scores | {"iou": overlap(state.field, images, state.inputs.device)})

    def _search(self, run: RunContext, images: ShapeImages, subject: Subject) -> None:
        """Searches the prior's code; the shape gets the colours of the input image."""
        inputs = run.inputs
        problem = self.search.problem(subject.input_shots[0], inputs)
        check_kind(inputs.renderer, problem.field())
        settings, least = self.search.optimiser, self.search.least_reference
        history = run_optimisation(problem, settings, run, lambda iteration: {}, least_reference=least)
        with run.off_clock():
            field = problem.field()
            scores = {"iou": overlap(field, images, inputs.device)}
            note_surface(run, coloured(field, subject, inputs), subject, scores, history, field)

    def _look_up(self, run: RunContext, recipe: Recipe, images: ShapeImages, subject: Subject) -> None:
        """Takes a training shape or the mean shape, with the colours of its images."""
        inputs, record, count = run.inputs, run.record, self.shapes
        record.notes = [*record.notes, "no network and no renderer took part"]
        if self.method == MEAN:
            mesh, shots = mean_shape(recipe.dataset, count, inputs.cache, run.progress), subject.input_shots
        else:
            others = recipe.imaging.images(recipe.dataset, Split.TRAIN, count, inputs.cache, run.progress)
            with run.on_clock():
                if self.method == NEAREST:
                    index = most_similar_shape(images.image(self.given), others)
                else:
                    index = best_shape(inputs.scene.mesh, recipe.dataset, count)
            mesh, shots = recipe.dataset.mesh(Split.TRAIN, index), others[index].shots()
            record.notes.append(f"training shape {index}")
        with run.off_clock():
            scores = {"iou": 0.0}
            if mesh is not None:
                truth, mesh = Truth(mesh), with_colours(mesh, shots)
                scores["iou"] = overlap(
                    lambda points: torch.from_numpy(truth.signed_distance(points.numpy())), images, torch.device("cpu")
                )
            note_surface(run, mesh, subject, scores)


@torch.no_grad()
def _infer_state(run: RunContext, model: SingleView, image: Float[Tensor, "4 height width"]) -> State:
    """Infers the shape of an image, with its mesh, on the run's clock."""
    with run.on_clock():
        state = State(model.at(model(image[None].to(run.inputs.device))[0]), run.inputs)
        _ = state.mesh
    return state


def describe_training(training: dict[str, Any]) -> str:
    settings, validation = training["settings"], training["validation"]
    return (
        f"the network was trained on {settings['shapes']} shapes of {training['dataset']['name']}, "
        f"{settings['views']} images each, for {settings['training']['steps']} steps, "
        f"{np.round(training['seconds']['training'] / 60, 1)} min; on validation shapes its IoU is "
        f"{validation['iou_network']:.3f}, that of the mean code {validation['iou_mean_code']:.3f}"
    )
