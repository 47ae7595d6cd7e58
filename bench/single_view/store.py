"""Networks on disk: found by what determines their training, or trained, with a record of it."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file

from bench.machine.environment import describe
from bench.progress import Report
from bench.records.record import digest, file_lock, to_json, write_text
from bench.shape_prior import save_whole
from bench.single_view.images import VERSION as IMAGES
from bench.single_view.images import ImagesOf, Imaging
from bench.single_view.network import SingleView, SingleViewNetwork
from bench.single_view.own_image import filled_share
from bench.single_view.training import Course, Failed, Lessons, Supervision, TrainingSettings
from datasets.scene import Dataset, Split
from renderers.checks import BadInput
from renderers.rendering import Renderer

SHIPPED = Path(__file__).resolve().parents[2] / "datasets" / "networks"
VERSION = 1  # raise it when training changes, so that no network of the old training is used
Values = Callable[[Float[torch.Tensor, "n 3"]], Float[torch.Tensor, " n"]]  # negative inside
TOLD = {"dataset", "settings", "seconds", "evaluations", "mean_code", "filled", "validation"}  # of a record
VALIDATION = 8  # shapes on which a new network is evaluated, from their first images


@dataclass(frozen=True)
class Recipe:
    """What determines a network.

    Args:
        shapes: number of training shapes.
        views: images of each that are used, the first of those that are rendered.
        settings: all of these as plain data, without what changes no weight.
    """

    dataset: Dataset
    shapes: int
    views: int
    imaging: Imaging
    network: SingleViewNetwork
    supervision: Supervision
    training: TrainingSettings
    renderer: Renderer
    settings: dict[str, Any]

    @property
    def key(self) -> str:
        """A hash of what determines the weights."""
        versions = [VERSION, IMAGES]
        return digest({"versions": versions, "dataset": self.dataset.identity(), "settings": self.settings})

    @property
    def stem(self) -> str:
        """The name of the network's files, without suffix."""
        return f"single_view-{self.dataset.name}-{self.key}"

    def find(self, cache: Path) -> Path | None:
        """The network's file: shipped, or in `cache`; None where it was not trained yet."""
        found = [folder / f"{self.stem}.safetensors" for folder in (SHIPPED, cache)]
        return next((path for path in found if path.exists()), None)

    def shipped(self) -> bool:
        """Whether a network of the dataset is shipped, with whatever settings."""
        return any(SHIPPED.glob(f"single_view-{self.dataset.name}-*.safetensors"))

    def load(self, path: Path) -> tuple[SingleView, dict[str, Any]]:
        """The network of a file, and the record of its training.

        Raises:
            BadInput: where one of its files is missing or cannot be read.
        """
        try:
            with torch.random.fork_rng():  # its first weights are drawn
                model = SingleView(self.network)
            model.load_state_dict(load_file(path))
            record = json.loads(path.with_suffix(".json").read_text())
            if missing := TOLD - set(record):
                raise ValueError(f"its record lacks {', '.join(sorted(missing))}")
        except (SafetensorError, OSError, RuntimeError, ValueError) as error:
            what = " ".join(str(error).split())[:160]
            raise BadInput(f"the network {path} cannot be read ({what}): delete it, and train it again") from error
        return model.eval().requires_grad_(False), record

    def make(self, cache: Path, device: torch.device, progress: Report) -> Path:
        """Trains the network, or goes on with a training that was stopped; gives its file.

        Raises:
            Failed: where the loss is not a number; the record says so, and the last good state stays.
        """
        cache.mkdir(parents=True, exist_ok=True)
        with file_lock(cache, self.stem), torch.random.fork_rng():
            if (found := self.find(cache)) is not None:
                return found
            path = cache / f"{self.stem}.safetensors"
            started = time.perf_counter()
            rendered = self.imaging.images(self.dataset, Split.TRAIN, self.shapes, cache, progress)
            images = [one.first(self.views) for one in rendered]
            made = time.perf_counter() - started
            state = path.with_suffix(".state")
            try:
                lessons = Lessons(images, self.supervision, self.renderer, self.training, device)
                model, course = lessons.train(self.network, state, progress)
            except Failed as error:
                self._write(path, {"status": "nan", "reason": str(error)}, device)
                raise
            with torch.no_grad():
                mean = torch.stack([model(one.images().to(device)).mean(dim=0) for one in images]).mean(dim=0)
            unseen = self.imaging.images(self.dataset, Split.VALIDATION, VALIDATION, cache, progress)
            found = _found(model, course, unseen, mean, device)
            seconds = {"images": made, "training": course.seconds}
            found["filled"] = filled_share(torch.cat([one.masks for one in images]))
            self._write(path, {"status": "ok", "reason": "", "seconds": seconds, **found}, device)
            save_whole(model.state_dict(), path)
            state.unlink(missing_ok=True)
        return path

    def _write(self, path: Path, more: dict[str, Any], device: torch.device) -> None:
        record = {
            "key": self.key,
            "dataset": self.dataset.identity(),
            "settings": self.settings,
            "made": datetime.now(UTC).isoformat(timespec="seconds"),
            "environment": describe(device),
        }
        write_text(path.with_suffix(".json"), to_json(record | more))


@torch.no_grad()
def overlap(shape: Values, images: ImagesOf, device: torch.device) -> float:
    """Intersection over union of a shape and the true one, by the known points in the cube (DVR, Sec. 4.1)."""
    uniform = slice(0, len(images.points) // 2)
    found = shape(images.points[uniform].to(device)).cpu() < 0
    true = images.inside[uniform]
    return float((found & true).sum() / (found | true).sum().clamp_min(1))


def _found(
    model: SingleView, course: Course, unseen: list[ImagesOf], mean: torch.Tensor, device: torch.device
) -> dict[str, Any]:
    overlaps = {
        "network": [overlap(model.at(model(one.image(0)[None].to(device))[0]), one, device) for one in unseen],
        "mean_code": [overlap(model.at(mean), one, device) for one in unseen],
    }
    return {
        "evaluations": {"value": course.counts.value, "gradient": course.counts.gradient},
        "parameters": sum(weights.numel() for weights in model.parameters()),
        "loss": {"first": course.losses[0], "last": float(np.mean(course.losses[-50:]))},
        "mean_code": mean.cpu().tolist(),
        "validation": {f"iou_{name}": float(np.mean(found)) for name, found in overlaps.items()},
    }
