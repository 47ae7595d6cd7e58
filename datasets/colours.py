"""Colours of a mesh file's own surface, by its textures, materials or vertices, on the shapes that are made of it."""

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from datasets.extras import named_files
from datasets.mesh import Mesh, joined
from datasets.meshes import read_mesh
from datasets.readers.glb import GREY
from datasets.scene import Truth
from renderers.checks import BadInput


class Piece(NamedTuple):
    """A part of a file's surface; `values` are colours of its vertices, or their u, v and 0 in an image."""

    mesh: Mesh
    values: Float[np.ndarray, "v 3"]
    image: Any = None
    known: bool = True  # whether the file gives it a colour


class FileColours:
    """A `Texture`: a point has the colour of the nearest point of the file's surface, before that was repaired.

    Args:
        path: of the file.
        rest: its repaired mesh.
        shape: the same faces, moved to where points are.

    Raises:
        ValueError: the file cannot be read, has no colours, or names files that are not there.
    """

    def __init__(self, path: Path, rest: Mesh, shape: Mesh) -> None:
        self._rest, self._shape, self._pieces = rest.vertices, Truth(shape), _pieces(path, path.stat().st_mtime_ns)
        self._own = Truth(joined([piece.mesh for piece in self._pieces]), closed=False)
        self._values = np.concatenate([piece.values for piece in self._pieces])
        self._piece = np.repeat(range(len(self._pieces)), [len(piece.values) for piece in self._pieces])

    @property
    def texels(self) -> int:
        """Pixels of the file's images."""
        images = {id(piece.image): piece.image for piece in self._pieces if piece.image is not None}
        return sum(image.width * image.height for image in images.values())

    def __call__(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> np.ndarray:
        from trimesh.visual.color import uv_to_interpolated_color

        weights, corners = self._shape.nearest(points)
        weights, corners = self._own.nearest(np.einsum("nk,nkd->nd", weights, self._rest[corners]))
        colours, piece = np.einsum("nk,nkd->nd", weights, self._values[corners]), self._piece[corners[:, 0]]
        for number, one in enumerate(self._pieces):
            if one.image is not None:
                here = piece == number
                colours[here] = uv_to_interpolated_color(colours[here, :2], one.image)[:, :3] / 255
        return colours.clip(0, 1)


@lru_cache(maxsize=64)
def _pieces(path: Path, changed: int) -> list[Piece]:
    """The parts of a file, read again when it has changed."""
    import trimesh

    mesh, named, pieces = read_mesh(path), named_files(path), []
    if missing := [file for file in named if not file.is_file()]:
        raise BadInput(f"mesh file '{path}' names '{missing[0].name}', which is not there: put it at '{missing[0]}'")
    if named or path.suffix.lower() == ".glb":
        try:
            parts = trimesh.load_scene(path, process=False).dump()
            pieces = [_piece(part) for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        except Exception as error:  # of trimesh, whatever it does with a file that our readers read
            raise BadInput(f"the materials of mesh file '{path}' cannot be read: {error}") from error
    if any(piece.known for piece in pieces):
        return pieces
    if mesh.colours is None:
        what = "neither a texture nor those of materials or vertices: export it with its materials"
        raise BadInput(f"mesh file '{path}' has no colours, {what}")
    return [Piece(mesh, mesh.colours)]


def _piece(part: Any) -> Piece:
    mesh, visual = Mesh(np.array(part.vertices), np.array(part.faces)), part.visual
    material = getattr(visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if image is not None and visual.uv is not None:
        return Piece(mesh, np.pad(visual.uv, ((0, 0), (0, 1))), image)
    if visual.kind in ("vertex", "face"):
        return Piece(mesh, visual.vertex_colors[:, :3] / 255)
    known = material is not None and getattr(material, "baseColorFactor", material) is not None
    colour = material.main_color[:3] / 255 if known else np.full(3, GREY)
    return Piece(mesh, np.tile(colour, (len(mesh.vertices), 1)), known=known)
