"""Colours of a mesh file, from its textures, materials or vertices, for the shapes that are made from the mesh."""

from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from PIL import Image

from datasets.extras import material_files, referenced_files
from datasets.files.meshes import read_surface
from datasets.files.readers.glb import UNCOLOURED_GREY
from datasets.files.readers.polygons import Material
from datasets.files.readers.text import read_mtl
from datasets.mesh import Mesh
from datasets.scene import Truth
from renderers.checks import BadInput


class Paint(NamedTuple):
    """The triangles of a file, without shared vertices, and the colours and images of their vertices."""

    mesh: Mesh
    colours: Float[np.ndarray, "v 3"]  # multiplied by the colours of the images
    coordinates: Float[np.ndarray, "v 2"]
    image: Int[np.ndarray, " v"]  # -1 without an image
    images: list[Any]


class FileColours:
    """A `Texture`: a point has the colour of the nearest point of the file's unrepaired surface.

    Args:
        rest: its repaired mesh.
        shape: the same faces, in the frame of the points.

    Raises:
        ValueError: the file cannot be read, has no colours, or names missing files.
    """

    def __init__(self, path: Path, rest: Mesh, shape: Mesh) -> None:
        self._rest, self._shape = rest.vertices, Truth(shape, closed=False)
        self._paint = _read_paint(path, path.stat().st_mtime_ns)
        self._file = Truth(self._paint.mesh, closed=False)

    @property
    def texels(self) -> int:
        return sum(image.width * image.height for image in self._paint.images)

    def __call__(self, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> np.ndarray:
        from trimesh.visual.color import uv_to_interpolated_color

        weights, corners = self._shape.nearest(points)
        weights, corners = self._file.nearest(np.einsum("nk,nkd->nd", weights, self._rest[corners]))
        colours, coordinates = (
            np.einsum("nk,nkd->nd", weights, values[corners])
            for values in (self._paint.colours, self._paint.coordinates)
        )
        for index, image in enumerate(self._paint.images):
            painted = self._paint.image[corners[:, 0]] == index
            colours[painted] *= uv_to_interpolated_color(coordinates[painted], image)[:, :3] / 255
        return colours.clip(0, 1)


@lru_cache(maxsize=64)
def _read_paint(path: Path, changed: int) -> Paint:
    """The surface of a file and its colours; `changed`, the time of the last change, is only a key of the cache."""
    mesh, polygons = read_surface(path)
    if missing := [file for file in referenced_files(path) if not file.is_file()]:
        raise BadInput(f"mesh file '{path}' names '{missing[0].name}', which is not there: put it at '{missing[0]}'")
    cuts, polygon = polygons.cuts
    library = {name: material for file in material_files(path) for name, material in read_mtl(file).items()}
    materials = [library.get(material.name, material) for material in polygons.materials]
    materials.append(Material())  # at -1, for polygons without a material
    index = np.full(len(cuts), -1) if polygons.material is None else polygons.material[polygon]
    coordinates = np.full((*cuts.shape, 2), np.nan) if polygons.coordinates is None else polygons.coordinates[cuts]
    images = list(dict.fromkeys(material.image for material in materials if material.image is not None))
    image = np.array([-1 if material.image is None else images.index(material.image) for material in materials])[index]
    image[~np.isfinite(coordinates).all(axis=(1, 2))] = -1
    colours = np.full((*cuts.shape, 3), np.nan) if mesh.colours is None else mesh.colours[mesh.faces]
    flat = np.array([material.colour or (np.nan,) * 3 for material in materials])[index, None]
    colours = np.where(np.isnan(flat), colours, flat)
    if np.isnan(colours).all():
        what = "neither a texture nor those of materials or vertices: export it with its materials"
        raise BadInput(f"mesh file '{path}' has no colours, {what}")
    return Paint(
        Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(cuts.size).reshape(-1, 3)),
        np.where(np.isnan(colours), UNCOLOURED_GREY, colours).reshape(-1, 3),
        coordinates.reshape(-1, 2),
        np.repeat(image, 3),
        [_open_texture(path, image) for image in images],
    )


def _open_texture(path: Path, image: bytes | Path) -> Any:
    try:
        with Image.open(BytesIO(image) if isinstance(image, bytes) else path.parent / image) as stored:
            return stored.convert("RGBA")
    except (OSError, ValueError, SyntaxError) as error:  # PIL raises SyntaxError for a damaged PNG
        name = "inside it" if isinstance(image, bytes) else f"'{image}'"
        raise BadInput(f"image {name} of mesh file '{path}' cannot be read ({error}): save it again as PNG") from None
