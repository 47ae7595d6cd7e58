"""Trained networks of others as scenes: the true shape is the zero set of a network in a file or a folder.

Only weights are read: nothing in a file is executed.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from math import isfinite
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor, nn

from datasets.files.checkpoints import OWN_CLASS, fit_weights, read_arrays, read_codes, read_tensors, without_wrappers
from datasets.files.field_files import ASSUMED_WIDTH, load_network
from datasets.mesh import Mesh, extract
from datasets.saved_field import FIELD_FILE
from datasets.scene import SceneNetwork, Split
from renderers.checks import BadInput, check_at_least, check_choice, check_positive
from renderers.field import Kind
from renderers.fields.analytic import Shape, sphere
from renderers.fields.networks.forward import check_module, copy_module
from renderers.fields.networks.network import (
    Coded,
    FieldInterpretation,
    Published,
    interpret,
    measure_field,
    scale_shapes,
)
from renderers.fields.networks.published import (
    LAYERS,
    SIGNED,
    SOFTPLUS_NOTE,
    Residual,
    load_deepsdf,
    load_mlp,
    load_occupancy_network,
    load_sdf_network,
)

VERSION = 1  # raise it when reading or measuring changes the fields
CUBE_HALF_SIDE = 1.05  # scene units: the surface within the unit sphere is extracted in this cube
AUTO = "auto"
MEASURED_CODES = 16  # the sign and the Lipschitz constant are measured at about so many codes
INSIDE_SIGNS = {AUTO: None, "negative": 1.0, "positive": -1.0}  # see `FieldInterpretation`
# Values of one sign are unsigned distances if they come so close to 0, as a share of the largest, and if their slope
# there is at least such a share of the largest slope. Probabilities and densities are flat there.
TOUCHING_SHARE, UNSIGNED_SLOPE_SHARE = 0.05, 0.2
DEEPSDF_FILES = ("ModelParameters/latest.pth", "LatentCodes/latest.pth")
SUPPORTED_CHECKPOINTS = (
    "DeepSDF (name the folder with its specs.json); IDR, NeuS, VolSDF (implicit_network.lin0, sdf_network.lin0); "
    "occupancy networks, DVR (fc_p, conv_p)"
)


@dataclass(frozen=True)
class NetworkFile:
    """The shapes of a network, each the zero set of its field at one code, within the unit sphere.

    Every split has all codes. A network without codes has one shape.

    Args:
        path: a DeepSDF folder, with specs.json; a checkpoint of IDR, NeuS, VolSDF, an occupancy network or DVR; an
            `.npz` of neural-implicit-queries; or the folder of a run with a saved field.
        scale: factor that enlarges the shapes; renderers see the unit sphere.
        inside: sign of the values inside, "negative" or "positive"; "auto" takes the sign rarer on the unit sphere.
        level: value of the network on the surface.
        kind: kind of field: "distance", "bound" or "level"; "auto" measures it. The values of a bound are divided by
            its Lipschitz constant.
        codes: a file of codes, `.npy` or `.pth` [shapes, length], that replace the network's codes.
        tanh: number of tanh after the last layer of a DeepSDF network; None takes the number of its code.
        resolution: samples per axis of the marching cubes that give the true mesh.
    """

    path: str
    scale: float
    inside: str
    level: float
    kind: str
    codes: str | None
    tanh: int | None
    resolution: int

    def __post_init__(self) -> None:
        check_positive("dataset.scale", self.scale, "1 leaves the network's own units")
        check_choice("dataset.inside", self.inside, tuple(INSIDE_SIGNS))
        check_choice("dataset.kind", self.kind, (AUTO, *(kind.value for kind in Kind)))
        check_at_least("dataset.resolution", self.resolution, 16, "128 keeps thin parts")
        if self.tanh is not None:
            check_at_least("dataset.tanh", self.tanh, 0, "1 is as in DeepSDF's code of 2019")
        if not isfinite(self.level):
            remedy = "0 for distances and logits, 0.5 for probabilities"
            raise ValueError(f"dataset.level must be finite, not {self.level}: {remedy}")
        if not Path(self.path).exists():
            raise ValueError(f"dataset.path: there is nothing at '{self.path}': name a network's file or folder")

    @property
    def name(self) -> str:
        return Path(self.path).resolve().stem

    def mesh(self, split: Split, index: int) -> Mesh:
        """The surface of a shape within the unit sphere, closed along the sphere."""
        network = self.network(index)
        field = network.decoder.at(network.codes[index])
        surface = extract(Shape(field, field.kind) & sphere(1.0), grid=self.resolution, reach=CUBE_HALF_SIDE)
        if surface is None:
            raise BadInput(f"{self.path}, code {index}: the marching cubes find no surface: set dataset.resolution=256")
        return surface

    def network(self, index: int) -> SceneNetwork:
        """The network, converted to a field by measurements at code number `index`.

        Raises:
            BadInput: it cannot be read, has no such code, or no surface in the unit sphere.
        """
        return _load_network(self, index, _content_hash(self.files))

    @property
    def files(self) -> list[Path]:
        path = Path(self.path)
        names = ("specs.json", FIELD_FILE, *DEEPSDF_FILES) if path.is_dir() else ("",)
        return [file for file in (*(path / name for name in names), Path(self.codes or "")) if file.is_file()]

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: the files' contents, not their paths."""
        settings = {key: value for key, value in asdict(self).items() if key not in ("path", "codes", "module")}
        return {"name": "network", "version": VERSION, "contents": _content_hash(self.files), **settings}


@runtime_checkable
class Module(Protocol):
    """A network of the user, an nn.Module: points [n, 3] to values [n] or [n, 1]."""

    def __call__(self, points: Tensor) -> Tensor: ...

    def modules(self) -> Any: ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any: ...


@dataclass(frozen=True)
class ModuleFile(NetworkFile):
    """A network of a class of the user, with its weights in a file.

    Args:
        module: the network, before its weights are read.
    """

    module: Module

    def identity(self) -> dict[str, Any]:
        """Plain data, see `NetworkFile`, with the module's `repr` and its plain attributes."""
        attributes = {key: value for key, value in vars(self.module).items() if isinstance(value, int | float | str)}
        return super().identity() | {"module": f"{self.module!r} {attributes}"}

    def read(self) -> Published:
        """The network in evaluation mode, with the weights of the file; their names may have any prefix."""
        module = copy_module(cast(nn.Module, self.module))
        fit_weights(module.eval(), read_tensors(Path(self.path)))
        body = check_module(module.requires_grad_(False))  # lazy layers have no parameters before
        return Published(Coded(body, code_length=0, width=ASSUMED_WIDTH), assumption=body.note)


@lru_cache(maxsize=4)
def _load_network(file: NetworkFile, index: int, content: str) -> SceneNetwork:
    """The network, measured at one code; read again when a file has changed."""
    try:
        network, codes = _read(file)
        scale_shapes(network.inner, file.scale)
        if index >= len(codes):
            message = f"{len(codes)} codes, and index={index} is none of them: set index=0 to {len(codes) - 1}"
            raise BadInput(f"it has {message if len(codes) > 1 else 'one code: set index=0'}")
        return _measured(file, network, codes, index, content)
    except BadInput as error:
        raise BadInput(f"the network {file.path}: {error}") from error


def _measured(file: NetworkFile, network: Published, codes: Tensor, index: int, content: str) -> SceneNetwork:
    """The network, converted to a field that is negative inside and of the measured kind."""
    others = [network.at(code) for code in codes[:: max(len(codes) // MEASURED_CODES, 1)]] if len(codes) > 1 else []
    meaning = measure_field(
        network.at(codes[index]),
        codes,
        kind=None if file.kind == AUTO else Kind(file.kind),
        sign=INSIDE_SIGNS[file.inside],
        level=file.level,
        scale=file.scale,
        others=others,
    )
    facts, kind = meaning.statistics, meaning.kind
    if not facts.min_value < 0 < facts.max_value:
        raise BadInput(_no_surface(file, network, meaning))
    network.register_buffer("content", torch.frombuffer(bytearray.fromhex(content), dtype=torch.uint8))
    decoder = interpret(network, meaning, level=file.level).requires_grad_(False)
    side = f"values are {'negative' if meaning.factor > 0 else 'positive'} inside, at the level {file.level:g}"
    if isinstance(network.inner, Coded) and isinstance(network.inner.body, Residual):
        side += f" of the logits, a probability of {torch.tensor(file.level).sigmoid():.2g} (occupancy networks' own "
        side += "meshes are at 0.2, dataset.level=-1.386)"
    side += f"; {network.assumption}" if network.assumption else ""
    divided = f", by values divided by {meaning.divisor:.3g}" if kind is Kind.BOUND else ""
    note = f"{file.name}: {side}; {facts.summary}; taken as a {kind.value}{divided}"
    return SceneNetwork(decoder, codes, (note,))


def _no_surface(file: NetworkFile, network: Published, meaning: FieldInterpretation) -> str:
    """Why values of one side of the level have no surface, and what to set."""
    facts = meaning.statistics
    ends = (file.level + value / (meaning.factor * meaning.divisor) for value in (facts.min_value, facts.max_value))
    low, high = sorted(ends)
    hint = "a number between them"
    if 0 <= low <= TOUCHING_SHARE * high and facts.near_slopes[1] >= UNSIGNED_SLOPE_SHARE * facts.max_slope:
        hint = "0.05 for a shell, as unsigned distances have no inside"
    elif 0 <= low < 0.5 < high <= 1:
        hint = "0.5 where they are probabilities"
    elif low >= 0 and SOFTPLUS_NOTE not in network.assumption:
        hint = f"such as {(low + high) / 2:.2g} where they are densities"
    assumption = f" ({network.assumption})" if network.assumption else ""
    return (
        f"its values in the unit sphere lie between {low:.3g} and {high:.3g}, and the surface at the level "
        f"{file.level:g} is not among them{assumption}: set dataset.level ({hint}), or dataset.scale"
    )


def _read(file: NetworkFile) -> tuple[Published, Tensor]:
    """The network of a file or a folder, and its codes."""
    path = Path(file.path)
    if isinstance(file, ModuleFile):
        network = file.read()
    elif (path / FIELD_FILE).is_file() or (path / "record.json").is_file():
        network = load_network(path)
    elif path.is_dir():
        network = _read_folder(path, file.tanh)
    elif path.suffix == ".npz":
        network = load_mlp(read_arrays(path))
    else:
        network = _by_tensor_names(without_wrappers(read_tensors(path)))
    length, stored = network.code_length, path / DEEPSDF_FILES[1]
    if file.codes is not None:
        return network, read_codes(Path(file.codes), length)
    if network.code_is_position:
        return network, torch.zeros(1, length)
    if not stored.is_file():
        raise BadInput(
            f"its values depend on a code of {length} numbers, which it does not hold: set dataset.codes=FILE, an "
            f".npy or .pth of [shapes, {length}], such as an encoder's output"
        )
    return network, read_codes(stored, length)


def _read_folder(path: Path, squash: int | None) -> Published:
    try:
        specs = json.loads((path / "specs.json").read_text("utf-8"))
    except OSError:
        raise BadInput("the folder has no specs.json: name a DeepSDF folder, or a file") from None
    except ValueError as error:
        raise BadInput(f"specs.json must be JSON: {error}") from error
    weights = path / DEEPSDF_FILES[0]
    if not weights.is_file():
        raise BadInput(f"the folder has no {DEEPSDF_FILES[0]}")
    return load_deepsdf(without_wrappers(read_tensors(weights)), specs, squash=squash)


def _by_tensor_names(tensors: dict[str, Tensor]) -> Published:
    """The network of a checkpoint; its tensors' names determine its format."""
    if any(re.search(rf"(?:^|\.){SIGNED}\.{LAYERS}", name) for name in tensors):
        network = load_sdf_network(tensors)
        network.assumption += f"; another activation needs its class, {OWN_CLASS}"
        return network
    if any(f".{first}_p." in f".{name}" for name in tensors for first in ("fc", "conv")):
        return load_occupancy_network(tensors)
    names = ", ".join([*tensors][:6]) or "no tensors"
    formats = f"{SUPPORTED_CHECKPOINTS}; .npz; a class of yours, by {OWN_CLASS}"
    raise BadInput(f"it is of no format that is read, which are {formats}: it has {names}")


def _content_hash(files: list[Path]) -> str:
    hashes = (file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest() for file in files)
    return hashlib.sha256(b"".join(hashes)).hexdigest()
