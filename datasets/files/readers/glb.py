"""Reads triangles and colours of .glb files (binary glTF 2.0), in the rest pose of their scene."""

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

from datasets.files.readers.polygons import WHITE, Material, Polygons, cut_strips
from renderers.checks import BadInput

NUMBER_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TRIANGLES, STRIP, FAN = 4, 5, 6  # modes; smaller modes are points and lines
SUPPORTED_EXTENSIONS = ("KHR_mesh_quantization", "EXT_mesh_gpu_instancing")
SUPPORTED_EXTENSIONS += ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_animation_", "KHR_xmp")
UNCOLOURED_GREY = 0.7  # for primitives without colours in a file with colours
SPECULAR_EXTENSION = "KHR_materials_pbrSpecularGlossiness"  # older files store colours in it


class Primitive(NamedTuple):
    """Triangles of one material, with colours and texture coordinates of their vertices, NaN without any."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    colours: Float[np.ndarray, "v 3"] | None
    coordinates: Float[np.ndarray, "v 2"]
    material: int  # -1 without one


def read_glb(content: bytes) -> Polygons:
    """The triangles of a .glb file's scene, with colours and textures.

    The colour of a vertex is multiplied by its material's colour. Other effects of materials are not read.

    Raises:
        ValueError: the file is damaged, compressed, names other files, or needs an extension that is not supported.
    """
    stored, binary = _chunks(content)
    for name in stored.get("extensionsRequired", ()):
        if not name.startswith(SUPPORTED_EXTENSIONS):
            raise ValueError(f"must be a .glb that is read without '{name}'; export it without that, uncompressed")
    try:
        scene = Scene(stored, binary)
        pieces, materials = list(scene.primitives()), tuple(map(scene.read_material, stored.get("materials", ())))
    except BadInput:
        raise
    except (AttributeError, LookupError, TypeError, ValueError, OverflowError, MemoryError) as error:
        why = f"{type(error).__name__}: {error}"
        raise ValueError(f"must be a whole .glb file, but it is damaged ({why}); export or copy it again") from None
    return _concatenate(pieces, materials)


def _concatenate(pieces: list[Primitive], materials: tuple[Material, ...]) -> Polygons:
    offsets = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    corners = [piece.triangles + offset for piece, offset in zip(pieces, offsets, strict=False)]
    uncoloured, counts = all(piece.colours is None for piece in pieces), [len(piece.triangles) for piece in pieces]
    colours = [
        np.full(piece.vertices.shape, UNCOLOURED_GREY) if piece.colours is None else piece.colours for piece in pieces
    ]
    polygons = Polygons(
        np.concatenate([np.empty((0, 3)), *(piece.vertices for piece in pieces)]),
        np.full(sum(counts), 3),
        np.concatenate([np.empty(0, np.int64), *map(np.ravel, corners)]),
        None if uncoloured else np.concatenate(colours),
        materials=materials,
        material=np.repeat([piece.material for piece in pieces], counts).astype(np.int64),
    )
    coordinates = np.concatenate([np.empty((0, 2)), *(piece.coordinates for piece in pieces)])
    return replace(polygons, coordinates=coordinates[polygons.corners])


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON chunk, decoded, and the bytes of the binary chunk."""
    try:
        magic, version, length, size, kind = struct.unpack_from("<4sIII4s", content)
    except struct.error:
        magic, version, length, size, kind = content[:4], 2, 20, 0, b""
    if magic != b"glTF" or version != 2:
        beginning = f"version {version}" if magic == b"glTF" else f"'{content[:20].decode('ascii', 'replace')}'"
        raise ValueError(f"must begin with 'glTF', version 2, as a .glb does, found {beginning}; export it again")
    if len(content) < length or kind != b"JSON":
        raise ValueError(f"must be a whole .glb file of {length} bytes, found {len(content)}; export or copy it again")
    try:
        return json.loads(content[20 : 20 + size]), content[28 + size :]
    except ValueError as error:
        raise ValueError(f"must have a table of contents, as JSON ({error}); export or copy it again") from None


@dataclass(frozen=True)
class Scene:
    """The JSON chunk of a file and its binary chunk."""

    stored: dict[str, Any]
    binary: bytes

    def primitives(self) -> Iterator[Primitive]:
        """Each primitive of triangles in world coordinates, once per instance."""
        world = self._world_matrices()
        for i, node_matrix in world.items():
            node = self.stored["nodes"][i]
            mesh = self.stored["meshes"][node["mesh"]] if "mesh" in node else {"primitives": ()}
            for primitive in mesh["primitives"]:
                triangles = self._triangles(primitive)
                if triangles is None:
                    continue
                attributes = primitive["attributes"]
                vertices = self._vertices(primitive, node.get("weights") or mesh.get("weights") or ())
                count, material = len(vertices), primitive.get("material", -1)
                paint = self._colours(primitive, count), self._coordinates(primitive, count), material
                skin = [self._skin_matrices(node["skin"], attributes, world)] if "skin" in node else None
                for matrix in skin or self._instance_matrices(node, node_matrix):
                    turn = matrix[..., :3, :3]
                    moved = (turn @ vertices[..., None])[..., 0] + matrix[..., :3, 3]
                    yield Primitive(moved, triangles[:, :: -1 if np.linalg.det(turn).sum() < 0 else 1], *paint)

    def _triangles(self, primitive: dict[str, Any]) -> Int[np.ndarray, "t 3"] | None:
        """The triangles of a primitive; None for points and lines."""
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

    def _vertices(self, primitive: dict[str, Any], weights: Sequence[float]) -> Float[np.ndarray, "v 3"]:
        """The vertices of a primitive, moved by its weighted morph targets."""
        vertices = self._numbers(primitive["attributes"]["POSITION"]).astype(np.float64)
        for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
            if weight and "POSITION" in target:
                vertices = vertices + weight * self._numbers(target["POSITION"])
        return vertices

    def read_material(self, material: dict[str, Any]) -> Material:
        """The image of a material's base colour; without an image, `_colours` applies the colour's factor."""
        texture = _base_colour(material)[1]
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
            content = base64.b64decode(uri.partition(",")[2]) if uri.startswith("data:") else Path(unquote(uri))
        return Material("", WHITE, content)

    def _colours(self, primitive: dict[str, Any], count: int) -> Float[np.ndarray, "v 3"] | None:
        """The colours of its vertices, times its material's factor if the material has no image."""
        factor, texture = _base_colour(self._material(primitive))
        factor = factor[:3] if factor and not texture else None
        if "COLOR_0" not in primitive["attributes"]:
            return None if factor is None else np.tile(np.asarray(factor, np.float64), (count, 1)).clip(0, 1)
        colours = self._numbers(primitive["attributes"]["COLOR_0"], fractions=True)[:, :3] * (factor or WHITE)
        return np.broadcast_to(colours.clip(0, 1), (count, 3))

    def _coordinates(self, primitive: dict[str, Any], count: int) -> Float[np.ndarray, "v 2"]:
        """The texture coordinates of its vertices in the image of its material, v upward."""
        texture = _base_colour(self._material(primitive))[1] or {}
        transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
        name = f"TEXCOORD_{transform.get('texCoord', texture.get('texCoord', 0))}"
        if not texture or name not in primitive["attributes"]:
            return np.full((count, 2), np.nan)
        coordinates = self._numbers(primitive["attributes"][name]) * transform.get("scale", (1, 1))
        turn = transform.get("rotation", 0)  # anticlockwise on the image, whose v points down
        turned = coordinates @ [(np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn))]
        return (turned + transform.get("offset", (0, 0))) * (1, -1) + (0, 1)

    def _material(self, primitive: dict[str, Any]) -> dict[str, Any]:
        return self.stored["materials"][primitive["material"]] if "material" in primitive else {}

    def _skin_matrices(
        self, skin: int, attributes: dict[str, int], world: dict[int, np.ndarray]
    ) -> Float[np.ndarray, "v 4 4"]:
        """The matrix of each vertex of a skin, by its joints; the matrix of its node is not used."""
        skin_entry = self.stored["skins"][skin]
        joints = np.stack([world[joint] for joint in skin_entry["joints"]])
        if "inverseBindMatrices" in skin_entry:
            joints = joints @ self._numbers(skin_entry["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        used = [name.removeprefix("JOINTS") for name in attributes if name.startswith("JOINTS")]
        index = np.concatenate([self._numbers(attributes["JOINTS" + i]) for i in used], axis=1).astype(np.int64)
        weights = np.concatenate([self._numbers(attributes["WEIGHTS" + i], fractions=True) for i in used], axis=1)
        return np.einsum("vj,vjab->vab", weights / weights.sum(axis=1, keepdims=True), joints[index])

    def _instance_matrices(self, node: dict[str, Any], matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n 4 4"]:
        """The matrices of all instances of a node's mesh."""
        instances = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if instances is None:
            return matrix[None]
        return matrix @ _matrix({key.lower(): self._numbers(i) for key, i in instances["attributes"].items()})

    def _world_matrices(self) -> dict[int, Float[np.ndarray, "4 4"]]:
        """The matrix of each node of the scene, by the node's index; of all nodes if the file has no scene."""
        nodes, scenes = self.stored.get("nodes", []), self.stored.get("scenes")
        children = {child for node in nodes for child in node.get("children", ())}
        roots = scenes[self.stored.get("scene", 0)].get("nodes", ()) if scenes else {*range(len(nodes))} - children
        pending, world = [(root, np.eye(4)) for root in roots], {}
        while pending:
            index, parent_matrix = pending.pop(0)
            if index in world:
                raise BadInput(f"must have each node once in its scene, but has node {index} twice; export it again")
            world[index] = parent_matrix @ _matrix(nodes[index])
            pending += [(child, world[index]) for child in nodes[index].get("children", ())]
        return world

    def _numbers(self, accessor: int, fractions: bool = False) -> np.ndarray:
        """The rows of an accessor; integers become fractions if they are normalised or `fractions` is set."""
        entry = self.stored["accessors"][accessor]
        layout = entry["count"], np.dtype(NUMBER_TYPES[entry["componentType"]]), WIDTHS[entry["type"]]
        sparse = entry.get("sparse")
        if "bufferView" in entry:
            rows = self._rows(entry, *layout)
        elif sparse:
            rows = np.zeros((layout[0], layout[2]), layout[1])
        else:
            raise BadInput(f"must hold its numbers, but accessor {accessor} has none {self._extensions}")
        if sparse:
            code = np.dtype(NUMBER_TYPES[sparse["indices"]["componentType"]])
            indices = self._rows(sparse["indices"], sparse["count"], code, 1).ravel()
            rows[indices] = self._rows(sparse["values"], sparse["count"], *layout[1:])
        if layout[1].kind != "f" and (fractions or entry.get("normalized")):
            return np.maximum(rows / np.iinfo(layout[1]).max, -1)
        return rows

    def _rows(self, source: dict[str, Any], count: int, code: np.dtype, width: int) -> np.ndarray:
        view = self.stored["bufferViews"][source["bufferView"]]
        stride = view.get("byteStride") or width * code.itemsize
        start = view.get("byteOffset", 0) + source.get("byteOffset", 0)
        return np.ndarray((count, width), code, self._buffer(view["buffer"]), start, (stride, code.itemsize)).copy()

    def _buffer(self, i: int) -> bytes:
        uri = self.stored["buffers"][i].get("uri", "")
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        if i == 0 and not uri:
            return self.binary
        raise BadInput(f"must hold its numbers, but buffer {i} is elsewhere, '{uri[:40]}' {self._extensions}")

    @property
    def _extensions(self) -> str:
        used = ", ".join(self.stored.get("extensionsUsed", ())) or "none"
        return f"(extensions: {used}); export it as one file, uncompressed"


def _base_colour(material: dict[str, Any]) -> tuple[list[float] | None, dict[str, Any] | None]:
    """The factor and the texture of a material's base colour; None if missing."""
    older = material.get("extensions", {}).get(SPECULAR_EXTENSION, {})
    base = material.get("pbrMetallicRoughness", {})
    factor = older.get("diffuseFactor", base.get("baseColorFactor"))
    return factor, older.get("diffuseTexture", base.get("baseColorTexture"))


def _matrix(node: dict[str, Any]) -> Float[np.ndarray, "*n 4 4"]:
    """The matrix of a node, or of each of its instances."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T
    move, scale = (
        np.asarray(node.get(key, (x,) * 3), dtype=np.float64) for key, x in (("translation", 0), ("scale", 1))
    )
    turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix() * scale[..., None, :]
    matrix = np.zeros((*np.broadcast_shapes(turn.shape[:-2], move.shape[:-1]), 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = turn, move, 1
    return matrix
