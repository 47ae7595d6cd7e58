"""Reads the tensors of network files by name, and gives them to a module of the user.

Only weights are read: nothing in a file is executed.
"""

import pickle
import re
import struct
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from renderers.checks import BadInput
from renderers.fields.networks.published import NORMALISED, choose_prefix, length_of, scale_to_length

OWN_CLASS = "field._target_=PACKAGE.CLASS"
# The loader raises these if a file is no pickle of weights.
CHECKPOINT_ERRORS = (pickle.UnpicklingError, LookupError, UnicodeDecodeError, struct.error)
NUMPY_SCALAR_CLASSES = [  # some checkpoints store their best loss as a NumPy scalar
    *((np._core.multiarray.scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")),
    *(np.dtype, *(type(np.dtype(name)) for name in ("f4", "f8", "i8"))),
]
# DataParallel and torch.compile write these words into names.
WRAPPERS = re.compile(r"(?<![^.])(?:(?:module|_orig_mod)\.)+")
AVERAGED_COUNT = "n_averaged"  # which torch's AveragedModel adds to the weights
NORMALISED_ENDING = re.compile(rf"\b({'|'.join(re.escape(name) for names in NORMALISED for name in names)})$")


def read_tensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by their dotted names, on the CPU; all other contents are left out."""
    try:
        with torch.serialization.safe_globals(NUMPY_SCALAR_CLASSES), warnings.catch_warnings(action="ignore"):
            return dict(_flatten(torch.load(path, weights_only=True, map_location="cpu")))
    except CHECKPOINT_ERRORS as error:
        message = "is no network file, or is broken: name a checkpoint of weights, an .npz or a folder"
        if blocked := re.search(r"GLOBAL (\S+)", str(error)):
            message = f"holds more than weights, which is not run ({blocked[1]}): save its state_dict() alone"
        raise BadInput(f"{path.name} {message}") from error
    except (OSError, RuntimeError, EOFError, ValueError, zipfile.BadZipFile) as error:
        if "TorchScript" in str(error):
            message = f"a program, which is not run: save its state_dict(), and name its class by {OWN_CLASS}"
            raise BadInput(f"{path.name} is TorchScript, {message}") from error
        raise BadInput(f"{path.name} cannot be read: it may be cut short, copy it again") from error


def without_wrappers(tensors: Mapping[str, Tensor], *, keep_first: bool = False) -> dict[str, Tensor]:
    """The tensors by names without `WRAPPERS`, or without all but the first of each name."""
    names = [name for name in tensors if name.rpartition(".")[2] != AVERAGED_COUNT]
    return {short: tensors[name] for name, short in _short_names(names, keep_first).items()}


def read_arrays(path: Path) -> dict[str, Tensor]:
    """The arrays of an `.npz` by name."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            return {name: torch.from_numpy(np.asarray(arrays[name], dtype=np.float32)) for name in arrays.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError) as error:
        raise BadInput(f"it cannot be read: {' '.join(str(error).split())}") from error


def read_codes(path: Path, length: int) -> Float[Tensor, "shapes length"]:
    """The codes of a file: a table, a single code or a list of codes, alone or under any name.

    Raises:
        BadInput: it has no codes of this length, or several tables of them.
    """
    if path.suffix == ".npy":
        try:
            tensors = {"the array": torch.from_numpy(np.load(path, allow_pickle=False))}
        except (OSError, ValueError, EOFError, TypeError) as error:
            raise BadInput(f"{path.name} cannot be read: {error}") from error
    else:
        tensors = {name: tensor for name, tensor in read_tensors(path).items() if tensor.dim()}
    candidates = [tensor for tensor in tensors.values() if tensor.dim() > 1] or [*tensors.values()]
    usable = [table for tensor in candidates if (table := _table(tensor, length)) is not None]
    tables = [table for table in usable if len(table) > 1] or usable
    are_single = len(usable) == len(candidates) == sum(map(len, usable))
    if len(tables) == 1 or (tables and are_single):
        return torch.cat(tables).float()
    shown = _listed(f"{name} {list(tensor.shape)}" for name, tensor in tensors.items()) or "no tensors"
    raise BadInput(f"its codes must be [shapes, {length}], and {path.name} has {shown}: save one such tensor")


def fit_weights(module: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Sets the parameters and buffers of a module to the tensors of their names.

    The tensors' names may have a prefix: the one under which most names and shapes are those of the module. Normalised
    weights may have torch's older or newer names, or be one tensor.

    Raises:
        BadInput: a name is missing, a tensor has another shape, or the module has no use for a tensor under the prefix.
    """
    fit = _fit(module, without_wrappers(tensors))
    if fit.faults:  # the first wrapper may be the prefix
        with suppress(BadInput):
            other = _fit(module, without_wrappers(tensors, keep_first=True))
            fit = fit if other.faults else other
    class_name = type(module).__name__
    if fit.faults:
        remedy = f"give {class_name} the arguments of its training by field.NAME=VALUE, or save its state_dict() alone"
        if not (fit.unused or fit.wrong or {*fit.missing} & {*dict(module.named_parameters())}):
            remedy = "register these buffers with persistent=False, if the class computes them"
        raise BadInput(f"its weights are not those of {class_name}: {'; '.join(fit.faults)}: {remedy}")
    saved = module.state_dict().keys()
    try:
        module.load_state_dict({name: tensor for name, tensor in fit.state.items() if name in saved})
    except RuntimeError as error:
        raise BadInput(f"{class_name} cannot take its weights: {' '.join(str(error).split())}") from error
    for name in fit.state.keys() - saved:
        module.get_buffer(name).copy_(fit.state[name])


@dataclass(frozen=True)
class _Fit:
    """The tensors of a file by a module's names, and the names that do not fit."""

    state: dict[str, Tensor]
    missing: list[str]
    unused: list[str]
    wrong: list[str]

    @property
    def faults(self) -> list[str]:
        """Sentences on the names that do not fit."""
        sentences = (("it lacks", self.missing), ("the class has no", self.unused), ("it has", self.wrong))
        return [f"{text} {_listed(names)}" for text, names in sentences if names]


def _fit(module: nn.Module, tensors: Mapping[str, Tensor]) -> _Fit:
    saved = {name: tensor for name, tensor in module.state_dict().items() if isinstance(tensor, Tensor)}
    wanted = {**dict(module.named_buffers()), **saved}
    short_names = _short_names(wanted)
    shapes = {_plain(short): _shape(wanted[name]) for name, short in short_names.items()}
    prefix = choose_prefix([*_prefixes(tensors, shapes)] or [""])
    under = {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
    matches = {name: _find(under, short_names[name], like) for name, like in wanted.items()}
    used = {name for _, names in matches.values() for name in names}
    state = {name: tensor for name, (tensor, _) in matches.items() if tensor is not None}
    wrong = [name for name in state if _shape(wanted[name]) not in (None, state[name].shape)]
    return _Fit(
        state,
        # Files of older versions of torch lack the counts of batches, which torch adds.
        missing=[name for name in saved if name not in state and not name.endswith("num_batches_tracked")],
        unused=[prefix + name for name in under if name not in used],
        wrong=[f"{name} {list(state[name].shape)} instead of {list(wanted[name].shape)}" for name in wrong],
    )


def _flatten(node: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    if isinstance(node, Tensor):
        yield prefix.removesuffix(".") or "tensor", node
    elif isinstance(node, Mapping | list | tuple):
        for key, value in node.items() if isinstance(node, Mapping) else enumerate(node):
            yield from _flatten(value, f"{prefix}{key}.")


def _short_names(names: Iterable[str], keep_first: bool = False) -> dict[str, str]:
    """Each name without `WRAPPERS`, or as it is if two names would be equal."""
    ends = {name: match.end() if keep_first and (match := WRAPPERS.search(name)) else 0 for name in names}
    short = {name: name[:end] + WRAPPERS.sub("", name[end:]) for name, end in ends.items()}
    return short if len({*short.values()}) == len(short) else {name: name for name in short}


def _plain(name: str) -> str:
    """The name that a normalised weight would have without the normalisation; other names stay."""
    return NORMALISED_ENDING.sub("weight", name)


def _shape(tensor: Tensor) -> torch.Size | None:
    """None if the file determines it, as in torch's lazy layers."""
    return None if nn.parameter.is_lazy(tensor) else tensor.shape


def _prefixes(tensors: Mapping[str, Tensor], shapes: Mapping[str, torch.Size | None]) -> Iterator[str]:
    """The prefix of each tensor whose name ends as a name of `shapes`; twice if it has the shape, too."""
    for name, tensor in tensors.items():
        words = _plain(name).split(".")
        for count in range(len(words)):
            if (ending := ".".join(words[count:])) in shapes:
                prefix = "".join(f"{word}." for word in words[:count])
                yield from [prefix, prefix] if tensor.shape == shapes[ending] else [prefix]


def _find(tensors: Mapping[str, Tensor], name: str, like: Tensor) -> tuple[Tensor | None, set[str]]:
    """The tensor of a name, in the shape of `like` if only sizes of 1 differ, and the names that it is made from."""
    tensor, sources = (tensors[name], {name}) if name in tensors else _normalised(tensors, name, like)
    if tensor is not None and (shape := _shape(like)) is not None:
        same = [size for size in tensor.shape if size != 1] == [size for size in shape if size != 1]
        tensor = tensor.reshape(shape) if same else tensor
    return tensor, sources


def _normalised(tensors: Mapping[str, Tensor], name: str, like: Tensor) -> tuple[Tensor | None, set[str]]:
    """A weight, or its length or direction, from the other ways in which a file may hold the weight."""
    plain = _plain(name)
    layer = plain.removesuffix("weight")
    ending = name.removeprefix(layer)
    index = next((pair.index(ending) for pair in NORMALISED if ending in pair), None)
    for pair in NORMALISED:
        names = [layer + suffix for suffix in pair]
        if all(each in tensors for each in names):
            length, direction = (tensors[each].float() for each in names)
            return scale_to_length(direction, length) if index is None else (length, direction)[index], {*names}
    if index is None or plain not in tensors:
        return None, set()
    weight = tensors[plain].float()
    return weight if index else length_of(weight, like.shape), {plain}


def _table(tensor: Tensor, length: int) -> Tensor | None:
    """A tensor as [shapes, length]; None if it is no such table and no single code."""
    if tensor.dim() and tensor.shape[-1] == length and sum(size != 1 for size in tensor.shape[:-1]) <= 1:
        return tensor.reshape(-1, length)
    return tensor[:, None] if length == 1 and tensor.dim() == 1 else None


def _listed(names: Iterable[str]) -> str:
    """The first six names and the number of the others."""
    listed = [*names]
    return ", ".join(listed[:6]) + (f" and {len(listed) - 6} more" if len(listed) > 6 else "")
