"""Networks on disk: found by a hash of everything that determines them, or trained, with a record of the training."""

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
from bench.shape_prior import save_atomically
from bench.tasks.single_view.images import VERSION as IMAGES_VERSION
from bench.tasks.single_view.images import Imaging, ShapeImages
from bench.tasks.single_view.network import SingleView, SingleViewNetwork
from bench.tasks.single_view.own_image import filled_fraction
from bench.tasks.single_view.training import Supervision, Training, TrainingFailed, TrainingHistory, TrainingSettings
from datasets.scene import Dataset, Split
from renderers.checks import BadInput
from renderers.rendering import Renderer

SHIPPED = Path(__file__).resolve().parents[3] / "datasets" / "networks"
VERSION = 1  # raise it when training changes, so that no old network is used
SignedField = Callable[[Float[torch.Tensor, "n 3"]], Float[torch.Tensor, " n"]]  # negative inside
REQUIRED_KEYS = {"dataset", "settings", "seconds", "evaluations", "mean_code", "filled", "validation"}
VALIDATION_SHAPES = 8  # a new network is evaluated on the first images of so many


@dataclass(frozen=True)
class Recipe:
    """Everything that determines a network.

    Args:
        shapes: number of training shapes.
        views: number of images used per shape, the first of the rendered ones.
        settings: all settings that change the weights, as plain data.
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
        """A hash of everything that determines the weights."""
        dataset = self.dataset.identity()
        return digest({"versions": [VERSION, IMAGES_VERSION], "dataset": dataset, "settings": self.settings})

    @property
    def stem(self) -> str:
        return f"single_view-{self.dataset.name}-{self.key}"

    def find(self, cache: Path) -> Path | None:
        """The network's file: shipped, or in `cache`; None if it was not trained yet."""
        paths = [folder / f"{self.stem}.safetensors" for folder in (SHIPPED, cache)]
        return next((path for path in paths if path.exists()), None)

    def shipped(self) -> bool:
        """Whether a network of the dataset is shipped, with any settings."""
        return any(SHIPPED.glob(f"single_view-{self.dataset.name}-*.safetensors"))

    def load(self, path: Path) -> tuple[SingleView, dict[str, Any]]:
        """The network of a file, and the record of its training.

        Raises:
            BadInput: one of its files is missing or cannot be read.
        """
        try:
            with torch.random.fork_rng():  # initial weights are random
                model = SingleView(self.network)
            model.load_state_dict(load_file(path))
            record = json.loads(path.with_suffix(".json").read_text())
            if missing := REQUIRED_KEYS - set(record):
                raise ValueError(f"its record lacks {', '.join(sorted(missing))}")
        except (SafetensorError, OSError, RuntimeError, ValueError) as error:
            cause = " ".join(str(error).split())[:160]
            raise BadInput(f"the network {path} cannot be read ({cause}): delete it, and train it again") from error
        return model.eval().requires_grad_(False), record

    def make(self, cache: Path, device: torch.device, progress: Report) -> Path:
        """Trains the network, or continues a stopped training; returns its file.

        Raises:
            TrainingFailed: the loss is not a number; the record has the reason, and the last good state stays.
        """
        cache.mkdir(parents=True, exist_ok=True)
        with file_lock(cache, self.stem), torch.random.fork_rng():
            if (existing := self.find(cache)) is not None:
                return existing
            path = cache / f"{self.stem}.safetensors"
            started = time.perf_counter()
            rendered = self.imaging.images(self.dataset, Split.TRAIN, self.shapes, cache, progress)
            images = [shape.first(self.views) for shape in rendered]
            image_seconds = time.perf_counter() - started
            state = path.with_suffix(".state")
            try:
                training = Training(images, self.supervision, self.renderer, self.training, device)
                model, history = training.train(self.network, state, progress)
            except TrainingFailed as error:
                self._write(path, {"status": "nan", "reason": str(error)}, device)
                raise
            with torch.no_grad():
                codes = torch.stack([model(shape.images().to(device)).mean(dim=0) for shape in images])
            validation = self.imaging.images(self.dataset, Split.VALIDATION, VALIDATION_SHAPES, cache, progress)
            results = _training_results(model, history, validation, codes.mean(dim=0), device)
            seconds = {"images": image_seconds, "training": history.seconds}
            results["filled"] = filled_fraction(torch.cat([shape.masks for shape in images]))
            self._write(path, {"status": "ok", "reason": "", "seconds": seconds, **results}, device)
            save_atomically(model.state_dict(), path)
            state.unlink(missing_ok=True)
        return path

    def _write(self, path: Path, outcome: dict[str, Any], device: torch.device) -> None:
        record = {
            "key": self.key,
            "dataset": self.dataset.identity(),
            "settings": self.settings,
            "made": datetime.now(UTC).isoformat(timespec="seconds"),
            "environment": describe(device),
        }
        write_text(path.with_suffix(".json"), to_json(record | outcome))


@torch.no_grad()
def overlap(shape: SignedField, images: ShapeImages, device: torch.device) -> float:
    """Intersection over union of a shape and the true shape, at points in the cube (DVR, Sec. 4.1)."""
    uniform = slice(0, len(images.points) // 2)
    predicted = shape(images.points[uniform].to(device)).cpu() < 0
    true = images.inside[uniform]
    return float((predicted & true).sum() / (predicted | true).sum().clamp_min(1))


def _training_results(
    model: SingleView, history: TrainingHistory, validation: list[ShapeImages], mean: torch.Tensor, device: torch.device
) -> dict[str, Any]:
    overlaps = {
        "network": [overlap(model.at(model(s.image(0)[None].to(device))[0]), s, device) for s in validation],
        "mean_code": [overlap(model.at(mean), s, device) for s in validation],
    }
    return {
        "evaluations": {"value": history.counts.value, "gradient": history.counts.gradient},
        "parameters": sum(weights.numel() for weights in model.parameters()),
        "loss": {"first": history.losses[0], "last": float(np.mean(history.losses[-50:]))},
        "mean_code": mean.cpu().tolist(),
        "validation": {f"iou_{name}": float(np.mean(values)) for name, values in overlaps.items()},
    }
