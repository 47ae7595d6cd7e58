"""Finds mesh files that hold the same shape: in another format, another size or at another place."""

import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from datasets.files.meshes import read_mesh
from datasets.mesh import Mesh
from datasets.scene import Truth

SAME_SHAPE_TOLERANCE = 2e-4  # largest difference of `shape_numbers`, and distance; formats round coordinates
SAME_COLOURS_TOLERANCE = 0.05  # largest mean difference of colours from 0 to 1; formats round and average them


def first_of_each_shape(files: Sequence[Path], cache: Path) -> dict[Path, Path]:
    """For each file, the first file that holds its shape; a file that cannot be read counts as a shape of its own.

    Args:
        cache: a folder that keeps `shape_numbers` and comparisons by the files' contents, since each run asks for them.
    """
    keys, numbers = dict[Path, str](), dict[Path, np.ndarray]()
    for file in files:
        content = readers_code(), file.suffix.lower().encode(), file.read_bytes()
        keys[file] = hashlib.sha256(b"\0".join(content)).hexdigest()[:16]
        with suppress(ValueError):
            numbers[file] = _cached(cache / keys[file], lambda file=file: shape_numbers(read_mesh(file)))
    readable, first_files = [*numbers], {file: file for file in files}
    candidates = set[tuple[int, int]]()
    if len(readable) > 1:
        candidates = KDTree([*numbers.values()]).query_pairs(SAME_SHAPE_TOLERANCE, p=np.inf)
    for first, file in ((readable[i], readable[j]) for i, j in sorted(candidates)):
        if first_files[first] == first and first_files[file] == file:
            same = keys[first] == keys[file] or _cached(
                cache / f"{keys[first]}_{keys[file]}",
                lambda pair=(first, file): np.array(same_shape(*map(read_mesh, pair))),
            )
            first_files[file] = first if same else file
    return first_files


def same_shape(first: Mesh, second: Mesh) -> bool:
    """Whether two surfaces are the same but for place and size, and colours too if both have some at their vertices.

    The vertices of each must be on the other. Materials and textures are not compared.
    """
    first, second = _normalised(first), _normalised(second)
    for mesh, other in ((first, second), (second, first)):
        truth = Truth(other, closed=False)
        if truth.distance(mesh.vertices).max() > SAME_SHAPE_TOLERANCE:
            return False
        if mesh.colours is not None and other.colours is not None:
            weights, corners = truth.nearest(mesh.vertices[mesh.faces].mean(axis=1))  # no seam is there
            colours = np.einsum("nk,nkc->nc", weights, other.colours[corners])
            errors = np.abs(colours - mesh.colours[mesh.faces].mean(axis=1)).mean(axis=1)
            if np.average(errors, weights=np.linalg.norm(mesh.area_normals, axis=1)) > SAME_COLOURS_TOLERANCE:
                return False
    return True


def shape_numbers(mesh: Mesh) -> Float[np.ndarray, "12"]:
    """Numbers that do not depend on a mesh's place, size, order, seams and cuts of faces.

    They are the sides of its box, and mean and second moments of its surface in this box, by its diagonal.
    """
    mesh = _normalised(mesh)
    corners, areas = mesh.vertices[mesh.faces], np.linalg.norm(mesh.area_normals, axis=1)
    weights, sums = areas / areas.sum(), corners.sum(axis=1)
    moments = np.einsum("f,fki,fkj->ij", weights, corners, corners) + np.einsum("f,fi,fj->ij", weights, sums, sums)
    return np.concatenate([np.ptp(mesh.vertices, axis=0), weights @ sums / 3, moments[np.triu_indices(3)] / 12])


def _normalised(mesh: Mesh) -> Mesh:
    """The used vertices, with the centre of their box at the origin and its diagonal 1."""
    mesh = mesh.compact()
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return replace(mesh, vertices=(mesh.vertices - middle) / mesh.diagonal)


@lru_cache
def readers_code() -> bytes:
    """The code of this folder: what is read from a file, and cached, depends on it."""
    return b"\0".join(file.read_bytes() for file in sorted(Path(__file__).parent.rglob("*.py")))


def _cached(path: Path, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """The array at a path of the cache without its suffix, computed if it is not there."""
    entry = path.with_name(f"{path.name}.npy")
    with suppress(OSError, EOFError, ValueError):
        return np.load(entry)
    array = compute()
    write_cached(entry, lambda scratch: np.save(scratch, array))
    return array


def write_cached(entry: Path, write: Callable[[Path], None]) -> None:
    """Writes a file of the cache atomically, since another process may do the same; none if that is not possible."""
    with suppress(OSError):
        entry.parent.mkdir(parents=True, exist_ok=True)
        scratch = entry.with_name(f"{os.getpid()}.{entry.name}")
        try:
            write(scratch)
            scratch.replace(entry)
        finally:
            scratch.unlink(missing_ok=True)
