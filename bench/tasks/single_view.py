"""Shape and colour from one image, by a network trained on many shapes (DVR, Sec. 4.1)."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.evaluate import OWN_PREFIX, Evaluation
from bench.evaluate.state import State, vertex_colours
from bench.reconstruct.judge import COLOURED_DEFINITIONS, coloured, judge, judge_mesh
from bench.reconstruct.pictures import draw_picture, draw_reconstruction, note_surface
from bench.reconstruct.subject import Subject
from bench.reconstruct.surfaces import with_colours
from bench.records.record import RunStatus
from bench.setup.auto import AUTO
from bench.setup.inputs import RunContext, RunInputs
from bench.single_view.baselines import MaskSearch, best_shape, mean_shape, most_alike
from bench.single_view.images import ImagesOf, Imaging
from bench.single_view.network import SingleView, SingleViewNetwork
from bench.single_view.own_image import best_view, read_picture
from bench.single_view.store import Recipe, overlap
from bench.single_view.training import Supervision, TrainingSettings
from bench.solve.solve import COSTS, check_field_gradient, descend, note_result
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
TRAINING = {
    "seconds.training": "of the network, once for all shapes; not part of the run's time",
    "evaluations.training": "field values that the renderer asked for in the training of the network; not of the run",
}
SHIPPED_ROW = "+method=single_view"  # the settings of the networks that are shipped
REMEDY = "add task.train=true, or give the same command to `python -m bench.train` first"
COLOURS = ("psnr", "psnr_image", "ssim")  # scores of colours
DECIDING = (  # settings that determine the network
    *("images", "image_pixels", "elevation", "shapes", "views"),
    *("network", "supervision", "training"),
)
FITTED = "fitted_mask_iou"
OF_PICTURE = {
    FITTED: "Of the mask of the given picture and the silhouette of the shape from the best of many views, both scaled "
    "to the same box: number of pixels that are foreground in both divided by the number that are foreground in at "
    "least one. The camera of the picture is not known, so that nothing else can be judged."
}
TRIED = 200  # views in the search for that of a picture


@dataclass(frozen=True)
class OneImage:
    """A shape from one image of it; the other images of the shape judge it.

    Args:
        method: "network"; or without one, the prior's "code" that is found by the image's mask, the "mean" of the
            training shapes, that with the "nearest" image, or the one that is "best" by the truth.
        images: that are rendered of each shape, from random cameras of `view`.
        image_pixels: height and width of these.
        elevation: range of the cameras' angles above the horizon, in degrees; their azimuths are those of `view`.
        shapes: of the training.
        views: images of each that the training uses, the first ones.
        given: number of the image that is given.
        network: its sizes.
        supervision: what its training may know.
        training: of the network, by `python -m bench.train`.
        search: of the prior's code.
        train: whether a run trains the network where there is none; else it is refused.
        image_path: of a picture of one's own, which takes the place of the dataset's shape; None without.
        mask_path: of its mask; None: its alpha channel.
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
        """Whether the training knows any colour."""
        return self.supervision.losses.colour > 0

    def recipe(self, inputs: RunInputs, config: dict[str, Any]) -> Recipe:
        """What determines the network that a run's configuration asks for."""
        check_field_gradient(inputs.renderer)
        sampler = replace(inputs.views, resolution=self.image_pixels, elevation=self.elevation)
        settings = {name: config["task"][name] for name in DECIDING} | {"view": asdict(sampler)}
        unsaid = {"keep_every": config["task"]["training"]["keep_every"], "schedule": "cosine"}  # as it always was
        settings["training"] = {name: x for name, x in settings["training"].items() if unsaid.get(name) != x}
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
        """Infers the shape and judges it."""
        inputs, record = run.inputs, run.record
        recipe = self.recipe(inputs, record.config)
        record.evaluations = {"value": 0, "gradient": 0}
        if self.image_path is not None:
            self._see(run, recipe, Path(self.image_path))
            return
        record.definitions = DEFINITIONS | COSTS | TRAINING
        images, subject = self._images(run, recipe)
        if self.method == NETWORK:
            self._infer(run, recipe, images, subject)
        elif self.method == CODE:
            self._search(run, images, subject)
        else:
            self._look_up(run, recipe, images, subject)

    def judged(self, field: Field, run: RunContext) -> dict[str, float]:
        """The metrics of a field that a run ended on; none for a picture of one's own, whose camera is not known."""
        if self.image_path is not None:
            return {}
        images, subject = self._images(run, self.recipe(run.inputs, run.record.config))
        if self.method == NETWORK:
            return self._judged(State(field, run.inputs), images, subject).metrics
        mesh = coloured(field, subject, run.inputs)
        return judge_mesh(mesh, subject, run.inputs).metrics | {"iou": overlap(field, images, run.inputs.device)}

    def _images(self, run: RunContext, recipe: Recipe) -> tuple[ImagesOf, Subject]:
        """The images of the scene's shape, and as photographs, of which one is given and all others judge."""
        config = run.record.config
        images = recipe.imaging.of_shape(recipe.dataset, Split(config["split"]), config["index"])
        shots = images.shots()
        others = tuple(shot for place, shot in enumerate(shots) if place != self.given)
        return images, Subject((shots[self.given],), others or shots, run.inputs.scene.mesh, "")

    def _infer(self, run: RunContext, recipe: Recipe, images: ImagesOf, subject: Subject) -> None:
        """The shape that the network gives; before, that of the mean code."""
        inputs, record = run.inputs, run.record
        model, trained = self._network(run, recipe)
        mean = torch.tensor(trained["mean_code"], device=inputs.device)
        check_kind(inputs.renderer, model.at(mean))
        part = "took part in the training, and" if self.supervision.renders else "took no part in the training; it"
        record.notes = [*record.notes, f"the renderer {part} judges as own_"]
        with run.off_clock():
            record.metrics_start = self._judged(State(model.at(mean), inputs), images, subject).metrics
        state = _inferred(run, model, images.image(self.given))
        with run.off_clock():
            note_result(run, self._judged(state, images, subject))
            if inputs.evaluation.picture is not None:
                draw_reconstruction(run.folder, state, subject, [], run.record.outcome)

    def _network(self, run: RunContext, recipe: Recipe) -> tuple[SingleView, dict[str, Any]]:
        """The network and the record of its training, which is told in the run's notes."""
        inputs = run.inputs
        path = recipe.find(inputs.cache)
        if path is None and self.train:
            with run.off_clock():
                path = recipe.make(inputs.cache, inputs.device, run.progress)
        if path is None:
            known = recipe.shipped()
            other = (
                f"; the shipped one of {recipe.dataset.name} has those of {SHIPPED_ROW} at scale=desk" if known else ""
            )
            raise BadInput(f"no network was trained for {recipe.dataset.name} with these settings: {REMEDY}{other}")
        model, trained = recipe.load(path)
        run.record.notes = [*run.record.notes, told(trained)]
        run.record.seconds |= {"training": trained["seconds"]["training"]}
        run.record.evaluations |= {"training": trained["evaluations"]["value"]}
        if not self.knows_colours:
            for weights in model.decoder.texture_head.parameters():
                weights.zero_()  # grey, in place of the colours that the training began with
        return model.to(inputs.device), trained

    def _see(self, run: RunContext, recipe: Recipe, path: Path) -> None:
        """The shape that the network gives for a picture of one's own, and the view from which it looks most alike."""
        inputs, record = run.inputs, run.record
        record.scene, record.definitions = path.name, OF_PICTURE | COSTS | TRAINING
        model, trained = self._network(run, recipe)
        mask = None if self.mask_path is None else Path(self.mask_path)
        picture, doubts = read_picture(path, mask, self.image_pixels, trained["filled"])
        record.notes = [*record.notes, *doubts]
        state = _inferred(run, model, picture)
        mesh = state.mesh
        with run.off_clock():
            if mesh is None:
                note_result(run, Evaluation({FITTED: 0.0}, None, (RunStatus.EMPTY, "the field has no surface")))
                return
            if self.knows_colours:
                mesh = replace(mesh, colours=vertex_colours(state.field, mesh, inputs.device))
            cameras = [recipe.imaging.sampler.draw(place) for place in range(TRIED)]
            camera, overlapping = best_view(mesh, cameras, picture[3] > 0.5, trained["filled"])
            note_result(run, Evaluation({FITTED: overlapping}, mesh, field=state.field))
            record.notes.append("it knows shapes of the dataset alone, whatever a picture shows")
            if inputs.evaluation.picture is not None:
                draw_picture(run.folder, mesh, picture, camera, inputs.evaluation.picture, record.outcome)

    def _judged(self, state: State, images: ImagesOf, subject: Subject) -> Evaluation:
        """The scores of a network's shape; of its colours only where its training knew some."""
        found = judge(state, subject)
        scores = {
            k: x for k, x in found.metrics.items() if self.knows_colours or k.removeprefix(OWN_PREFIX) not in COLOURS
        }
        return replace(found, metrics=scores | {"iou": overlap(state.field, images, state.inputs.device)})

    def _search(self, run: RunContext, images: ImagesOf, subject: Subject) -> None:
        """The shape of the code that is found, with the colours of the given image."""
        inputs = run.inputs
        problem = self.search.problem(subject.given[0], inputs)
        check_kind(inputs.renderer, problem.field())
        settings, least = self.search.optimiser, self.search.least_reference
        history = descend(problem, settings, run, lambda iteration: {}, least_reference=least)
        with run.off_clock():
            field = problem.field()
            scores = {"iou": overlap(field, images, inputs.device)}
            note_surface(run, coloured(field, subject, inputs), subject, scores, history, field)

    def _look_up(self, run: RunContext, recipe: Recipe, images: ImagesOf, subject: Subject) -> None:
        """A shape that needs no network, with the colours of its images."""
        inputs, record, count = run.inputs, run.record, self.shapes
        record.notes = [*record.notes, "no network and no renderer took part"]
        if self.method == MEAN:
            mesh, seen = mean_shape(recipe.dataset, count, inputs.cache, run.progress), subject.given
        else:
            others = recipe.imaging.images(recipe.dataset, Split.TRAIN, count, inputs.cache, run.progress)
            with run.on_clock():
                if self.method == NEAREST:
                    place = most_alike(images.image(self.given), others)
                else:
                    place = best_shape(inputs.scene.mesh, recipe.dataset, count)
            mesh, seen = recipe.dataset.mesh(Split.TRAIN, place), others[place].shots()
            record.notes.append(f"training shape {place}")
        with run.off_clock():
            scores = {"iou": 0.0}
            if mesh is not None:
                truth, mesh = Truth(mesh), with_colours(mesh, seen)
                scores["iou"] = overlap(
                    lambda points: torch.from_numpy(truth.signed_distance(points.numpy())), images, torch.device("cpu")
                )
            note_surface(run, mesh, subject, scores)


@torch.no_grad()
def _inferred(run: RunContext, model: SingleView, image: Float[Tensor, "4 height width"]) -> State:
    """The shape that an image shows, with its mesh, on the run's clock."""
    with run.on_clock():
        state = State(model.at(model(image[None].to(run.inputs.device))[0]), run.inputs)
        _ = state.mesh
    return state


def told(trained: dict[str, Any]) -> str:
    """What a network was trained on, in words."""
    settings, found = trained["settings"], trained["validation"]
    return (
        f"the network was trained on {settings['shapes']} shapes of {trained['dataset']['name']}, "
        f"{settings['views']} images each, for {settings['training']['steps']} steps, "
        f"{np.round(trained['seconds']['training'] / 60, 1)} min; on validation shapes its IoU is "
        f"{found['iou_network']:.3f}, that of the mean code {found['iou_mean_code']:.3f}"
    )
