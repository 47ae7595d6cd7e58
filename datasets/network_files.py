"""Networks that others trained, as scenes: a file or a folder holds the field, and its surface is the true shape.

Only weights are read: nothing in a file is run.
"""

import hashlib
import json
import pickle
import re
import struct
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import lru_cache
from math import isfinite
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from datasets.field_files import FIELD, WIDTH, load_network
from datasets.mesh import Mesh, extract
from datasets.scene import Split
from renderers.checks import BadInput, check_at_least, check_choice, check_positive
from renderers.field import Kind
from renderers.fields.analytic import Shape, sphere
from renderers.fields.mlp import Decoder
from renderers.fields.network import Coded, FieldStatistics, Published, interpret, measure_field, scale_shapes
from renderers.fields.published import (
    LAYERS,
    SIGNED,
    Residual,
    load_deepsdf,
    load_mlp,
    load_occupancy_network,
    load_sdf_network,
)

VERSION = 1  # raise it when reading or measuring changes the fields
REACH = 1.05  # scene units: half the side of the cube in which the surface within the unit sphere is extracted
AUTO = "auto"
CODES = 16  # of a network, of which its sign and its steepest slope are measured
INSIDE = {AUTO: None, "negative": 1.0, "positive": -1.0}  # signs; see `FieldInterpretation`
OWN_CLASS = "field._target_=PACKAGE.CLASS"
PARTS = ("ModelParameters/latest.pth", "LatentCodes/latest.pth")  # of a DeepSDF folder
TENSORS = (
    "DeepSDF (name the folder with its specs.json); IDR, NeuS, VolSDF (implicit_network.lin0, sdf_network.lin0); "
    "occupancy networks, DVR (fc_p, conv_p)"
)
# What the loader raises of bytes that are no pickle of weights.
GARBLED = (pickle.UnpicklingError, LookupError, UnicodeDecodeError, struct.error)
SCALARS = [  # of numpy, in which some checkpoints hold their best loss; plain numbers
    *((np._core.multiarray.scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")),
    *(np.dtype, *(type(np.dtype(name)) for name in ("f4", "f8", "i8"))),
]


@dataclass(frozen=True)
class Known:
    """The network of a scene, its codes, and what was measured at the scene's own.

    Args:
        decoder: `at(code)` is a field, negative inside.
        codes: of all its shapes.
        facts: of the field as it is in the file, turned so that it is negative inside, at its level and scale.
        notes: what was measured and done, in words.
    """

    decoder: Decoder | Published
    codes: Float[Tensor, "shapes code_length"]
    facts: FieldStatistics
    notes: tuple[str, ...]


@runtime_checkable
class Networked(Protocol):
    """A dataset whose shapes a network holds: it is the field of its scenes, and its codes are their prior."""

    def network(self, index: int) -> Known:
        """The network, and what was measured at code number `index`."""
        ...


@dataclass(frozen=True)
class NetworkFile:
    """Shapes that a network holds, each the zero set of its field at one code, within the unit sphere.

    Every split has all of its codes. A network without a code has one shape, whose code is its place.

    Args:
        path: a DeepSDF folder, with specs.json; a checkpoint of IDR, NeuS, VolSDF, an occupancy network or DVR; an
            `.npz` of neural-implicit-queries; or the folder of a run that left its field.
        scale: makes the shapes so many times as large: the unit sphere is what renderers see.
        inside: which values are inside, "negative" or "positive"; "auto" takes those that are rarer on the unit sphere.
        level: of the surface, among the network's values.
        kind: what values mean: "distance", "bound" or "level"; "auto" measures it. Of a bound, values are divided by
            their steepest slope.
        codes: a file of codes, `.npy` or `.pth` [shapes, length], in place of the network's own.
        tanh: how many follow the last layer of a DeepSDF network; None: as its code has it.
        resolution: samples along an axis of the marching cubes that give the true mesh.
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
        check_choice("dataset.inside", self.inside, tuple(INSIDE))
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
        """The file's or the folder's name, without suffix."""
        return Path(self.path).resolve().stem

    def mesh(self, split: Split, index: int) -> Mesh:
        """The surface of a shape within the unit sphere, closed where it leaves it."""
        known = self.network(index)
        field = known.decoder.at(known.codes[index])
        found = extract(Shape(field, field.kind) & sphere(1.0), grid=self.resolution, reach=REACH)
        if found is None:
            raise BadInput(f"{self.path}, code {index}: the marching cubes find no surface: set dataset.resolution=256")
        return found

    def network(self, index: int) -> Known:
        """The network, whose values mean what was measured at code number `index`.

        Raises:
            BadInput: where it cannot be read, has no such code, or no surface in the unit sphere.
        """
        return _known(self, index, _content(self.files))

    @property
    def files(self) -> list[Path]:
        """The files that are read."""
        path = Path(self.path)
        parts = ("specs.json", FIELD, *PARTS) if path.is_dir() else ("",)
        return [file for file in (*(path / part for part in parts), Path(self.codes or "")) if file.is_file()]

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: the files' contents, not their paths."""
        settings = {key: value for key, value in asdict(self).items() if key not in ("path", "codes", "module")}
        return {"name": "network", "version": VERSION, "contents": _content(self.files), **settings}


@runtime_checkable
class Module(Protocol):
    """A network of the user's, an nn.Module: points [n, 3] to values [n] or [n, 1]."""

    def __call__(self, points: Tensor) -> Tensor: ...

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any: ...


@dataclass(frozen=True)
class ModuleFile(NetworkFile):
    """A network of a class of the user's, whose weights a file holds.

    Args:
        module: the network, whose weights are not read yet.
    """

    module: Module

    def identity(self) -> dict[str, Any]:
        """See `NetworkFile`; the network is told by what it prints, and by its own numbers and words."""
        own = {key: value for key, value in vars(self.module).items() if isinstance(value, int | float | str)}
        return super().identity() | {"module": f"{self.module!r} {own}"}

    def read(self) -> Published:
        """The network with the weights of the file, whatever prefix their names have there, as it is evaluated."""
        tensors, module = _tensors(Path(self.path)), deepcopy(cast(nn.Module, self.module)).eval()
        names = [*module.state_dict()]
        found = [name.removesuffix(names[0]) for name in tensors if f".{name}".endswith(f".{names[0]}")]
        if len(found) > 1 and "" not in found:
            raise BadInput(f"it has several networks, {', '.join(found)}: save the state_dict() of one of them")
        prefix = "" if "" in found else next(iter(found), "")
        try:
            module.load_state_dict({name: tensors[prefix + name] for name in names if prefix + name in tensors})
        except RuntimeError as error:
            told = " ".join(str(error).split())
            raise BadInput(f"its weights are not those of {type(module).__name__}: {told}") from error
        return Published(Coded(_Body(module), code_length=0, width=WIDTH))


class _Body(nn.Module):
    """A module as the body of a `Coded`."""

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, points: Float[Tensor, "n 3"], code: Tensor) -> Float[Tensor, " n"]:
        return self.inner(points).reshape(len(points))


@lru_cache(maxsize=4)
def _known(file: NetworkFile, index: int, content: str) -> Known:
    """The network at one code, read again when a file has changed."""
    try:
        network, codes = _read(file)
        scale_shapes(network.inner, file.scale)
        if index >= len(codes):
            some = f"{len(codes)} codes, and index={index} is none of them: set index=0 to {len(codes) - 1}"
            raise BadInput(f"it has {some if len(codes) > 1 else 'one code: set index=0'}")
        return _measured(file, network, codes, index, content)
    except BadInput as error:
        raise BadInput(f"the network {file.path}: {error}") from error


def _measured(file: NetworkFile, network: Published, codes: Tensor, index: int, content: str) -> Known:
    """The network with a field that is negative inside and of the kind that was measured."""
    others = [network.at(code) for code in codes[:: max(len(codes) // CODES, 1)]] if len(codes) > 1 else []
    meaning = measure_field(
        network.at(codes[index]),
        codes,
        kind=None if file.kind == AUTO else Kind(file.kind),
        sign=INSIDE[file.inside],
        level=file.level,
        scale=file.scale,
        others=others,
    )
    facts, kind = meaning.statistics, meaning.kind
    if not facts.min_value < 0 < facts.max_value:
        ends = sorted(
            file.level + value / (meaning.factor * meaning.divisor) for value in (facts.min_value, facts.max_value)
        )
        raise BadInput(
            f"its values in the unit sphere lie between {ends[0]:.3g} and {ends[1]:.3g}, and the surface at the level "
            f"{file.level:g} is not among them: set dataset.level (0.5 where they are probabilities), or dataset.scale"
        )
    network.register_buffer("content", torch.frombuffer(bytearray.fromhex(content), dtype=torch.uint8))
    decoder = interpret(network, meaning, level=file.level).requires_grad_(False)
    side = f"values are {'negative' if meaning.factor > 0 else 'positive'} inside, at the level {file.level:g}"
    if isinstance(network.inner, Coded) and isinstance(network.inner.body, Residual):
        side += f" of the logits, a probability of {torch.tensor(file.level).sigmoid():.2g} (occupancy networks' own "
        side += "meshes are at 0.2, dataset.level=-1.386)"
    divided = f", by values divided by {meaning.divisor:.3g}" if kind is Kind.BOUND else ""
    return Known(decoder, codes, facts, (f"{file.name}: {side}; {facts.summary}; taken as a {kind.value}{divided}",))


def _read(file: NetworkFile) -> tuple[Published, Tensor]:
    """The network of a file or a folder, and its codes."""
    path = Path(file.path)
    if isinstance(file, ModuleFile):
        network, codes = file.read(), None
    elif (path / FIELD).is_file() or (path / "record.json").is_file():
        network, codes = load_network(path), None
    elif path.is_dir():
        network, codes = _read_folder(path, file.tanh)
    elif path.suffix == ".npz":
        network, codes = load_mlp(_arrays(path)), None
    else:
        network, codes = _of_names(_tensors(path)), None
    if file.codes is not None:
        codes = _codes(Path(file.codes))
    length = network.code_length
    if codes is None:
        if not network.code_is_position:
            raise BadInput(
                f"its values depend on a code of {length} numbers, which it does not hold: set dataset.codes=FILE, an "
                f".npy or .pth of [shapes, {length}], such as an encoder's output"
            )
        codes = torch.zeros(1, length)
    if codes.dim() != 2 or codes.shape[1] != length:
        raise BadInput(f"its codes must be [shapes, {length}], not {list(codes.shape)}")
    return network, codes


def _read_folder(path: Path, squash: int | None) -> tuple[Published, Tensor | None]:
    """A DeepSDF folder's network and codes; None where it has none."""
    try:
        specs = json.loads((path / "specs.json").read_text("utf-8"))
    except OSError:
        raise BadInput("the folder has no specs.json: name a DeepSDF folder, or a file") from None
    except ValueError as error:
        raise BadInput(f"specs.json must be JSON: {error}") from error
    weights, latent = (path / part for part in PARTS)
    if not weights.is_file():
        raise BadInput(f"the folder has no {PARTS[0]}")
    network = load_deepsdf(_tensors(weights), specs, squash=squash)
    return network, _codes(latent) if latent.is_file() and not network.code_is_position else None


def _of_names(tensors: dict[str, Tensor]) -> Published:
    """The network of a checkpoint whose format its names tell."""
    if any(re.search(rf"(?:^|\.){SIGNED}\.{LAYERS}", name) for name in tensors):
        return load_sdf_network(tensors)
    if any(f".{first}_p." in f".{name}" for name in tensors for first in ("fc", "conv")):
        return load_occupancy_network(tensors)
    names = ", ".join([*tensors][:6]) or "no tensors"
    raise BadInput(
        f"it is of no format that is read, which are {TENSORS}; .npz; a class of yours, by {OWN_CLASS}: it has {names}"
    )


def _codes(path: Path) -> Tensor:
    """The codes of a file: a tensor, alone or under `latent_codes`, or the weights of an embedding."""
    if path.suffix == ".npy":
        try:
            return torch.from_numpy(np.load(path, allow_pickle=False)).float()
        except (OSError, ValueError, EOFError) as error:
            raise BadInput(f"{path.name} cannot be read: {error}") from error
    found = [tensor for tensor in _tensors(path).values() if tensor.dim() > 1]
    if len(found) != 1:
        raise BadInput(f"{path.name} must hold one table of codes, not {len(found)}")
    return (found[0].squeeze(1) if found[0].dim() == 3 else found[0]).float()


def _arrays(path: Path) -> dict[str, Tensor]:
    """The arrays of an `.npz` by name."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            return {name: torch.from_numpy(np.asarray(arrays[name], dtype=np.float32)) for name in arrays.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise BadInput(f"it cannot be read: {' '.join(str(error).split())}") from error


def _tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by their dotted names, on the CPU; whatever else it holds is left out."""
    try:
        with torch.serialization.safe_globals(SCALARS), warnings.catch_warnings(action="ignore"):
            return dict(_flat(torch.load(path, weights_only=True, map_location="cpu")))
    except GARBLED as error:
        what = "is no network file, or is broken: name a checkpoint of weights, an .npz or a folder"
        if blocked := re.search(r"GLOBAL (\S+)", str(error)):
            what = f"holds more than weights, which is not run ({blocked[1]}): save its state_dict() alone"
        raise BadInput(f"{path.name} {what}") from error
    except (OSError, RuntimeError, EOFError, ValueError, zipfile.BadZipFile) as error:
        if "TorchScript" in str(error):
            what = f"a program, which is not run: save its state_dict(), and name its class by {OWN_CLASS}"
            raise BadInput(f"{path.name} is TorchScript, {what}") from error
        raise BadInput(f"{path.name} cannot be read: it may be cut short, copy it again") from error


def _flat(found: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    if isinstance(found, Tensor):
        yield prefix.removesuffix(".") or "tensor", found
    elif isinstance(found, Mapping):
        for key, value in found.items():
            yield from _flat(value, f"{prefix}{key}.")


def _content(files: list[Path]) -> str:
    """A hash of files."""
    each = (file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest() for file in files)
    return hashlib.sha256(b"".join(each)).hexdigest()
