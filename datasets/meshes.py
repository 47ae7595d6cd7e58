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
from datasets.readers.ply import read_ply
from datasets.readers.text import read_obj, read_off
from datasets.repair import repair
from renderers.checks import BadInput

SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb")
FLAT = 1e-12  # of the squared diagonal: a mesh with less area is a line or a point
READ_ERRORS = (  # what trimesh raises on broken files; it has no exception of its own
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError, MemoryError, OSError,
    RuntimeError, TypeError, ValueError, struct.error,
)  # fmt: skip
READERS = {".obj": read_obj, ".off": read_off, ".ply": read_ply}  # other formats by trimesh
MISTAKEN = {  # how other files begin: what they are, and the remedy
    b"\x00\x05\x16\x07": ("a Mac's notes on a file, whose names begin with '._'", "take the file without '._'"),
    b"version https://git-lfs": ("a pointer of Git LFS", "run 'git lfs pull'"),
    b"\x1f\x8b": ("a file compressed by gzip", "unpack it"),
    b"PK\x03\x04": ("a .zip archive", "unpack it"),
    b"<!doctype html": ("a web page", "download the file itself"),
    b"<html": ("a web page", "download the file itself"),
}
PACKED = re.compile(
    rb'"extensionsRequired"\s*:\s*\[[^\]]*"(KHR_draco_mesh_compression|EXT_meshopt_compression)"'
)  # a .glb
GREY = 0.7  # of parts without colours, beside parts that have some


def find_meshes(path: str | Path) -> list[Path]:
    """Lists the mesh files at `path`: the file itself, or those directly in the folder, sorted by name.

    Raises:
        ValueError: nothing is there, the folder holds no meshes, or the suffix is unknown.
    """
    path, known = Path(path), " ".join(SUFFIXES)
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file()]
        found = sorted(file for file in files if not file.name.startswith("._"))  # a Mac's notes on files
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


def _read(path: Path) -> Mesh:
    content = path.read_bytes()
    if not content:
        raise ValueError("must hold a mesh, found 0 bytes; export or copy it again")
    for start, (what, remedy) in MISTAKEN.items():
        if content[:64].lstrip().lower().startswith(start.lower()):
            raise ValueError(f"must hold a mesh, found {what}; {remedy}")
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")  # a broken file makes numpy warn; its numbers are checked below
        parts = _parts(path, content)
    vertices, faces = [np.asarray(part.vertices) for part in parts], [np.asarray(part.faces) for part in parts]
    colours = [_vertex_colours(part) for part in parts]
    offsets = np.cumsum([0] + [len(part) for part in vertices[:-1]])
    joined = np.concatenate([part + offset for part, offset in zip(faces, offsets, strict=True)])
    mesh = Mesh(np.concatenate(vertices), joined, colours=_painted(vertices, colours))
    if mesh.area <= FLAT * mesh.diagonal**2:
        raise ValueError(
            f"must have an area, found {mesh.area:.3g} in a box {mesh.diagonal:.3g} across; "
            "look for a stray vertex, or export it again"
        )
    return mesh


def _parts(path: Path, content: bytes) -> list[Any]:
    """The parts of a file, as trimesh.Trimesh: one or more, all with faces."""
    import trimesh

    suffix = path.suffix.lower()
    if suffix in READERS:
        polygons = READERS[suffix](content)
        triangles, owner = polygons.triangles()
        if not len(triangles):
            count = len(polygons.vertices)
            what = (
                f"it holds {count} vertices, as points or lines"
                if count
                else f"it has no vertex either, as {suffix} writes them"
            )
            raise ValueError(f"must have faces, found none: {what}; export it as a surface")
        shades = None if polygons.face_colours is None else polygons.face_colours[owner]
        painted = {"vertex_colors": polygons.vertex_colours, "face_colors": shades}
        return [trimesh.Trimesh(polygons.vertices, triangles, process=False, **painted)]
    _check_binary(suffix, content)
    try:
        scene = trimesh.load_scene(path, process=False)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except READ_ERRORS as error:
        why = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise ValueError(f"must be readable as {suffix}, but reading failed ({why}); export or copy it again") from None
    if not parts:
        where = "the file is truncated, or holds points, lines or fans"
        raise ValueError(f"must have faces, found none: {where}; copy it again, or export it as a surface of triangles")
    return parts


def _check_binary(suffix: str, content: bytes) -> None:
    """Refuses an .stl of another length than it claims, and a .glb with packed numbers: trimesh names no cause."""
    if suffix == ".stl" and len(content) > 83 and b"facet" not in content[:2000].lower():
        count = int.from_bytes(content[80:84], "little")
        if len(content) != 84 + 50 * count:
            raise ValueError(
                f"must be a whole .stl file, {84 + 50 * count} bytes for the {count} faces that it claims, found "
                f"{len(content)}; export or copy it again"
            )
    if suffix == ".glb" and (packed := PACKED.search(content)):
        raise ValueError(f"must be a .glb that is not packed, found {packed[1].decode()}; export it uncompressed")


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
