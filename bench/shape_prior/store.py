"""Stores priors: some are shipped, others are trained on first use and cached by a hash of shapes and settings."""

import os
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from bench.machine.environment import describe
from bench.progress import Report, notice
from bench.records.files import digest, file_lock, to_json, write_text
from bench.shape_prior.autodecoder import (
    DistanceSamples,
    Prior,
    PriorSettings,
    distance_samples,
    fit_error,
    surface_error,
    train,
)
from datasets.scene import Dataset, Split
from renderers.fields.mlp import Decoder

SHIPPED = Path(__file__).resolve().parents[2] / "datasets" / "priors"
VERSION = 1  # raise it when training changes, so that no prior of the old training is used for a new one
HELD_OUT = 8  # validation shapes on which a new prior is evaluated


def prior_for(
    dataset: Dataset, settings: PriorSettings, priors_dir: Path, device: torch.device, progress: Report
) -> Prior:
    """The prior of a dataset: shipped, else from `priors_dir`, else newly trained and stored there."""
    path = find(dataset, settings, priors_dir)
    if path is None:
        with file_lock(priors_dir, prior_key(dataset, settings)):
            path = find(dataset, settings, priors_dir)  # another run may have made it meanwhile
            if path is None:
                what = "fitting a network to one shape" if settings.of_one_shape else "training a prior"
                notice(f"{what} of {dataset.name}, once; it is stored in {priors_dir}")
                path = make_prior(dataset, settings, priors_dir, device, progress)
    return _load(path, settings)


def find(dataset: Dataset, settings: PriorSettings, priors_dir: Path) -> Path | None:
    """The path of a dataset's prior, or None where it was not made yet."""
    key = prior_key(dataset, settings)
    found = [path for folder in (SHIPPED, priors_dir) for path in folder.glob(f"*-{key}.safetensors")]
    return found[0] if found else None


def prior_key(dataset: Dataset, settings: PriorSettings) -> str:
    """A hash of what determines a prior: shapes, settings, and the version of the training."""
    return digest({"version": VERSION, "dataset": dataset.identity(), "settings": asdict(settings)})


def make_prior(dataset: Dataset, settings: PriorSettings, folder: Path, device: torch.device, progress: Report) -> Path:
    """Trains a prior and writes it into `folder` as NAME-KEY.safetensors, with its record as NAME-KEY.json."""
    started = time.perf_counter()
    samples = distance_samples(dataset, Split.TRAIN, settings, settings.shapes, progress)
    sampled = time.perf_counter()
    prior = train(samples, settings, device, progress)
    trained = time.perf_counter()
    record = {
        "key": prior_key(dataset, settings),
        "version": VERSION,
        "dataset": dataset.identity(),
        "settings": asdict(settings),
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": {"sampling": sampled - started, "training": trained - sampled},
        "parameters": sum(p.numel() for p in prior.decoder.parameters()),
        "surface_error": _surface_errors(prior, dataset, samples, settings, progress),
        "probe": probe(dataset),
        "environment": describe(device),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{dataset.name}-{record['key']}.safetensors"
    write_text(path.with_suffix(".json"), to_json(record))
    save_whole({**prior.decoder.state_dict(), "codes": prior.codes}, path)
    return path


def save_whole(tensors: dict[str, Tensor], path: Path) -> None:
    """Writes tensors atomically: another process finds all of the file, or none."""
    scratch = path.with_suffix(f".{os.getpid()}.partial")  # one per process: runs may be simultaneous
    save_file({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, scratch)
    scratch.replace(path)


def load_whole(path: Path) -> dict[str, Tensor] | None:
    """The tensors of a file; None where there is none, or it was cut short, so that it is made again."""
    try:
        return load_file(path) if path.exists() else None
    except (SafetensorError, OSError):
        return None


def kept(folder: Path, name: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """The tensors of NAME.safetensors in a folder; made and stored there by one process where there are none."""
    path = folder / f"{name}.safetensors"
    with file_lock(folder, name):
        tensors = load_whole(path)
        if tensors is None:
            tensors = make()
            save_whole(tensors, path)
    return tensors


def probe(dataset: Dataset) -> list[float]:
    """Area and volume of the first two training shapes: a test compares them, to detect a change of the sampler."""
    meshes = [dataset.mesh(Split.TRAIN, index) for index in range(2)]
    return [number for mesh in meshes for number in (mesh.area, mesh.volume)]


def _surface_errors(
    prior: Prior, dataset: Dataset, samples: Any, settings: PriorSettings, progress: Report
) -> dict[str, float]:
    """Mean |field| near the surface, in scene units, of training and unseen shapes, with newly fitted codes.

    A network of one shape has no other shapes: it is evaluated at its own code.
    """
    if settings.of_one_shape:
        return {"training": surface_error(prior.decoder, prior.codes, samples)}
    unseen = distance_samples(dataset, Split.VALIDATION, settings, HELD_OUT, progress)
    return {
        "training": fit_error(prior.decoder, DistanceSamples(samples.points[:HELD_OUT], samples.distances[:HELD_OUT])),
        "validation": fit_error(prior.decoder, unseen),
        "mean_shape": fit_error(prior.decoder, unseen, steps=0),
    }


def _load(path: Path, settings: PriorSettings) -> Prior:
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"the prior {path} cannot be read ({error}): delete it, and it is trained again") from error
    decoder = Decoder(**asdict(settings.network))
    codes = tensors.pop("codes")
    decoder.load_state_dict(tensors)
    return Prior(decoder.requires_grad_(False), codes)
