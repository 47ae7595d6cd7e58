"""Local mesh files as a dataset: deformations of a single mesh, or the meshes of a folder in three splits."""

import hashlib
import os
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from datasets.extras import referenced_files, version
from datasets.files.colours import FileColours
from datasets.files.deform import Deformation
from datasets.files.duplicates import first_of_each_shape, readers_code, write_cached
from datasets.files.meshes import find_meshes, load_mesh
from datasets.mesh import Mesh, normalise
from datasets.scene import Split, seed_of
from datasets.textures import Texture
from renderers.checks import check_at_least, check_fraction

VERSION = 4  # raise it when reading, repair or deformation changes the shapes
MIN_CACHED_SECONDS = 2.0  # a mesh whose repair takes longer is cached
HELD_OUT_FRACTION = 0.2  # the validation split and the test split each have this fraction of a folder's meshes


@dataclass(frozen=True)
class LocalMeshes:
    """Shapes made from local mesh files.

    With one file, every shape is a seeded deformation of its mesh, except the first training shape: the mesh itself.
    With a folder, its meshes are distributed over the splits. After all meshes of a split, their deformations follow.

    Args:
        path: a mesh file or a folder of them.
        radius: of the sphere about the origin that contains a shape.
        strength: of the deformations; 0 leaves a mesh unchanged.
    """

    path: str
    radius: float
    strength: float

    def __post_init__(self) -> None:
        check_fraction("dataset.radius", self.radius, "rays start on the unit sphere; 0.97 leaves a margin")
        check_at_least("dataset.strength", self.strength, 0, "0 switches deformations off")
        try:
            find_meshes(self.path)
        except ValueError as error:
            raise ValueError(f"dataset.path: {error}") from None

    @property
    def name(self) -> str:
        return Path(self.path).resolve().stem

    def mesh(self, split: Split, index: int) -> Mesh:
        """A shape as a closed mesh; its `repairs` list the repairs of the file."""
        files, file = self.files(split), self._file(split, index)
        mesh = _load(file, file.stat().st_mtime_ns, self.radius)
        mesh = replace(mesh, repairs=(*self._duplicates_note, *mesh.repairs))
        alone = len(self._meshes) == 1
        if index < len(files) and (split is Split.TRAIN or not alone):
            return mesh
        deformation = Deformation.draw(seed_of(split, index), self.strength)
        return normalise(replace(mesh, vertices=deformation.apply(mesh.vertices)), self.radius)

    def texture(self, split: Split, index: int) -> Texture:
        file = self._file(split, index)
        return FileColours(file, load_repaired(file), self.mesh(split, index))

    def _file(self, split: Split, index: int) -> Path:
        files = self.files(split)
        return files[index % len(files)]

    def files(self, split: Split) -> list[Path]:
        """The files of a split; splits share none, unless there are fewer than three."""
        return self._meshes if len(self._meshes) == 1 else split_files(self._meshes)[split]

    @cached_property
    def _meshes(self) -> list[Path]:
        """The files, without those that hold the shape of a file before them."""
        return [file for file in find_meshes(self.path) if self._first_files[file] == file]

    @cached_property
    def _first_files(self) -> dict[Path, Path]:
        """The first file that holds a file's shape, by the length of names: `a.obj` is before `a (1).obj`."""
        files = sorted(find_meshes(self.path), key=lambda file: (len(file.name), file.name))
        return first_of_each_shape(files, cache_folder("shapes")) if len(files) > 1 else {files[0]: files[0]}

    @property
    def _duplicates_note(self) -> tuple[str, ...]:
        """A note on files that hold the shape of another file; empty without any."""
        repeated = [f"{file.name} that of {first.name}" for file, first in self._first_files.items() if file != first]
        counts = ", ".join(f"{len(self.files(split))} {split}" for split in Split)
        text = f"{len(repeated)} of {len(self._first_files)} files hold the shape of another file, and are left out"
        return (f"{text} ({', '.join(repeated[:3])}): {counts}",) if repeated else ()

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: the files' contents, not their paths."""
        meshes = self._meshes
        referenced = [other for file in meshes for other in referenced_files(file) if other.is_file()]
        contents = [hashlib.sha256(file.read_bytes()).hexdigest() for file in (*meshes, *referenced)]
        settings = {"radius": self.radius, "strength": self.strength}
        return {"name": "mesh", "version": VERSION, "contents": contents, **settings}


def split_files(files: list[Path]) -> dict[Split, list[Path]]:
    """Distributes files over the splits; with too few files, validation and training share theirs."""
    order = [files[i] for i in np.random.default_rng(0).permutation(len(files))]
    count = max(1, round(HELD_OUT_FRACTION * len(files)))
    test, rest = order[:count], order[count:]
    validation, train = (rest[:count], rest[count:]) if len(rest) > count else (rest, rest)
    return {Split.TEST: test, Split.VALIDATION: validation, Split.TRAIN: train}


@lru_cache(maxsize=64)
def _load(path: Path, changed: int, radius: float) -> Mesh:
    """The normalised mesh of a file, read again when the file has changed."""
    return normalise(load_repaired(path), radius)


def cache_folder(name: str) -> Path:
    """A folder of this project in the user's cache; it may not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "implicit-bench", name)


def load_repaired(path: Path) -> Mesh:
    """Loads a mesh like `load_mesh`; caches a mesh whose repair took long, since each run loads its mesh again.

    The cache key covers this code, PyMeshLab's version and the file: if one changes, the mesh is repaired again.
    """
    fingerprint = b"\0".join([str(version("pymeshlab")).encode(), readers_code(), path.read_bytes()])
    entry = cache_folder("meshes") / f"{hashlib.sha256(fingerprint).hexdigest()[:16]}.npz"
    with suppress(OSError, EOFError, ValueError, KeyError, BadZipFile), entry.open("rb") as file, np.load(file) as data:
        return Mesh(data["vertices"], data["faces"], tuple(map(str, data["repairs"])))
    started = time.perf_counter()
    mesh = load_mesh(path)
    if time.perf_counter() - started > MIN_CACHED_SECONDS:
        arrays = {"vertices": mesh.vertices, "faces": mesh.faces, "repairs": mesh.repairs}
        write_cached(entry, lambda scratch: np.savez(scratch, **arrays))
    return mesh
