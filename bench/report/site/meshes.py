"""Makes a run's mesh small enough for the page: at most so many vertices, positions in 16 bits, as text in a script."""

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

MOST_VERTICES = 12_000
MOST_BYTES = 200_000_000  # of a mesh file that is read
LEVELS = 65_535  # of a position in its bounding box
HEADER = 4096  # bytes within which a header must end
NUMBERS = {"double": "<f8", "float": "<f4", "uchar": "u1", "int": "<i4", "uint": "<u4"}
LONGEST_CELLS = 512  # of the grid by which vertices are merged


@dataclass(frozen=True)
class Surface:
    """Vertices [n, 3], triangles [m, 3] of their numbers, and colours [n, 3] from 0 to 255 or None."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray | None


def mesh_data(path: Path) -> dict[str, Any]:
    """The mesh of a file as the page takes it.

    Raises:
        ValueError, OSError: where it is no binary PLY of triangles, as runs write it; the message says why.
    """
    whole = read_ply(path)
    small = simplified(whole, MOST_VERTICES)
    low, high = small.vertices.min(axis=0), small.vertices.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    positions = ((small.vertices - low) / span * LEVELS).round().astype("<u2")
    data: dict[str, Any] = {
        "low": low.tolist(),
        "high": (low + span).tolist(),
        "vertices": _packed(positions),
        "faces": _packed(small.faces.astype("<u2")),
        "shown": [len(small.vertices), len(small.faces)],
        "whole": [len(whole.vertices), len(whole.faces)],
    }
    return data if small.colours is None else {**data, "colours": _packed(small.colours.astype("u1"))}


def read_ply(path: Path) -> Surface:
    """Reads a binary little-endian PLY with triangles."""
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"mesh.ply has more than {MOST_BYTES // 10**6} MB")
    content = path.read_bytes()
    head, mark, body = content.partition(b"end_header\n")
    lines = head[:HEADER].decode("ascii", "replace").split("\n")
    if not mark or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise ValueError("mesh.ply is not a binary PLY")
    counts, kinds = _header(lines)
    places = np.dtype([(name, NUMBERS[kind]) for name, kind in kinds])
    corners = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    sizes = [counts["vertex"] * places.itemsize, counts["face"] * corners.itemsize]
    if len(body) < sum(sizes) or not counts["vertex"] or not counts["face"]:
        raise ValueError("mesh.ply is shorter than its header says, or empty")
    vertices = np.frombuffer(body, places, counts["vertex"])
    triangles = np.frombuffer(body, corners, counts["face"], sizes[0])
    found = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
    coloured = {"red", "green", "blue"} <= set(places.names or ())
    colours = np.stack([vertices[band] for band in ("red", "green", "blue")], axis=1) if coloured else None
    faces = triangles["corners"].astype(np.int64)
    if (triangles["count"] != 3).any() or faces.min() < 0 or faces.max() >= len(found) or not np.isfinite(found).all():
        raise ValueError("mesh.ply has faces that are no triangles of its vertices, or vertices that are not finite")
    return Surface(found, faces, colours)


def _header(lines: list[str]) -> tuple[dict[str, int], list[tuple[str, str]]]:
    """The numbers of vertices and faces, and the names and types of the vertices' numbers."""
    counts, kinds, element = {"vertex": 0, "face": 0}, [], ""
    for line in lines:
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            element, counts[words[1]] = words[1], int(words[2])
        elif words[:1] == ["property"] and element == "vertex" and len(words) == 3 and words[1] in NUMBERS:
            kinds.append((words[2], words[1]))
    if not {"x", "y", "z"} <= {name for name, _ in kinds} or len({name for name, _ in kinds}) < len(kinds):
        raise ValueError("mesh.ply must have vertices with x, y and z")
    return counts, kinds


def simplified(surface: Surface, most: int) -> Surface:
    """The surface with at most so many vertices: those in one cell of a grid become one, at their mean."""
    if len(surface.vertices) <= most:
        return surface
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    longest = max(float((high - low).max()), 1e-12)
    cells = LONGEST_CELLS
    while True:
        grid = ((surface.vertices - low) / longest * cells).astype(np.int64)
        numbers = (grid[:, 0] * (cells + 1) + grid[:, 1]) * (cells + 1) + grid[:, 2]
        _, members, counts = np.unique(numbers, return_inverse=True, return_counts=True)
        if len(counts) <= most:
            break
        cells = int(cells * min(0.95, (most / len(counts)) ** 0.5))
    faces = members.reshape(-1)[surface.faces]
    flat = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 0] == faces[:, 2])

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(members.reshape(-1), values[:, axis], len(counts)) for axis in range(3)]
        return np.stack(sums, axis=1) / counts[:, None]

    colours = None if surface.colours is None else mean(surface.colours)
    return Surface(mean(surface.vertices), faces[~flat], colours)


def _packed(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
