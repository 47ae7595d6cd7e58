"""Finds, reads and checks the user's mesh files, and makes them closed solids by `repair`."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from datasets.files.readers.glb import read_glb
from datasets.files.readers.ply import read_ply
from datasets.files.readers.polygons import Polygons
from datasets.files.readers.text import read_obj, read_off, read_stl, wrong_kind_message
from datasets.files.repair import repair
from datasets.mesh import Mesh
from renderers.checks import BadInput

READERS = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl, ".off": read_off, ".glb": read_glb}
SUFFIXES = tuple(READERS)
MIN_AREA_FRACTION = 1e-12  # a mesh with less area, relative to its squared diagonal, is a line or a point


def find_meshes(path: str | Path) -> list[Path]:
    """Lists the mesh files at `path`: the file itself, or those directly in the folder, sorted by name.

    Raises:
        ValueError: `path` does not exist, its folder has no meshes, or its suffix is unknown.
    """
    path, suffixes = Path(path), " ".join(SUFFIXES)
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file()]
        meshes = sorted(file for file in files if not file.name.startswith("._"))  # macOS metadata files
        if not meshes:
            raise ValueError(
                f"a folder must hold mesh files ({suffixes}), found none directly in '{path}'; "
                "name the folder that has them, or one file"
            )
        return meshes
    if not path.exists():
        siblings = [file.name for file in path.parent.iterdir()] if path.parent.is_dir() else []
        close = difflib.get_close_matches(path.name, siblings, n=1)
        remedy = f"did you mean '{path.parent / close[0]}'?" if close else "check the spelling and the current folder"
        raise ValueError(f"a mesh file or a folder of them is asked for, found nothing at '{path}'; {remedy}")
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"a mesh file must end in one of {suffixes}, found '{path.name}'; export it in one of these formats"
        )
    return [path]


def load_mesh(path: str | Path, close: Callable[[Mesh], Mesh | None] | None = None) -> Mesh:
    """Reads one file as a closed solid, wound outward; its `repairs` list the changes.

    Vertices at the same position are merged, so that texture seams close. A mesh that is already closed keeps its
    surface. Otherwise its holes are closed and overlapping parts merged; if that gives no solid, it is wrapped: a
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
    """All triangles of a file with their colours, open or closed and not repaired, with its scene's transforms applied.

    Raises:
        ValueError: the file is missing, empty, truncated or broken, or holds no surface.
    """
    return read_surface(path)[0]


def read_surface(path: str | Path) -> tuple[Mesh, Polygons]:
    """A mesh as `read_mesh` reads it, and the polygons that were cut into its faces."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"must be one mesh file, found the folder '{path}'; list it with find_meshes")
    (path,) = find_meshes(path)
    try:
        return _read(path)
    except ValueError as error:
        raise BadInput(f"mesh file '{path}': {error}") from None


def read_pieces(path: str | Path) -> Mesh:
    """The mesh of a file, or of all files of a folder, such as BlendedMVS's `textured_mesh`; see `read_mesh`."""
    return concatenate_meshes([read_mesh(file) for file in find_meshes(path)])


def concatenate_meshes(meshes: Sequence[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, offsets, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def read_points(path: str | Path) -> Float[np.ndarray, "n 3"] | None:
    """The points of a file without faces or of the `pointcloud.npz` of DVR's data; None if the file has faces.

    Raises:
        ValueError: the file is missing, empty, truncated or broken, or its points are missing or not finite.
    """
    (path,) = [Path(path)] if Path(path).suffix == ".npz" else find_meshes(path)
    try:
        if path.suffix == ".npz":
            points = _stored_points(path)
        else:
            polygons = _polygons(path)
            points = polygons.vertices
            if len(polygons.counts):
                return None
        bad_count = int((~np.isfinite(points)).any(axis=1).sum())
        if not len(points) or bad_count:
            fault = f"{bad_count} of {len(points)} are not" if bad_count else "found 0"
            remedy = "remove those without a return" if bad_count < len(points) else "export or copy it again"
            raise ValueError(f"must hold points that are finite, {fault}; {remedy}")
    except ValueError as error:
        raise BadInput(f"file of points '{path}': {error}") from None
    return points


def _stored_points(path: Path) -> Float[np.ndarray, "n 3"]:
    try:
        with path.open("rb") as file, np.load(file) as stored:
            if "points" in stored and "occupancies" not in stored:
                return stored["points"].reshape(-1, 3).astype(np.float64)
            fault = f"found {', '.join(stored)}"
    except (OSError, EOFError, TypeError, ValueError, BadZipFile) as error:
        fault = f"but it cannot be read ({error})"
    raise ValueError(f"must have `points` on the surface, {fault}; take `pointcloud.npz` beside it, or copy it again")


def _polygons(path: Path) -> Polygons:
    content = path.read_bytes()
    if not content:
        raise ValueError("must hold a mesh, found 0 bytes; export or copy it again")
    if fault := wrong_kind_message(path):
        raise ValueError(fault)
    with np.errstate(all="ignore"):  # bad numbers are refused later
        return READERS[path.suffix.lower()](content)


def _read(path: Path) -> tuple[Mesh, Polygons]:
    polygons, suffix = _polygons(path), path.suffix.lower()
    with np.errstate(all="ignore"):  # Mesh refuses bad numbers
        triangles = polygons.triangles
    if not len(triangles):
        count = len(polygons.vertices)
        rest = f"{count} vertices, as points or lines" if count else f"at most points or lines, as {suffix} writes them"
        remedy = "reconstruct a surface from them (Poisson), or export it as one" if count else "export it as a surface"
        raise ValueError(f"must have faces, found none: it holds {rest}; {remedy}")
    mesh = Mesh(polygons.vertices, triangles, colours=polygons.shaded)
    if mesh.area <= MIN_AREA_FRACTION * mesh.diagonal**2:
        raise ValueError(
            f"must have an area, found {mesh.area:.3g} in a box {mesh.diagonal:.3g} across; "
            "look for a stray vertex, or export it again"
        )
    return mesh, polygons
