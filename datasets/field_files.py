"""The field that a run leaves, in one file: tensors, and in its metadata the tree of objects that they belong to.

Objects are of the classes of `CLASSES` alone, with plain values: nothing in a file is run.
"""

import json
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from renderers.checks import BadInput
from renderers.field import Field, Flops, Kind, Moved
from renderers.fields import coloured, network, occupancy, published
from renderers.fields.analytic import Shape
from renderers.fields.grid import Grid
from renderers.fields.mlp import BoundDecoder, Decoder
from renderers.fields.parts import Formula

FIELD = "field.safetensors"  # in a run's folder
RUNS = Path("results/local/runs")  # whose names `bench.load().folder` has
VERSION = "1"  # raise it when a class of these changes what it holds
MOST = 16_000_000  # bytes of a field that is stored
CLASSES: dict[str, type] = {
    one.__name__: one
    for one in (
        *(BoundDecoder, Grid, Shape, Formula, Flops, Moved, network.Adjusted, network.AtCode),
        *(coloured.ColouredDistance, coloured.ColouredGrid, coloured.OccupancyOf, coloured.ScaledOccupancyOf),
        coloured.TexturedShape,
        *(occupancy.BoundOccupancy, occupancy.OccupancyNetwork, occupancy.Block),
        *(published.Layered, published.Residual, published.Norm),
        *(nn.Linear, nn.LayerNorm, nn.ModuleList, nn.ModuleDict, nn.ParameterList),
    )
}
STATES = ("_parameters", "_buffers", "_modules")  # of an nn.Module
OWN = {*vars(nn.Module())} - {*STATES}  # what every module has; it is not stored
PRIVATE = ("_size",)  # the one attribute with an underscore that a module of these has, nn.ParameterList
WIDTH = 256  # neurons of which a pass through a field of any class is thought


def save_field(field: Field, path: Path) -> str | None:
    """Writes a field; gives a note, and writes nothing, where it has a class that is not ours or is too large."""
    tensors: dict[str, Tensor] = {}
    try:
        tree = _plain(field, tensors)
        if (size := sum(one.nbytes for one in tensors.values())) > MOST:
            raise BadInput(f"it has {size / 1e6:.0f} MB, and {MOST / 1e6:.0f} MB are the most")
    except BadInput as error:
        return f"the run leaves no {FIELD}: {error}"
    path.write_bytes(save(tensors, {"version": VERSION, "kind": field.kind.value, "field": json.dumps(tree)}))
    return None


def load_field(run: Path | str, device: torch.device | str = "cpu") -> Field:
    """The final field of a run, on a device, without gradients towards its numbers.

    Args:
        run: its folder, or the file in it, or its name in `RUNS`.
        device: of its tensors, and of points that it takes.

    Raises:
        BadInput: where there is none, or it cannot be read.
    """
    tree, tensors = _read(Path(run))
    return _field(tree, {name: tensor.to(device) for name, tensor in tensors.items()})


def load_network(run: Path | str) -> network.Published:
    """The same field as a network without a code, whose code is its place."""
    tree, tensors = _read(Path(run))
    field = _field(tree, tensors)
    if isinstance(field, BoundDecoder):
        decoder = Decoder.of([*field.hidden, field.last], code_length=0, skip=field.skip)
        return network.Published(decoder)
    return network.Published(network.Coded(_Held(tree, tensors), code_length=0, width=WIDTH))


class _Held(nn.Module):
    """A stored field as the body of a `Coded`: its tensors are buffers, so that they move to a device."""

    def __init__(self, tree: Any, tensors: dict[str, Tensor]) -> None:
        super().__init__()
        self.tree, self.flops = tree, _made(tree, tensors).flops
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    def forward(self, points: Float[Tensor, "n 3"], code: Tensor) -> Float[Tensor, " n"]:
        return _made(self.tree, dict(self.named_buffers()))(points)


def _plain(value: Any, tensors: dict[str, Tensor]) -> Any:
    """A value as JSON has it; its tensors are added to `tensors`, by numbers.

    Raises:
        BadInput: for an object of another class.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Kind):
        return {"kind": value.value}
    if isinstance(value, Tensor):
        name = f"t{len(tensors)}"
        tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"tensor": name}
    if isinstance(value, tuple | list):
        return [_plain(one, tensors) for one in value]
    if isinstance(value, dict):
        return {"pairs": [[key, _plain(one, tensors)] for key, one in value.items()]}
    name = type(value).__name__
    if CLASSES.get(name) is not type(value):
        raise BadInput(f"{type(value).__module__}.{type(value).__qualname__} is no class that is stored")
    if is_dataclass(value):
        return {"class": name, "has": {one.name: _plain(getattr(value, one.name), tensors) for one in fields(value)}}
    states = {state: _plain(dict(vars(value)[state]), tensors) for state in STATES}
    held = {key: one for key, one in vars(value).items() if key not in OWN and key not in STATES}
    return {"class": name, "has": {key: _plain(one, tensors) for key, one in held.items()}, **states}


def _made(node: Any, tensors: dict[str, Tensor]) -> Any:
    """The value of a node of JSON; the reverse of `_plain`, with tuples for lists."""
    if isinstance(node, list):
        return tuple(_made(one, tensors) for one in node)
    if not isinstance(node, dict):
        return node
    if "tensor" in node:
        return tensors[node["tensor"]]
    if "kind" in node:
        return Kind(node["kind"])
    if "pairs" in node:
        return {key: _made(one, tensors) for key, one in node["pairs"]}
    if node["class"] not in CLASSES:
        raise BadInput(f"it names the class {node['class']!r}, which is none of ours")
    one, has = CLASSES[node["class"]], {key: _made(value, tensors) for key, value in node["has"].items()}
    if is_dataclass(one):
        return one(**has)
    module = object.__new__(one)
    nn.Module.__init__(module)
    if strange := [key for key in has if key not in PRIVATE and (key.startswith("_") or hasattr(one, key))]:
        raise BadInput(f"{node['class']} has no attribute {strange[0]!r} that a file may set")
    vars(module).update(has)
    parameters, buffers, modules = (_made(node[state], tensors) for state in STATES)
    for key, tensor in parameters.items():
        module.register_parameter(key, None if tensor is None else nn.Parameter(tensor, requires_grad=False))
    for key, tensor in buffers.items():
        module.register_buffer(key, tensor)
    for key, inner in modules.items():
        module.register_module(key, inner)
    return module


def _field(tree: Any, tensors: dict[str, Tensor]) -> Field:
    """The field of a tree, which has been asked for two values.

    Raises:
        BadInput: where it is none, or its parts do not fit.
    """
    try:
        field = _made(tree, tensors)
        like = next(iter(tensors.values()))
        with torch.no_grad():
            shape = field(like.new_zeros(2, 3)).shape
        if shape != (2,) or not isinstance(field.kind, Kind):
            raise BadInput("it is no field")
    except (TypeError, KeyError, ValueError, AttributeError, RuntimeError, IndexError, StopIteration) as error:
        cause = "" if isinstance(error, BadInput) else ", its parts do not fit"
        raise BadInput(f"{FIELD} cannot be used{cause}: {' '.join(str(error).split())[:160]}") from error
    return cast(Field, field)


def _read(run: Path) -> tuple[Any, dict[str, Tensor]]:
    place = run if run.exists() else RUNS / run
    path = place / FIELD if place.is_dir() else place
    if not place.exists():
        raise BadInput(f"there is nothing at '{run}': give the folder of a run, RESULTS/runs/NAME, or a name in {RUNS}")
    if not path.is_file():
        raise BadInput(
            f"{run} has no {FIELD}: a task that looks for no field, such as ablation, leaves none; of another "
            "the run's notes say why"
        )
    try:
        with safe_open(path, "pt") as opened:
            found = opened.metadata() or {}
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118 - it is no dictionary
    except (SafetensorError, OSError) as error:
        raise BadInput(f"{path} cannot be read, it may be cut short: {' '.join(str(error).split())[:160]}") from error
    if found.get("version") != VERSION:
        raise BadInput(f"{path} has version {found.get('version')!r} of fields, and {VERSION} is read: run it again")
    try:
        return json.loads(found["field"]), tensors
    except (KeyError, ValueError, RecursionError) as error:
        raise BadInput(f"{path} holds no field: {error!r}") from error
