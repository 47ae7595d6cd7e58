"""Simplifies a run's mesh for the page, and encodes it for Plotly."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

MAX_SHOWN_VERTICES = 12_000
MAX_MESH_FILE_BYTES = 200_000_000
READ_ERRORS = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)


def mesh_data(path: Path) -> dict[str, Any]:
    """The mesh of a PLY file as arrays of Plotly's mesh3d, z up; raises ValueError or OSError for other files."""
    mesh = read_ply(path)
    small = simplify(mesh, MAX_SHOWN_VERTICES)
    x, y, z = small.vertices.T
    data = {name: _packed(values, "f4") for name, values in {"x": x, "y": -z, "z": y}.items()}
    data |= {name: _packed(corners, "u2") for name, corners in zip("ijk", small.faces.T, strict=True)}
    data |= {"shown": [len(x), len(small.faces)], "whole": [len(mesh.vertices), len(mesh.faces)]}
    if small.visual.kind == "vertex":
        data["vertexcolor"] = [f"#{colour[:3].tobytes().hex()}" for colour in small.visual.vertex_colors]
    return data


def read_ply(path: Path) -> trimesh.Trimesh:
    """Reads a PLY file without the files that it names. Checks that its faces and vertices are valid."""
    if path.stat().st_size > MAX_MESH_FILE_BYTES:
        raise ValueError(f"mesh.ply has more than {MAX_MESH_FILE_BYTES // 10**6} MB")
    content = io.BytesIO(path.read_bytes())
    try:
        mesh = trimesh.load_mesh(content, file_type="ply", process=False, skip_materials=True)
        faces, vertices = mesh.faces, mesh.vertices
    except READ_ERRORS as error:  # trimesh has no exception of its own
        raise ValueError(f"mesh.ply could not be read ({' '.join(str(error).split())[:120]})") from None
    if not faces.size or faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise ValueError("mesh.ply has no triangles, or triangles not of its vertices, or vertices that are not finite")
    return mesh


def simplify(mesh: trimesh.Trimesh, max_vertices: int) -> trimesh.Trimesh:
    """Returns the mesh with at most `max_vertices`: vertices in one cell of a grid are merged at their mean."""
    if len(mesh.vertices) <= max_vertices:
        return mesh
    from open3d import geometry, utility  # imported here, as it takes seconds

    has_colours = mesh.visual.kind == "vertex"
    full = geometry.TriangleMesh(utility.Vector3dVector(mesh.vertices), utility.Vector3iVector(mesh.faces))
    if has_colours:
        full.vertex_colors = utility.Vector3dVector(mesh.visual.vertex_colors[:, :3] / 255)
    simple, cell = full, 1e-3 * mesh.scale
    while len(simple.vertices) > max_vertices:
        cell *= max(1.1, (len(simple.vertices) / max_vertices) ** 0.5)
        simple = full.simplify_vertex_clustering(cell)
    colours = (255 * np.asarray(simple.vertex_colors)).round().astype("u1") if has_colours else None
    return trimesh.Trimesh(
        np.asarray(simple.vertices), np.asarray(simple.triangles), vertex_colors=colours, process=False
    )


def _packed(array: np.ndarray, kind: str) -> dict[str, str]:
    """In Plotly's base64 form."""
    return {"dtype": kind, "bdata": base64.b64encode(array.astype(f"<{kind}").tobytes()).decode("ascii")}
