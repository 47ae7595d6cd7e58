"""Finds, reads and checks the user's mesh files, and makes them closed solids by `repair`."""

import difflib
import re
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from datasets.mesh import Mesh
from datasets.repair import repair
from renderers.checks import BadInput

SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb")
FLAT = 1e-12  # of the squared diagonal: a mesh with less area is a line or a point
READ_ERRORS = (  # what trimesh raises on broken files; it has no exception of its own
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError, MemoryError, OSError,
    RuntimeError, TypeError, ValueError, struct.error,
)  # fmt: skip
UNUSED = 0.1  # share of the vertices that no face uses: in a whole .obj next to none, in one without its end many


class Truncated(ValueError):
    """A file lacks its end; the message says what is missing."""


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


def load_mesh(path: str | Path, close: Callable[[Mesh], Mesh | None] | None = None) -> Mesh:
    """Reads one file as a closed solid, wound outward, whose `repairs` say what was changed.

    Vertices at the same place are merged, so that texture seams close. A mesh that is already closed keeps its
    surface. Otherwise its holes are closed and overlapping parts merged; where that gives no solid, it is wrapped: a
    closed surface is shrunk around it.

    Args:
        path: the file.
        close: see `repair`.

    Raises:
        ValueError: the file is missing, empty, truncated, broken, or holds no surface or no volume.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"path: must be one mesh file, found the folder '{path}'; list it with find_meshes")
    (path,) = find_meshes(path)
    try:
        return repair(read_mesh(path), close)
    except ValueError as error:
        raise BadInput(f"mesh file '{path}': {error}") from None


def check_whole(path: Path) -> tuple[str, ...]:
    """Finds out whether an .obj, an .off or an .ply of text lacks its end, since trimesh reads what is left of it.

    Other errors, and truncated files of other formats, are left to trimesh.

    Returns:
        doubts: warnings, where a file is probably truncated but may be whole.

    Raises:
        ValueError: where the file is truncated for certain.
    """
    check = {".obj": _check_obj, ".off": _check_off, ".ply": _check_ply}.get(path.suffix.lower())
    try:
        return check(path.read_bytes().decode("ascii", "replace")) if check else ()
    except Truncated as error:
        what = f"must be a whole {path.suffix.lower()} file, but it is truncated: {error}"
        raise ValueError(f"{what}; export or copy it again") from None
    except (ValueError, IndexError):
        return ()  # a word where a number should be: the reader says so


def _check_obj(text: str) -> tuple[str, ...]:
    """An .obj has no header: its faces must name vertices that exist, and most vertices should be in a face."""
    lines = re.sub(r"\\\r?\n", " ", text).splitlines()
    vertices, named = 0, {}  # the line that names each vertex
    for number, line in enumerate(lines, start=1):
        kind, *words = line.split("#")[0].split() or [""]
        if kind == "v":
            vertices += 1
        elif kind in ("f", "l", "p"):
            corners = [int(word.split("/")[0]) for word in words]
            named.update({corner if corner >= 0 else vertices + 1 + corner: number for corner in corners})
    for vertex in (max(named, default=0), min(named, default=0)):
        if not 0 <= vertex <= vertices:
            raise Truncated(f"the face in line {named[vertex]} names vertex {vertex}, and there are {vertices}")
    unused = vertices - len(named)
    many = bool(named) and unused > UNUSED * vertices
    without = f"{unused} of {vertices} vertices are in no face"
    if text and not text.endswith(("\n", "\r")):
        last = lines[-1].split()
        if last and last[0] in ("v", "f") and len(last) < 4:
            raise Truncated(f"it ends within line {len(lines)}, '{lines[-1]}'")
        if many:
            raise Truncated(f"it ends within line {len(lines)}, and {without}")
    return (f"warning: {without}: the file may be truncated",) if many else ()


def _check_off(text: str) -> tuple[str, ...]:
    lines = [line for line in (line.split("#")[0] for line in text.splitlines()) if line.strip()]
    counts = lines[0].split()[1:]
    if not counts:  # they may be in the line of the name
        del lines[0]
        counts = lines[0].split()
    _check_rows({"vertices": int(counts[0]), "faces": int(counts[1])}, lines[1:], ["list"])
    return ()


def _check_ply(text: str) -> tuple[str, ...]:
    header, _, body = text.partition("end_header")
    if not header.startswith("ply") or "format ascii" not in header:
        return ()
    counts, properties = {}, []  # those of the last element that has rows
    for line in header.splitlines():
        match line.split():
            case ["element", name, count]:
                counts[{"vertex": "vertices", "face": "faces"}.get(name, name)] = int(count)
                properties = [] if int(count) else properties
            case ["property", of, *_] if list(counts.values())[-1]:
                properties.append(of)
    _check_rows(counts, [line for line in body.splitlines() if line.strip()], properties)
    return ()


def _check_rows(counts: dict[str, int], rows: list[str], properties: list[str]) -> None:
    """Raises Truncated where rows are fewer than a header counts, or the last one lacks some of its properties."""
    wanted = sum(counts.values())
    if rows and len(rows) == wanted:
        words = rows[-1].split()
        in_list = int(words[0]) if properties[0] == "list" else 0
        rows = rows if len(words) >= len(properties) + in_list else rows[:-1]
    if len(rows) < wanted:
        claims = " and ".join(f"{count} {name}" for name, count in counts.items())
        raise Truncated(f"its header claims {claims}, and it holds {len(rows)} of these {wanted} rows")


def read_mesh(path: Path) -> Mesh:
    """All triangles of a file, open or closed, placed by its scene's transforms; `repairs` are doubts about the file.

    Raises:
        ValueError: for a file that is empty, truncated or broken, or holds no surface.
    """
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
