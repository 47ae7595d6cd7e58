"""Finds, reads and checks the user's mesh files, and makes them closed solids by `repair`."""

import difflib
import struct
import warnings
from pathlib import Path

import numpy as np

from datasets.mesh import Mesh
from datasets.repair import repair
from datasets.truncated import check_whole
from renderers.checks import BadInput

SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb")
FLAT = 1e-12  # of the squared diagonal: a mesh with less area is a line or a point
READ_ERRORS = (  # what trimesh raises on broken files; it has no exception of its own
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError, MemoryError, OSError,
    RuntimeError, TypeError, ValueError, struct.error,
)  # fmt: skip


def find_meshes(path: str | Path) -> list[Path]:
    """Lists the mesh files at `path`: the file itself, or those directly in the folder, sorted by name.

    Raises:
        ValueError: nothing is there, the folder holds no meshes, or the suffix is unknown.
    """
    path, known = Path(path), " ".join(SUFFIXES)
    if path.is_dir():
        found = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file())
        if not found:
            raise ValueError(
                f"path: a folder must hold mesh files ({known}), found none directly in '{path}'; "
                "name the folder that has them, or one file"
            )
        return found
    if not path.exists():
        siblings = [file.name for file in path.parent.iterdir()] if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, siblings, n=1)
        remedy = f"did you mean '{path.parent / near[0]}'?" if near else "check the spelling and the current folder"
        raise ValueError(f"dataset.path must be a mesh file or a folder of them, found nothing at '{path}'; {remedy}")
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"path: a mesh file must end in one of {known}, found '{path.name}'; export it in one of these formats"
        )
    return [path]


def load_mesh(path: str | Path) -> Mesh:
    """Reads one file as a closed solid, wound outward, whose `repairs` say what was changed.

    Vertices at the same place are merged, so that texture seams close. A mesh that is already closed keeps its
    surface. Otherwise its holes are closed and overlapping parts merged; where that gives no solid, it is wrapped: a
    closed surface is shrunk around it.

    Raises:
        ValueError: the file is missing, empty, truncated, broken, or holds no surface or no volume.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"path: must be one mesh file, found the folder '{path}'; list it with find_meshes")
    (path,) = find_meshes(path)
    try:
        return repair(_read(path))
    except ValueError as error:
        raise BadInput(f"mesh file '{path}': {error}") from None


def _read(path: Path) -> Mesh:
    """Reads all triangles of a file, placed by its scene's transforms."""
    import trimesh

    if path.stat().st_size == 0:
        raise ValueError("must hold a mesh, found 0 bytes; export or copy it again")
    doubts = check_whole(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a broken file makes numpy warn; its numbers are checked below
            scene = trimesh.load_scene(path, process=False)
            parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
            parts = [(np.asarray(part.vertices), np.asarray(part.faces)) for part in parts if len(part.faces)]
    except READ_ERRORS as error:
        raise ValueError(
            f"must be a whole {path.suffix.lower()} file, but reading failed ({type(error).__name__}: "
            f"{' '.join(str(error).split())[:120]}); export or copy it again"
        ) from None
    if not parts:
        where = "the file is truncated, or holds points or lines"
        raise ValueError(f"must have faces, found none: {where}; copy it again, or export it as a surface of triangles")
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    faces = [part[1] + offset for part, offset in zip(parts, offsets, strict=False)]
    mesh = Mesh(np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces), doubts)
    if mesh.area <= FLAT * mesh.diagonal**2:
        raise ValueError(
            f"must have an area, found {mesh.area:.3g} in a box {mesh.diagonal:.3g} across; "
            "look for a stray vertex, or export it again"
        )
    return mesh
