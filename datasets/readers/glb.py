"""Reads triangles and colours of .glb files (binary glTF 2.0), placed as their scene has them at rest."""

import base64
import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from datasets.readers.polygons import WHITE, Material, Polygons, cut_strips
from renderers.checks import BadInput

CODES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes; those below are points and lines
READ = ("KHR_mesh_quantization", "EXT_mesh_gpu_instancing")
READ += ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_animation_", "KHR_xmp")  # not of shape
GREY = 0.7  # of parts without colours, beside parts that have some
SPECULAR = "KHR_materials_pbrSpecularGlossiness"  # where older files have the colour


class Primitive(NamedTuple):
    """Triangles of one material, with the colours of their vertices, and texture coordinates, NaN without any."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    colours: Float[np.ndarray, "v 3"] | None
    coordinates: Float[np.ndarray, "v 2"]
    material: int  # -1 without one


def read_glb(content: bytes) -> Polygons:
    """The triangles of a .glb file's scene, with colours and textures.

    A vertex has the product of its colour and its material's. Other effects of materials are not read.

    Raises:
        ValueError: where it is damaged, compressed, names other files, or needs an extension that is not read.
    """
    stored, binary = _chunks(content)
    for name in stored.get("extensionsRequired", ()):
        if not name.startswith(READ):
            raise ValueError(f"must be a .glb that is read without '{name}'; export it without that, uncompressed")
    try:
        scene = Scene(stored, binary)
        parts, materials = list(scene.parts()), tuple(map(scene.painted, stored.get("materials", ())))
    except BadInput:
        raise
    except (AttributeError, LookupError, TypeError, ValueError, OverflowError, MemoryError) as error:
        why = f"{type(error).__name__}: {error}"
        raise ValueError(f"must be a whole .glb file, but it is damaged ({why}); export or copy it again") from None
    return _joined(parts, materials)


def _joined(parts: list[Primitive], materials: tuple[Material, ...]) -> Polygons:
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    corners = [part.triangles + offset for part, offset in zip(parts, offsets, strict=False)]
    bare = all(part.colours is None for part in parts)
    shades = [np.full(part.vertices.shape, GREY) if part.colours is None else part.colours for part in parts]
    polygons = Polygons(
        np.concatenate([np.empty((0, 3)), *(part.vertices for part in parts)]),
        np.full(sum(map(len, corners)), 3),
        np.concatenate([np.empty(0, np.int64), *map(np.ravel, corners)]),
        None if bare else np.concatenate(shades),
        materials=materials,
        material=np.repeat([part.material for part in parts], [len(part.triangles) for part in parts]).astype(np.int64),
    )
    coordinates = np.concatenate([np.empty((0, 2)), *(part.coordinates for part in parts)])
    return replace(polygons, coordinates=coordinates[polygons.corners])


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The table of contents and the numbers, as bytes."""
    try:
        magic, version, length, size, kind = struct.unpack_from("<4sIII4s", content)
    except struct.error:
        magic, version, length, size, kind = content[:4], 2, 20, 0, b""
    if magic != b"glTF" or version != 2:
        found = f"version {version}" if magic == b"glTF" else f"'{content[:20].decode('ascii', 'replace')}'"
        raise ValueError(f"must begin with 'glTF', version 2, as a .glb does, found {found}; export it again")
    if len(content) < length or kind != b"JSON":
        raise ValueError(f"must be a whole .glb file of {length} bytes, found {len(content)}; export or copy it again")
    try:
        return json.loads(content[20 : 20 + size]), content[28 + size :]
    except ValueError as error:
        raise ValueError(f"must have a table of contents, as JSON ({error}); export or copy it again") from None


@dataclass(frozen=True)
class Scene:
    """The table of contents of a file and its chunk of numbers."""

    stored: dict[str, Any]
    binary: bytes

    def parts(self) -> Iterator[Primitive]:
        """Each primitive of triangles, in the scene, as often as it is there."""
        world = self._placed()
        for i, matrix in world.items():
            node = self.stored["nodes"][i]
            mesh = self.stored["meshes"][node["mesh"]] if "mesh" in node else {"primitives": ()}
            for primitive in mesh["primitives"]:
                triangles = self._triangles(primitive)
                if triangles is None:
                    continue
                attributes = primitive["attributes"]
                vertices = self._shape(primitive, node.get("weights") or mesh.get("weights") or ())
                count, material = len(vertices), primitive.get("material", -1)
                paint = self._colours(primitive, count), self._coordinates(primitive, count), material
                skin = "skin" in node
                for place in [self._bent(node["skin"], attributes, world)] if skin else self._copies(node, matrix):
                    turn = place[..., :3, :3]
                    moved = (turn @ vertices[..., None])[..., 0] + place[..., :3, 3]
                    yield Primitive(moved, triangles[:, :: -1 if np.linalg.det(turn).sum() < 0 else 1], *paint)

    def _triangles(self, primitive: dict[str, Any]) -> Int[np.ndarray, "t 3"] | None:
        """None for points and lines."""
        mode = primitive.get("mode", TRIANGLES)
        if mode < TRIANGLES:
            return None
        if "indices" in primitive:
            corners = self._numbers(primitive["indices"]).ravel().astype(np.int64)
        else:
            corners = np.arange(self.stored["accessors"][primitive["attributes"]["POSITION"]]["count"])
        if mode == STRIP:
            return cut_strips(corners, np.array([len(corners)]))
        if mode == FAN:
            return np.stack([np.full(max(len(corners) - 2, 0), corners[:1]), corners[1:-1], corners[2:]], axis=1)
        return corners.reshape(-1, 3)

    def _shape(self, primitive: dict[str, Any], weights: Sequence[float]) -> Float[np.ndarray, "v 3"]:
        """Positions, with the morph targets that are not at zero."""
        vertices = self._numbers(primitive["attributes"]["POSITION"]).astype(np.float64)
        for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
            if weight and "POSITION" in target:
                vertices = vertices + weight * self._numbers(target["POSITION"])
        return vertices

    def painted(self, material: dict[str, Any]) -> Material:
        """A material's image of its base colour; without one its factor is in the colours of the vertices."""
        texture = _base(material)[1]
        if texture is None:
            return Material()
        texture = self.stored["textures"][texture["index"]]
        sources = [texture, *texture.get("extensions", {}).values()]  # such as a WebP image
        number = next((entry["source"] for entry in sources if "source" in entry), None)
        if number is None:
            return Material()
        image = self.stored["images"][number]
        if "bufferView" in image:
            view = self.stored["bufferViews"][image["bufferView"]]
            content = self._rows(image, view["byteLength"], np.dtype("u1"), 1).tobytes()
        else:
            uri = image["uri"]
            content = _inline(uri) if uri.startswith("data:") else Path(unquote(uri))
        return Material("", WHITE, content)

    def _colours(self, primitive: dict[str, Any], count: int) -> Float[np.ndarray, "v 3"] | None:
        """The colours of its vertices times its material's factor, unless that has an image too."""
        factor, texture = _base(self._material(primitive))
        factor = factor[:3] if factor and not texture else None
        if "COLOR_0" not in primitive["attributes"]:
            return None if factor is None else np.tile(np.asarray(factor, np.float64), (count, 1)).clip(0, 1)
        colours = self._numbers(primitive["attributes"]["COLOR_0"], shares=True)[:, :3] * (factor or WHITE)
        return np.broadcast_to(colours.clip(0, 1), (count, 3))

    def _coordinates(self, primitive: dict[str, Any], count: int) -> Float[np.ndarray, "v 2"]:
        """The texture coordinates of its vertices, v upward, in the image of its material."""
        texture = _base(self._material(primitive))[1] or {}
        transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
        name = f"TEXCOORD_{transform.get('texCoord', texture.get('texCoord', 0))}"
        if not texture or name not in primitive["attributes"]:
            return np.full((count, 2), np.nan)
        coordinates = self._numbers(primitive["attributes"][name]) * transform.get("scale", (1, 1))
        turn = transform.get("rotation", 0)  # anticlockwise as one sees it, where v points down
        turned = coordinates @ [(np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn))]
        return (turned + transform.get("offset", (0, 0))) * (1, -1) + (0, 1)

    def _material(self, primitive: dict[str, Any]) -> dict[str, Any]:
        return self.stored["materials"][primitive["material"]] if "material" in primitive else {}

    def _bent(self, skin: int, attributes: dict[str, int], world: dict[int, np.ndarray]) -> Float[np.ndarray, "v 4 4"]:
        """The matrix of each vertex of a skin, by its joints; its own node's is not used."""
        given = self.stored["skins"][skin]
        joints = np.stack([world[joint] for joint in given["joints"]])
        if "inverseBindMatrices" in given:
            joints = joints @ self._numbers(given["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        used = [name.removeprefix("JOINTS") for name in attributes if name.startswith("JOINTS")]
        index = np.concatenate([self._numbers(attributes["JOINTS" + i]) for i in used], axis=1).astype(np.int64)
        weights = np.concatenate([self._numbers(attributes["WEIGHTS" + i], shares=True) for i in used], axis=1)
        return np.einsum("vj,vjab->vab", weights / weights.sum(axis=1, keepdims=True), joints[index])

    def _copies(self, node: dict[str, Any], matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """Where a node's mesh is, once or more often."""
        instances = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if instances is None:
            return matrix[None]
        return matrix @ _matrix({key.lower(): self._numbers(i) for key, i in instances["attributes"].items()})

    def _placed(self) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The nodes of the scene and their matrices; of all nodes, where the file has no scene."""
        nodes, scenes = self.stored.get("nodes", []), self.stored.get("scenes")
        below = {child for node in nodes for child in node.get("children", ())}
        roots = scenes[self.stored.get("scene", 0)].get("nodes", ()) if scenes else {*range(len(nodes))} - below
        todo, world = [(root, np.eye(4)) for root in roots], {}
        while todo:
            i, above = todo.pop(0)
            if i in world:
                raise BadInput(f"must have each node once in its scene, but has node {i} twice; export it again")
            world[i] = above @ _matrix(nodes[i])
            todo += [(child, world[i]) for child in nodes[i].get("children", ())]
        return world

    def _numbers(self, accessor: int, shares: bool = False) -> np.ndarray:
        """The rows of an accessor; integers that are normalised, or are `shares` of 1, as fractions."""
        given = self.stored["accessors"][accessor]
        layout = given["count"], np.dtype(CODES[given["componentType"]]), WIDTHS[given["type"]]
        sparse = given.get("sparse")
        if "bufferView" in given:
            rows = self._rows(given, *layout)
        elif sparse:
            rows = np.zeros((layout[0], layout[2]), layout[1])
        else:
            raise BadInput(f"must hold its numbers, but accessor {accessor} has none {self._extensions}")
        if sparse:
            code = np.dtype(CODES[sparse["indices"]["componentType"]])
            places = self._rows(sparse["indices"], sparse["count"], code, 1).ravel()
            rows[places] = self._rows(sparse["values"], sparse["count"], *layout[1:])
        if layout[1].kind != "f" and (shares or given.get("normalized")):
            return np.maximum(rows / np.iinfo(layout[1]).max, -1)
        return rows

    def _rows(self, place: dict[str, Any], count: int, code: np.dtype, width: int) -> np.ndarray:
        view = self.stored["bufferViews"][place["bufferView"]]
        stride = view.get("byteStride") or width * code.itemsize
        start = view.get("byteOffset", 0) + place.get("byteOffset", 0)
        return np.ndarray((count, width), code, self._buffer(view["buffer"]), start, (stride, code.itemsize)).copy()

    def _buffer(self, i: int) -> bytes:
        uri = self.stored["buffers"][i].get("uri", "")
        if uri.startswith("data:"):
            return _inline(uri)
        if i == 0 and not uri:
            return self.binary
        raise BadInput(f"must hold its numbers, but buffer {i} is elsewhere, '{uri[:40]}' {self._extensions}")

    @property
    def _extensions(self) -> str:
        used = ", ".join(self.stored.get("extensionsUsed", ())) or "none"
        return f"(extensions: {used}); export it as one file, uncompressed"


def _base(material: dict[str, Any]) -> tuple[list[float] | None, dict[str, Any] | None]:
    """The factor and the texture of a material's base colour, where it has them."""
    older = material.get("extensions", {}).get(SPECULAR, {})
    base = material.get("pbrMetallicRoughness", {})
    factor = older.get("diffuseFactor", base.get("baseColorFactor"))
    return factor, older.get("diffuseTexture", base.get("baseColorTexture"))


def _inline(uri: str) -> bytes:
    return base64.b64decode(uri.partition(",")[2])


def _matrix(given: dict[str, Any]) -> Float[np.ndarray, "*n 4 4"]:
    """The matrix of a node, or of each of its instances."""
    if "matrix" in given:
        return np.reshape(given["matrix"], (4, 4)).T
    move, scale = (
        np.asarray(given.get(key, (x,) * 3), dtype=np.float64) for key, x in (("translation", 0), ("scale", 1))
    )
    turn = Rotation.from_quat(given.get("rotation", (0, 0, 0, 1))).as_matrix() * scale[..., None, :]
    matrix = np.zeros((*np.broadcast_shapes(turn.shape[:-2], move.shape[:-1]), 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = turn, move, 1
    return matrix
