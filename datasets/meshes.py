"""Finds, reads and checks the user's mesh files, and makes them closed solids by `repair`."""

import difflib
import re
import struct
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from datasets.mesh import Mesh
from datasets.repair import repair
from renderers.checks import BadInput

SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb")
FLAT = 1e-12  # of the squared diagonal: a mesh with less area is a line or a point
READ_ERRORS = (  # what trimesh raises on broken files; it has no exception of its own
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError, MemoryError, OSError,
    RuntimeError, TypeError, ValueError, struct.error,
)  # fmt: skip
GREY = 0.7  # of parts without colours, beside parts that have some


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
                f"a folder must hold mesh files ({known}), found none directly in '{path}'; "
                "name the folder that has them, or one file"
            )
        return found
    if not path.exists():
        siblings = [file.name for file in path.parent.iterdir()] if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, siblings, n=1)
        remedy = f"did you mean '{path.parent / near[0]}'?" if near else "check the spelling and the current folder"
        raise ValueError(f"a mesh file or a folder of them is asked for, found nothing at '{path}'; {remedy}")
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"a mesh file must end in one of {known}, found '{path.name}'; export it in one of these formats"
        )
    return [path]


def load_mesh(path: str | Path, close: Callable[[Mesh], Mesh | None] | None = None) -> Mesh:
    """Reads one file as a closed solid, wound outward, whose `repairs` say what was changed.

    Vertices at the same place are merged, so that texture seams close. A mesh that is already closed keeps its
    surface. Otherwise its holes are closed and overlapping parts merged; where that gives no solid, it is wrapped: a
    closed surface is shrunk around it.

    Args:
        close: see `repair`.

    Raises:
        ValueError: the file is missing, empty, truncated, broken, or holds no surface or no volume.
    """
    mesh = replace(read_mesh(path), colours=None)
    try:
        return repair(mesh, close)
    except ValueError as error:
        raise BadInput(f"mesh file '{path}': {error}") from None


def read_mesh(path: str | Path) -> Mesh:
    """All triangles of a file, placed by its scene's transforms, open or closed and not repaired, with their colours.

    Raises:
        ValueError: the file is missing, empty, truncated or broken, or holds no surface.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"must be one mesh file, found the folder '{path}'; list it with find_meshes")
    (path,) = find_meshes(path)
    try:
        return _read(path)
    except ValueError as error:
        raise BadInput(f"mesh file '{path}': {error}") from None


def check_counts(path: Path, vertices: int, faces: int) -> None:
    """Refuses an .off or a .ply that holds less than its header claims: trimesh reads what is left of a cut file."""
    suffix = path.suffix.lower()
    if suffix not in (".off", ".ply"):
        return
    header = path.read_bytes().partition(b"end_header")[0].decode("ascii", "replace")
    if suffix == ".off":
        claims = [int(number) for number in re.findall(r"\d+", re.sub("#.*", "", header))[:2]]
    else:
        found = dict(re.findall(r"element (vertex|face) (\d+)", header))
        claims = [int(found.get(name, 0)) for name in ("vertex", "face")]
    if vertices < claims[0] or faces < claims[1]:
        claimed = f"its header claims {claims[0]} vertices and {claims[1]} faces"
        what = f"must be a whole {suffix} file, but it is truncated: {claimed}"
        raise ValueError(f"{what}, and it holds {vertices} and {faces}; export or copy it again")


def _read(path: Path) -> Mesh:
    import trimesh

    if path.stat().st_size == 0:
        raise ValueError("must hold a mesh, found 0 bytes; export or copy it again")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a broken file makes numpy warn; its numbers are checked below
            scene = trimesh.load_scene(path, process=False)
            parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
            vertices, faces = [np.asarray(part.vertices) for part in parts], [np.asarray(part.faces) for part in parts]
            colours = [_vertex_colours(part) for part in parts]
    except READ_ERRORS as error:
        raise ValueError(
            f"must be a whole {path.suffix.lower()} file, but reading failed ({type(error).__name__}: "
            f"{' '.join(str(error).split())[:120]}); export or copy it again"
        ) from None
    if not parts:
        where = "the file is truncated, or holds points or lines"
        raise ValueError(f"must have faces, found none: {where}; copy it again, or export it as a surface of triangles")
    check_counts(path, sum(map(len, vertices)), sum(map(len, faces)))
    offsets = np.cumsum([0] + [len(part) for part in vertices[:-1]])
    joined = np.concatenate([part + offset for part, offset in zip(faces, offsets, strict=True)])
    mesh = Mesh(np.concatenate(vertices), joined, colours=_painted(vertices, colours))
    if mesh.area <= FLAT * mesh.diagonal**2:
        raise ValueError(
            f"must have an area, found {mesh.area:.3g} in a box {mesh.diagonal:.3g} across; "
            "look for a stray vertex, or export it again"
        )
    return mesh


def _painted(
    vertices: list[Float[np.ndarray, "_ 3"]], colours: list[Float[np.ndarray, "_ 3"] | None]
) -> Float[np.ndarray, "v 3"] | None:
    """The colours of the parts' vertices; None where no part has some."""
    if all(known is None for known in colours):
        return None
    shades = [np.full(part.shape, GREY) for part in vertices]
    return np.concatenate([grey if known is None else known for grey, known in zip(shades, colours, strict=True)])


def _vertex_colours(part: Any) -> Float[np.ndarray, "v 3"] | None:
    """RGB of a trimesh.Trimesh from 0 to 1; None where its vertices and faces have none. Textures are not read."""
    from trimesh.visual.color import to_rgba

    colours = part.visual.vertex_colors if part.visual.kind in ("vertex", "face") else None
    if part.visual.kind == "texture":  # then trimesh keeps the colours of the vertices in one of two places
        colours = {**part.visual.vertex_attributes, **part.vertex_attributes}.get("color")
    return None if colours is None else to_rgba(colours)[:, :3] / 255
