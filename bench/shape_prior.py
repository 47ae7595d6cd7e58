"""Shape priors: an auto-decoder (DeepSDF, Sec. 4) trained on the training split of a dataset.

Some are shipped; others are trained at their first use and stored under a hash of shapes and settings.
"""

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from math import cos, pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from bench.config import build
from bench.machine.environment import describe
from bench.progress import Report, notice
from bench.records.record import digest, file_lock, to_json, write_text
from bench.tables import extension, extensions
from datasets.mesh import Mesh
from datasets.scene import Dataset, Split, Truth, sample_surface
from renderers.checks import check_at_least, check_positive
from renderers.field import LatentDecoder
from renderers.fields.mlp import Decoder

SHIPPED = Path(__file__).resolve().parents[1] / "datasets" / "priors"
VERSION = 1  # raise it when training changes, so that no prior of the old training is used for a new one
NEAR_SAMPLE_STD, FAR_SAMPLE_STD = 0.01, 0.08  # scene units, from the surface: of half and of a third of the samples
SAMPLE_SPHERE_RADIUS = 1.1  # scene units: the other samples fill this sphere; rays start on the unit sphere


@dataclass(frozen=True)
class NetworkSettings:
    """The decoder's size; see `renderers.fields.mlp.Decoder`."""

    layers: int
    width: int
    code_length: int
    skip: int
    narrow: bool


@dataclass(frozen=True)
class PriorSettings:
    """Settings of the training of a prior.

    Args:
        network: the decoder's size.
        shapes: number of training shapes.
        samples: signed distances per shape.
        steps: optimiser steps, each on `shapes_per_step` shapes and `points_per_step` points of each.
        learning_rate: at the start; it falls to zero along a cosine.
        beta2: of Adam.
        code_sigma: standard deviation of the initial codes.
        code_penalty: weight of the mean squared length of the codes.
        surface_width: errors are weighted by w / (w + |distance|), which is largest at the surface; w in scene units.
        seed: of samples, codes, weights and batches.
        truncation: magnitude, in scene units, to which the field and the true distance are clamped before they are
            compared (delta of DeepSDF, Eq. 4, which takes 0.1); None compares them everywhere. Beyond it, the field is
            not constrained: a march clamps its values too (`renderer.step_clamp`).
        colour: settings of the colours, see the extension `colour_codes`; None learns only the distance.
    """

    network: NetworkSettings
    shapes: int
    samples: int
    steps: int
    shapes_per_step: int
    points_per_step: int
    learning_rate: float
    beta2: float
    code_sigma: float
    code_penalty: float
    surface_width: float
    seed: int
    truncation: float | None = None
    colour: Any = None

    def __post_init__(self) -> None:
        for name in ("shapes", "samples", "steps", "shapes_per_step", "points_per_step"):
            check_at_least(f"prior.{name}", getattr(self, name), 1, "conf/prior holds values that work")
        check_positive("prior.learning_rate", self.learning_rate, "5e-3 works")
        check_positive("prior.surface_width", self.surface_width, "0.05 works")
        if self.truncation is not None:
            check_positive("prior.truncation", self.truncation, "DeepSDF has 0.1; null compares distances everywhere")
        if isinstance(self.colour, dict):
            colour = build(self.colour, "prior.colour", target=extensions()["colour_codes"])
            object.__setattr__(self, "colour", colour)

    @property
    def of_one_shape(self) -> bool:
        return self.shapes == 1

    @property
    def identity(self) -> dict[str, Any]:
        """Plain data that determines the training."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    def new_decoder(self) -> Any:
        """A decoder initialised near the distance of a sphere, see `LatentDecoder`."""
        decoder = (Decoder if self.colour is None else self.colour.new_decoder)(**asdict(self.network))
        initialise_to_sphere(decoder if isinstance(decoder, Decoder) else decoder.shape, radius=0.5)
        return decoder


@dataclass(frozen=True)
class Prior:
    """A decoder whose codes are shapes, and the codes of its training shapes. Code zero is the mean shape."""

    decoder: LatentDecoder
    codes: Float[Tensor, "shapes code_length"]


@dataclass(frozen=True)
class DistanceSamples:
    """Signed distances of shapes, and the colours of points on their surfaces if colours are learnt."""

    points: Float[Tensor, "shapes samples 3"]
    distances: Float[Tensor, "shapes samples"]
    surface: Float[Tensor, "shapes colour_samples 3"] | None = None
    colours: Float[Tensor, "shapes colour_samples 3"] | None = None


def distance_samples(
    dataset: Dataset, split: Split, settings: PriorSettings, shapes: int, progress: Report
) -> DistanceSamples:
    """Samples the signed distances of the first shapes of a split, mostly near their surfaces.

    Distances are computed from the mesh, since smooth unions and sheared shapes have no distance formula.
    """
    arrays = []
    for index in range(shapes):
        mesh, seed = dataset.mesh(split, index), settings.seed + index
        samples = sample_distances(mesh, settings.samples, seed)
        if settings.colour:
            samples += settings.colour.sampled(mesh, settings.colour.texture_of(dataset, split, index), seed)
        arrays.append(samples)
        progress(f"sampling {split} shapes", index + 1, shapes)
    return DistanceSamples(*map(torch.stack, zip(*arrays, strict=True)))


def sample_distances(mesh: Mesh, count: int, seed: int) -> tuple[Float[Tensor, "count 3"], Float[Tensor, " count"]]:
    """Points and their signed distances, in scene units.

    Half of them are close to the mesh's surface, a third farther from it, the rest uniform in a sphere.
    """
    generator = np.random.default_rng(seed)
    near_count, far_count = count // 2, count // 3
    surface = sample_surface(mesh, near_count + far_count, seed).points
    sigma = np.repeat([NEAR_SAMPLE_STD, FAR_SAMPLE_STD], [near_count, far_count])[:, None]
    close = surface + sigma * generator.standard_normal(surface.shape)
    uniform = generator.standard_normal((count - near_count - far_count, 3))
    radii = SAMPLE_SPHERE_RADIUS * generator.random((len(uniform), 1)) ** (1 / 3)
    uniform *= radii / np.linalg.norm(uniform, axis=1, keepdims=True)
    positions = np.concatenate([close, uniform])
    return torch.from_numpy(positions.astype(np.float32)), torch.from_numpy(Truth(mesh).signed_distance(positions))


def near_surface_first(
    error: Float[Tensor, "*batch"], distance: Float[Tensor, "*batch"], width: float
) -> Float[Tensor, "*batch"]:
    """Weights errors by width / (width + |distance|), which is largest at the surface."""
    return error * width / (width + distance.abs())


def truncated(distance: Float[Tensor, "*batch"], truncation: float | None) -> Float[Tensor, "*batch"]:
    """Clamps distances to a magnitude; None does not change them."""
    return distance if truncation is None else distance.clamp(-truncation, truncation)


def train(samples: DistanceSamples, settings: PriorSettings, device: torch.device, progress: Report) -> Prior:
    """Fits the decoder and a code for each shape together (DeepSDF, Sec. 4.2)."""
    torch.manual_seed(settings.seed)
    decoder = settings.new_decoder()
    codes = settings.code_sigma * torch.randn(len(samples.points), settings.network.code_length)
    decoder, codes = decoder.to(device), nn.Parameter(codes.to(device))
    samples = DistanceSamples(*(tensor if tensor is None else tensor.to(device) for tensor in vars(samples).values()))
    optimiser = torch.optim.Adam(
        [*decoder.parameters(), codes], lr=settings.learning_rate, betas=(0.9, settings.beta2), fused=True
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser, lambda step: 0.5 * (1 + cos(pi * min(step / settings.steps, 1.0)))
    )
    phase = "fitting the network" if settings.of_one_shape else "training the prior"
    shapes, count = samples.distances.shape
    rows = min(settings.shapes_per_step, shapes)
    for step in range(settings.steps):
        chosen = torch.randperm(shapes, device=device)[:rows]
        indices = torch.randint(count, (rows, settings.points_per_step), device=device)
        points, distances = samples.points[chosen[:, None], indices], samples.distances[chosen[:, None], indices]
        shape = decoder.at(codes[chosen])
        error = truncated(shape(points), settings.truncation) - truncated(distances, settings.truncation)
        weighted = near_surface_first(error.abs(), distances, settings.surface_width)
        loss = weighted.mean() + settings.code_penalty * codes[chosen].square().sum(-1).mean()
        if settings.colour is not None:
            loss = loss + settings.colour.loss(shape, samples.surface, samples.colours, chosen)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 50 == 0 or step + 1 == settings.steps:
            progress(phase, step + 1, settings.steps, loss.item())
    return Prior(decoder.cpu().requires_grad_(False), codes.detach().cpu())


@torch.no_grad()
def initialise_to_sphere(decoder: Decoder, radius: float) -> None:
    """Sets the weights so that the field is near the distance of a sphere (SAL, Atzmon and Lipman 2020)."""
    for index, layer in enumerate(decoder.hidden):
        nn.init.normal_(layer.weight, 0.0, sqrt(2.0 / layer.out_features))
        nn.init.zeros_(layer.bias)
        if index == 0:
            nn.init.normal_(layer.weight[:, :-3], 0.0, 1.0 / sqrt(layer.out_features))
        elif index == decoder.skip:
            layer.weight[:, -3:] = 0.0
    nn.init.normal_(decoder.last.weight, sqrt(pi / decoder.width), 1e-4)
    nn.init.constant_(decoder.last.bias, -radius)


def prior_for(
    dataset: Dataset, settings: PriorSettings, priors_dir: Path, device: torch.device, progress: Report
) -> Prior:
    path = prior_file(dataset, settings, priors_dir, device, progress)
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"the prior {path} cannot be read ({error}): delete it, and it is trained again") from error
    decoder = settings.new_decoder()
    codes = tensors.pop("codes")
    decoder.load_state_dict(tensors)
    return Prior(decoder.requires_grad_(False), codes)


def prior_file(
    dataset: Dataset, settings: PriorSettings, priors_dir: Path, device: torch.device, progress: Report
) -> Path:
    """The path of a dataset's prior: shipped, else in `priors_dir`; trains and stores a missing one."""
    path = find_prior(dataset, settings, priors_dir)
    if path is None:
        with file_lock(priors_dir, prior_key(dataset, settings)):
            path = find_prior(dataset, settings, priors_dir)  # another run may have made it meanwhile
            if path is None:
                work = "fitting a network to one shape" if settings.of_one_shape else "training a prior"
                notice(f"{work} of {dataset.name}, once; it is stored in {priors_dir}")
                path = make_prior(dataset, settings, priors_dir, device, progress)
    return path


def find_prior(dataset: Dataset, settings: PriorSettings, priors_dir: Path) -> Path | None:
    key = prior_key(dataset, settings)
    paths = [path for folder in (SHIPPED, priors_dir) for path in folder.glob(f"*-{key}.safetensors")]
    return paths[0] if paths else None


def prior_key(dataset: Dataset, settings: PriorSettings) -> str:
    """A hash of the shapes, settings and training version that determine a prior."""
    return digest({"version": VERSION, "dataset": dataset.identity(), "settings": settings.identity})


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
        "settings": settings.identity,
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": {"sampling": sampled - started, "training": trained - sampled},
        "parameters": sum(p.numel() for p in prior.decoder.parameters()),
        "surface_error": extension("prior_errors")(prior, dataset, samples, settings, progress),
        "probe": probe(dataset),
        "environment": describe(device),
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{dataset.name}-{record['key']}.safetensors"
    write_text(path.with_suffix(".json"), to_json(record))
    save_atomically({**prior.decoder.state_dict(), "codes": prior.codes}, path)
    return path


def save_atomically(tensors: dict[str, Tensor], path: Path) -> None:
    """Writes tensors atomically: another process finds the complete file or none."""
    scratch = path.with_suffix(f".{os.getpid()}.partial")  # one per process: runs may be simultaneous
    save_file({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, scratch)
    scratch.replace(path)


def load_or_make(folder: Path, name: str, make: Callable[[], dict[str, Tensor]]) -> dict[str, Tensor]:
    """Loads NAME.safetensors from a folder; if it is missing or broken, one process makes and stores it."""
    path = folder / f"{name}.safetensors"
    with file_lock(folder, name):
        try:
            return load_file(path)
        except (SafetensorError, OSError):  # missing or truncated
            tensors = make()
            save_atomically(tensors, path)
            return tensors


def probe(dataset: Dataset) -> list[float]:
    """Area and volume of the first two training shapes; a test uses them to detect a change of the sampler."""
    meshes = [dataset.mesh(Split.TRAIN, index) for index in range(2)]
    return [number for mesh in meshes for number in (mesh.area, mesh.volume)]
