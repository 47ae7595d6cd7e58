"""Shape and colour from one image, by a network trained on many shapes (DVR, Sec. 4.1)."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from bench.reconstruct.judge import COLOURED_DEFINITIONS, judge
from bench.reconstruct.pictures import draw_reconstruction
from bench.reconstruct.subject import Subject
from bench.setup.inputs import RunContext, RunInputs
from bench.single_view.images import ImagesOf, Imaging
from bench.single_view.network import SingleViewNetwork
from bench.single_view.store import Recipe, overlap
from bench.single_view.training import Supervision, TrainingSettings
from bench.solve.problem import check_field_gradient, check_kind
from bench.solve.solve import COSTS, note_result
from datasets.dataset import Split
from datasets.photographs import Photography
from datasets.shot import Shot
from renderers.checks import BadInput, check_at_least

MEAN, NETWORK = "mean_code", "network"
DEFINITIONS = COLOURED_DEFINITIONS | {
    "iou": "intersection over union of the volumes, by points drawn evenly in the cube (DVR, Sec. 4.1), from 0 to 1; "
    "before: of the mean code of all training images",
    "seconds.inference": "from the image to the mesh",
}
DECIDING = ("images", "image_pixels", "network", "supervision", "training")  # settings that determine the network


@dataclass(frozen=True)
class OneImage:
    """A shape from one image of it; the other images of the shape judge it.

    Args:
        images: that are rendered of each shape, from random cameras of `view`.
        image_pixels: height and width of these.
        given: number of the image that is given.
        network: its sizes.
        supervision: what its training may know.
        training: of the network, by `python -m bench.train`.
    """

    images: Photography
    image_pixels: int
    given: int
    network: SingleViewNetwork
    supervision: Supervision
    training: TrainingSettings

    def __post_init__(self) -> None:
        check_at_least("task.image_pixels", self.image_pixels, 16, "64 shows the shape")
        if not 0 <= self.given < self.images.views:
            raise ValueError(f"task.given must be one of the {self.images.views} images, not {self.given}: 0")

    def recipe(self, inputs: RunInputs, config: dict[str, Any]) -> Recipe:
        """What determines the network that a run's configuration asks for.

        Args:
            inputs: of the run.
            config: resolved, as plain data.
        """
        check_field_gradient(inputs.renderer)
        settings = {name: config["task"][name] for name in DECIDING} | {"view": config["view"]}
        settings["renderer"] = {k: v for k, v in config["renderer"].items() if not k.startswith("_") or k == "_target_"}
        imaging = Imaging(self.images, inputs.views).resized(self.image_pixels)
        return Recipe(inputs.dataset, imaging, self.network, self.supervision, self.training, inputs.renderer, settings)

    def execute(self, run: RunContext) -> None:
        """Infers the shape and judges it; before, that of the mean code."""
        inputs, record = run.inputs, run.record
        record.definitions = DEFINITIONS | COSTS
        recipe = self.recipe(inputs, record.config)
        path = recipe.find(inputs.cache)
        if path is None:
            raise BadInput(f"no network was trained for these settings: {remedy(record.config)}")
        model, trained = recipe.load(path)
        model = model.to(inputs.device)
        mean = torch.tensor(trained["mean_code"], device=inputs.device)
        check_kind(inputs.renderer, model.at(mean))
        images = recipe.imaging.of_shape(recipe.dataset, Split(record.config["split"]), record.config["index"])
        subject = subject_of(images, self.given, inputs)
        clock = time.perf_counter()
        with torch.no_grad():
            code = model(images.image(self.given)[None].to(inputs.device))[0]
        record.seconds |= {"forward": time.perf_counter() - clock, "backward": 0.0}
        record.evaluations = {"value": 0, "gradient": 0}
        record.notes = [*record.notes, told(trained), "the renderer took part in the training, and judges as own_"]
        with run.off_clock():
            before = judge(model.at(mean), subject, inputs)
            record.metrics_start = before.metrics | {"iou": overlap(model, mean, images, inputs.device)}
            clock = time.perf_counter()
            after = judge(model.at(code), subject, inputs)
            after.metrics["iou"] = overlap(model, code, images, inputs.device)
            note_result(run, after)
            if inputs.evaluation.picture is not None:
                title = f"{record.task}, {record.name}, {record.scene}: {record.status}"
                draw_reconstruction(run.folder, inputs, model.at(code), subject, [], title)


def subject_of(images: ImagesOf, given: int, inputs: RunInputs) -> Subject:
    """The given image, and all others as those that judge."""
    parts = zip(images.cameras, images.colours, images.masks, images.depths, strict=True)
    shots = [
        Shot(str(place), camera, colours.float() / 255, mask, depth)
        for place, (camera, colours, mask, depth) in enumerate(parts)
    ]
    others = tuple(shot for place, shot in enumerate(shots) if place != given)
    return Subject((shots[given],), others or (shots[given],), inputs.scene.mesh, "")


def remedy(config: dict[str, Any]) -> str:
    """The command that trains the network of a configuration."""
    return "run the same command with `python -m bench.train` instead of `python -m bench`"


def told(trained: dict[str, Any]) -> str:
    """What a network was trained on, in words."""
    training, found = trained["settings"]["training"], trained["validation"]
    return (
        f"the network was trained on {training['shapes']} shapes of {trained['dataset']['name']} for "
        f"{training['steps']} steps, {np.round(trained['seconds']['training'] / 60, 1)} min; on validation shapes its "
        f"IoU is {found['iou_network']:.3f}, that of the mean code {found['iou_mean_code']:.3f}"
    )
