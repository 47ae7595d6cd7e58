"""Finds mesh files that hold the same shape: in another format, another size or at another place."""

import hashlib
import os
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from datasets.files.meshes import read_mesh
from datasets.mesh import Mesh

SAME_SHAPE_TOLERANCE = 2e-4  # largest difference of `shape_numbers`; formats round coordinates


def first_of_each_shape(files: Sequence[Path], cache: Path) -> dict[Path, Path]:
    """For each file, the first file that holds its shape; a file that cannot be read counts as a shape of its own.

    Args:
        cache: a folder that keeps `shape_numbers` by the files' contents, since each run asks for them.
    """
    numbers = {file: stored for file in files if (stored := _cached_numbers(file, cache)) is not None}
    readable, first_files = [*numbers], {file: file for file in files}
    if len(readable) > 1:
        for i, j in sorted(KDTree([*numbers.values()]).query_pairs(SAME_SHAPE_TOLERANCE, p=np.inf)):
            first_files[readable[j]] = min(first_files[readable[i]], first_files[readable[j]], key=files.index)
    return first_files


def shape_numbers(mesh: Mesh) -> Float[np.ndarray, "12"]:
    """Numbers that do not depend on a mesh's place, size, order, seams and cuts of faces.

    They are the sides of its box, and mean and second moments of its surface in this box, by its diagonal.
    """
    points = mesh.used_vertices
    low, high = points.min(axis=0), points.max(axis=0)
    corners = (mesh.vertices[mesh.faces] - (low + high) / 2) / mesh.diagonal
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weights, sums = areas / areas.sum(), corners.sum(axis=1)
    moments = np.einsum("f,fki,fkj->ij", weights, corners, corners) + np.einsum("f,fi,fj->ij", weights, sums, sums)
    return np.concatenate([(high - low) / mesh.diagonal, weights @ sums / 3, moments[np.triu_indices(3)] / 12])


@lru_cache
def _code() -> bytes:
    """The code on which the numbers of a file depend, that of its readers too."""
    return b"\0".join(file.read_bytes() for file in sorted(Path(__file__).parent.rglob("*.py")))


def _cached_numbers(file: Path, cache: Path) -> Float[np.ndarray, "12"] | None:
    """See `shape_numbers`; None for a file that cannot be read."""
    key = hashlib.sha256(b"\0".join([_code(), file.suffix.lower().encode(), file.read_bytes()]))
    entry = cache / f"{key.hexdigest()[:16]}.npy"
    with suppress(OSError, EOFError, ValueError):
        return np.load(entry)
    try:
        numbers = shape_numbers(read_mesh(file))
    except ValueError:
        return None
    with suppress(OSError):  # a cache that cannot be written to
        cache.mkdir(parents=True, exist_ok=True)
        scratch = entry.with_name(f"{os.getpid()}.{entry.name}")
        np.save(scratch, numbers)
        scratch.replace(entry)
    return numbers
