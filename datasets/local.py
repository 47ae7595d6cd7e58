"""Local mesh files as a dataset: deformations of a single mesh, or the meshes of a folder in three splits."""

import hashlib
import os
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from datasets.colours import FileColours
from datasets.deform import Deformation
from datasets.extras import named_files, version
from datasets.mesh import Mesh, normalise
from datasets.meshes import find_meshes, load_mesh
from datasets.scene import Split, seed_of
from datasets.textures import Texture
from renderers.checks import check_at_least, check_fraction

VERSION = 4  # raise it when reading, repair or deformation changes the shapes
SLOW = 2.0  # seconds from which on a repaired mesh is kept
HELD_OUT = 0.2  # share of a folder's meshes in the validation split, and in the test split


@dataclass(frozen=True)
class LocalMeshes:
    """Shapes made from local mesh files.

    One file: every shape is a seeded deformation of it, except the first of the training split, which is the mesh
    itself. A folder: its meshes are distributed over the splits; once each mesh of a split has been used, its
    deformations follow.

    Args:
        path: a mesh file or a folder of them.
        radius: of the sphere about the origin that holds a shape.
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
        """The file's or the folder's name, without suffix."""
        return Path(self.path).resolve().stem

    def mesh(self, split: Split, index: int) -> Mesh:
        """A shape as a closed mesh; its `repairs` say what was repaired in the file."""
        files, file = self.files(split), self._file(split, index)
        mesh = _load(file, file.stat().st_mtime_ns, self.radius)
        alone = len(find_meshes(self.path)) == 1
        if index < len(files) and (split is Split.TRAIN or not alone):
            return mesh
        drawn = Deformation.draw(seed_of(split, index), self.strength)
        return normalise(replace(mesh, vertices=drawn.apply(mesh.vertices)), self.radius)

    def texture(self, split: Split, index: int) -> Texture:
        """The colours of a shape, as its file has them; see `Textured`."""
        file = self._file(split, index)
        return FileColours(file, repaired(file), self.mesh(split, index))

    def _file(self, split: Split, index: int) -> Path:
        files = self.files(split)
        return files[index % len(files)]

    def files(self, split: Split) -> list[Path]:
        """The files of a split; splits share none, unless there are fewer than three."""
        files = find_meshes(self.path)
        return files if len(files) == 1 else deal(files)[split]

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: the files' contents, not their paths."""
        meshes = find_meshes(self.path)
        named = [other for file in meshes for other in named_files(file) if other.is_file()]
        contents = [hashlib.sha256(file.read_bytes()).hexdigest() for file in (*meshes, *named)]
        return {
            "name": "mesh",
            "version": VERSION,
            "contents": contents,
            "radius": self.radius,
            "strength": self.strength,
        }


def deal(files: list[Path]) -> dict[Split, list[Path]]:
    """Distributes files over the splits; those of validation and of training are the same where there are too few."""
    order = [files[i] for i in np.random.default_rng(0).permutation(len(files))]
    held = max(1, round(HELD_OUT * len(files)))
    test, rest = order[:held], order[held:]
    validation, train = (rest[:held], rest[held:]) if len(rest) > held else (rest, rest)
    return {Split.TEST: test, Split.VALIDATION: validation, Split.TRAIN: train}


@lru_cache(maxsize=64)
def _load(path: Path, changed: int, radius: float) -> Mesh:
    """The mesh of a file, read again when the file has changed."""
    return normalise(repaired(path), radius)


def repaired(path: Path) -> Mesh:
    """As `load_mesh`, but what took long is kept in the user's cache, since each run loads its mesh again.

    What is kept is of this code, of PyMeshLab's version and of this file: a change of one makes it anew.
    """
    code = sorted(Path(__file__).parent.rglob("*.py"))
    made_of = b"\0".join([str(version("pymeshlab")).encode(), *(file.read_bytes() for file in (*code, path))])
    cached = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    kept = Path(cached, "implicit-bench", "meshes", f"{hashlib.sha256(made_of).hexdigest()[:16]}.npz")
    with suppress(OSError, EOFError, ValueError, KeyError, BadZipFile), kept.open("rb") as file, np.load(file) as parts:
        return Mesh(parts["vertices"], parts["faces"], tuple(map(str, parts["repairs"])))
    started = time.perf_counter()
    mesh = load_mesh(path)
    if time.perf_counter() - started > SLOW:
        with suppress(OSError):  # a cache that cannot be written to
            kept.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=kept.parent) as folder:  # another process may do the same
                np.savez(
                    made := Path(folder, kept.name), vertices=mesh.vertices, faces=mesh.faces, repairs=mesh.repairs
                )
                made.replace(kept)
    return mesh
