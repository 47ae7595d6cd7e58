"""Files of networks in users' formats, whose field is an octahedron exactly."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.config import load
from datasets.files.network_files import NetworkFile

RADIUS = 0.5  # distance of the octahedron's faces from the origin


def arrays(factor: float = 1.0, level: float = 0.0) -> dict[str, Any]:
    """The layers of the field ((|x| + |y| + |z|) / sqrt(3) - RADIUS) * factor + level."""
    axes = np.eye(3, dtype=np.float32)
    return {
        **{"0000.dense.A": np.concatenate([axes, -axes], axis=1), "0000.dense.b": np.zeros(6, np.float32)},
        "0001.relu._": np.zeros(0, np.float32),
        "0002.dense.A": np.full((6, 1), factor / np.sqrt(3), np.float32),
        "0002.dense.b": np.array([level - factor * RADIUS], np.float32),
    }


def octahedron(points: Tensor) -> Tensor:
    return points.abs().sum(-1) / np.sqrt(3) - RADIUS


def npz(folder: Path, layers: dict[str, Any]) -> NetworkFile:
    np.savez(folder / "shape.npz", **layers)
    return load("dataset", "network", path=str(folder / "shape.npz"))


def deepsdf_folder(folder: Path, codes: Any, dtype: torch.dtype = torch.float32) -> NetworkFile:
    """A DeepSDF folder whose code is added to the octahedron's values."""
    ends = torch.tensor([[1.0, -1.0]])  # of the code alone: relu(c) - relu(-c)
    weight = torch.block_diag(ends.T, torch.tensor(arrays()["0000.dense.A"]).T)
    last = torch.cat([ends, torch.full((1, 6), 1 / np.sqrt(3))], dim=1)
    state = {"module.lin0.weight": weight, "module.lin0.bias": torch.zeros(8)}
    state |= {"module.lin1.weight": last.float(), "module.lin1.bias": torch.tensor([-RADIUS])}
    specs = {"NetworkSpecs": {"dims": [8], "geom_dimension": 3, "weight_norm": False}, "CodeLength": 1}
    stored = {"model_state_dict": {name: value.to(dtype) for name, value in state.items()}, "epoch": 3}
    for subfolder, content in (("ModelParameters", stored), ("LatentCodes", {"latent_codes": codes})):
        (folder / subfolder).mkdir()
        torch.save(content, folder / subfolder / "latest.pth")
    (folder / "specs.json").write_text(json.dumps(specs))
    return load("dataset", "network", path=str(folder))
