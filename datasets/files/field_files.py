"""Loads the final field of a run; see `datasets.saved_field`. Reads `field=file`, a network file as the scene's field.

Only objects of the classes in `CLASSES` with plain values are loaded, and nothing in a file is executed.
"""

import json
import re
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from datasets.saved_field import FIELD_FILE, STATE_ATTRIBUTES, VERSION
from renderers.checks import BadInput
from renderers.field import Field, Flops, Kind, Moved
from renderers.fields.analytic import Shape
from renderers.fields.grid import Grid
from renderers.fields.mlp import BoundDecoder
from renderers.fields.networks import coloured, encoded, lipschitz, network, occupancy, published
from renderers.fields.parts import Formula
from renderers.fields.textured import TexturedShape

DEFAULT_RUNS_FOLDER = Path("results/local/runs")  # has the names of `bench.load().folder`
CLASSES: dict[str, type] = {
    class_.__name__: class_
    for class_ in (
        *(BoundDecoder, Grid, Shape, Formula, Flops, Moved, network.Adjusted, network.AtCode),
        *(encoded.EncodedNetwork, encoded.FourierFeatures, encoded.HashGrid),
        *(lipschitz.LipschitzNetwork, lipschitz.LipschitzLayer),
        *(coloured.ColouredDistance, coloured.ColouredEncoded, coloured.ColouredGrid),
        *(coloured.OccupancyOf, coloured.ScaledOccupancyOf),
        TexturedShape,
        *(occupancy.BoundOccupancy, occupancy.OccupancyNetwork, occupancy.Block),
        *(published.Layered, published.Residual, published.Norm),
        *(nn.Linear, nn.LayerNorm, nn.ModuleList, nn.ModuleDict, nn.ParameterList),
    )
}
PRIVATE_ATTRIBUTES = ("_size",)  # the only one allowed; nn.ParameterList has it
# With field=file, messages name the keys that the user typed; see `expand_field_file`.
FIELD_FILE_ALIASES = {"dataset.path: ": "field_path: ", "dataset.module.": "field."}
ASSUMED_WIDTH = 256  # neurons per layer of a field of unknown structure; sets the points per pass


def load_field(run: Path | str, device: torch.device | str = "cpu") -> Field:
    """The final field of a run, on a device, without gradients towards its parameters.

    Args:
        run: its folder, the file in it, or its name in `DEFAULT_RUNS_FOLDER`.
        device: of its tensors and input points.

    Raises:
        BadInput: the run has no field, or it cannot be read.
    """
    tree, tensors = _read(Path(run))
    return _field(tree, {name: tensor.to(device) for name, tensor in tensors.items()})


def load_network(run: Path | str) -> network.Published:
    """The final field of a run as a network with a code of length 0."""
    tree, tensors = _read(Path(run))
    field = _field(tree, tensors)
    if isinstance(field, BoundDecoder):
        decoder = published.decoder_of([*field.hidden, field.last], code_length=0, skip=field.skip)
        return network.Published(decoder)
    return network.Published(network.Coded(_StoredField(tree, tensors), code_length=0, width=ASSUMED_WIDTH))


class _StoredField(nn.Module):
    """A stored field as the body of a `Coded`. Its tensors are buffers, so they move with the module to a device."""

    def __init__(self, tree: Any, tensors: dict[str, Tensor]) -> None:
        super().__init__()
        self.tree, self.flops = tree, _from_tree(tree, tensors).flops
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    def forward(self, points: Float[Tensor, "n 3"], code: Tensor) -> Float[Tensor, " n"]:
        return _from_tree(self.tree, dict(self.named_buffers()))(points)


def _from_tree(node: Any, tensors: dict[str, Tensor]) -> Any:
    """Builds the value of a JSON node: the inverse of `datasets.saved_field.to_tree`, with tuples for lists."""
    if isinstance(node, list):
        return tuple(_from_tree(entry, tensors) for entry in node)
    if not isinstance(node, dict):
        return node
    if "tensor" in node:
        return tensors[node["tensor"]]
    if "kind" in node:
        return Kind(node["kind"])
    if "pairs" in node:
        return {key: _from_tree(entry, tensors) for key, entry in node["pairs"]}
    if node["class"] not in CLASSES:
        raise BadInput(f"it names the class {node['class']!r}, which is none of ours")
    class_, has = CLASSES[node["class"]], {key: _from_tree(value, tensors) for key, value in node["has"].items()}
    if is_dataclass(class_):
        return class_(**has)
    module = object.__new__(class_)
    nn.Module.__init__(module)
    if unknown := [key for key in has if key not in PRIVATE_ATTRIBUTES and (key[:1] == "_" or hasattr(class_, key))]:
        raise BadInput(f"{node['class']} has no attribute {unknown[0]!r} that a file may set")
    vars(module).update(has)
    parameters, buffers, modules = (_from_tree(node[state], tensors) for state in STATE_ATTRIBUTES)
    for key, tensor in parameters.items():
        module.register_parameter(key, None if tensor is None else nn.Parameter(tensor, requires_grad=False))
    for key, tensor in buffers.items():
        module.register_buffer(key, tensor)
    for key, inner in modules.items():
        module.register_module(key, inner)
    return module


def _field(tree: Any, tensors: dict[str, Tensor]) -> Field:
    """Builds the field of a tree, and evaluates it at two points as a check.

    Raises:
        BadInput: the tree is no field, or its parts do not fit together.
    """
    try:
        field = _from_tree(tree, tensors)
        like = next(iter(tensors.values()))
        with torch.no_grad():
            shape = field(like.new_zeros(2, 3)).shape
        if shape != (2,) or not isinstance(field.kind, Kind):
            raise BadInput("it is no field")
    except (TypeError, KeyError, ValueError, AttributeError, RuntimeError, IndexError, StopIteration) as error:
        cause = "" if isinstance(error, BadInput) else ", its parts do not fit"
        raise BadInput(f"{FIELD_FILE} cannot be used{cause}: {' '.join(str(error).split())[:160]}") from error
    return cast(Field, field)


def _read(run: Path) -> tuple[Any, dict[str, Tensor]]:
    location = run if run.exists() else DEFAULT_RUNS_FOLDER / run
    path = location / FIELD_FILE if location.is_dir() else location
    if not location.exists():
        remedy = f"give the folder of a run, RESULTS/runs/NAME, or a name in {DEFAULT_RUNS_FOLDER}"
        raise BadInput(f"there is nothing at '{run}': {remedy}")
    if not path.is_file():
        raise BadInput(
            f"{run} has no {FIELD_FILE}: a task that looks for no field, such as ablation, leaves none; of another "
            "the run's notes say why"
        )
    try:
        with safe_open(path, "pt") as opened:
            metadata = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - it is no dictionary
    except (SafetensorError, OSError) as error:
        raise BadInput(f"{path} cannot be read, it may be cut short: {' '.join(str(error).split())[:160]}") from error
    if metadata.get("version") != VERSION:
        raise BadInput(f"{path} has version {metadata.get('version')!r} of fields, and {VERSION} is read: run it again")
    try:
        return json.loads(metadata["field"]), tensors
    except (KeyError, ValueError, RecursionError) as error:
        raise BadInput(f"{path} holds no field: {error!r}") from error


def expand_field_file(arguments: list[str]) -> list[str]:
    """Replaces `field=file field_path=PATH`, a network file as the scene's field, by the arguments of its dataset.

    `field._target_=PACKAGE.CLASS` names the network's class, and other keys of `field` are arguments of the class.

    Raises:
        ValueError: if one of the two is missing, or another dataset is chosen.
    """
    keys = [argument.partition("=")[0] for argument in arguments]
    if "field=file" not in arguments and "field_path" not in keys:
        return arguments
    if "field=file" not in arguments or "field_path" not in keys:
        raise ValueError("a network's file is the scene's field by field=file field_path=PATH: type both")
    if "dataset" in keys:
        raise ValueError("with field=file the network's own surface is the shape: remove dataset")
    has_class = "field._target_" in keys
    replacements = {"^field=file$": f"dataset={'module' if has_class else 'network'}", "^field_path=": "dataset.path="}
    if has_class:
        replacements |= {r"^field\._target_=": "dataset.module._target_=", r"^field\.": "+dataset.module."}
    for pattern, text in replacements.items():
        arguments = [re.sub(pattern, text, argument) for argument in arguments]
    return arguments


def typed_field_keys(message: str) -> str:
    """A message with the keys of `field=file` that the user typed, in place of those of its dataset."""
    for key, alias in FIELD_FILE_ALIASES.items():
        message = message.replace(key, alias)
    return message
