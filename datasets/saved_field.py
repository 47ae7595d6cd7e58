"""Saves the final field of a run: a file of tensors, with the tree of their objects in its metadata.

`datasets.files.field_files` loads it.
"""

import json
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor, nn

from renderers.checks import BadInput
from renderers.field import Field, Kind

FIELD_FILE = "field.safetensors"
VERSION = "1"  # raise it when a stored class changes its attributes
MAX_FIELD_BYTES = 16_000_000
STORED_MODULES = ("renderers.", "torch.nn.modules.")  # where the classes of fields are
STATE_ATTRIBUTES = ("_parameters", "_buffers", "_modules")
STANDARD_ATTRIBUTES = {*vars(nn.Module())}  # every module has these


def save_field(field: Field, path: Path) -> str | None:
    """Writes a field. If it is too large or has a class of another project, writes nothing and returns a note."""
    tensors: dict[str, Tensor] = {}
    try:
        tree = to_tree(field, tensors)
        if (size := sum(tensor.nbytes for tensor in tensors.values())) > MAX_FIELD_BYTES:
            raise BadInput(f"it has {size / 1e6:.0f} MB, and {MAX_FIELD_BYTES / 1e6:.0f} MB are the most")
    except BadInput as error:
        return f"the run leaves no {FIELD_FILE}: {error}"
    path.write_bytes(save(tensors, {"version": VERSION, "kind": field.kind.value, "field": json.dumps(tree)}))
    return None


def to_tree(value: Any, tensors: dict[str, Tensor]) -> Any:
    """Converts a value to JSON data; adds its tensors to `tensors` under numbered names.

    Raises:
        BadInput: an object is of a class that is not stored.
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
        return [to_tree(entry, tensors) for entry in value]
    if isinstance(value, dict):
        return {"pairs": [[key, to_tree(entry, tensors)] for key, entry in value.items()]}
    name, module = type(value).__name__, type(value).__module__
    if not module.startswith(STORED_MODULES):
        raise BadInput(f"{module}.{type(value).__qualname__} is no class that is stored")
    if is_dataclass(value):
        return {"class": name, "has": {key.name: to_tree(getattr(value, key.name), tensors) for key in fields(value)}}
    states = {key: to_tree(dict(vars(value)[key]), tensors) for key in STATE_ATTRIBUTES}
    has = {key: to_tree(entry, tensors) for key, entry in vars(value).items() if key not in STANDARD_ATTRIBUTES}
    return {"class": name, "has": has, **states}
