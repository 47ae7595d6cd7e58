"""What a .glb file may hold: numbers in every coding, placed in every way. Each file has one tetrahedron, or two."""

import base64
import io
import json
import struct

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from datasets.files.colours import FileColours
from datasets.files.meshes import read_mesh
from datasets.files.readers.glb import UNCOLOURED_GREY, read_glb
from tests.looped import each

VERTICES = np.array([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], np.float32)
FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], np.uint16)
CORNERS = FACES.ravel()
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


def glb(vertices=VERTICES, corners=CORNERS, *others, nodes=({"mesh": 0},), parts=({},), **more) -> bytes:
    """A file whose accessors are the arrays, each alone or with keys that it also has, and whose mesh has the parts.

    Of an array's keys, `sparse` is a pair of indices and values, `empty` leaves it out, and `stride` is in bytes, in
    each row of which the array begins at `byteOffset`.
    """
    views, accessors, binary = [], [], bytearray()

    def view(array: np.ndarray, **keys) -> int:
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes, **keys})
        binary.extend(array.tobytes() + b"\0" * (-array.nbytes % 4))
        return len(views) - 1

    for entry in (vertices, corners, *others):
        array, keys = entry if isinstance(entry, tuple) else (entry, {})
        accessor = {"componentType": CODES[array.dtype.str[1:]], "count": len(array), "type": TYPES[array.shape[1:]]}
        if "sparse" in keys:
            index, values = keys["sparse"]
            indices = {"bufferView": view(index), "componentType": CODES[index.dtype.str[1:]]}
            accessor["sparse"] = {"count": len(index), "indices": indices, "values": {"bufferView": view(values)}}
        if "stride" in keys:
            padded = np.zeros((len(array), keys["stride"]), np.uint8)
            start = keys.get("byteOffset", 0)
            padded[:, start : start + array[0].nbytes] = array.view(np.uint8)
            accessor["bufferView"] = view(padded, byteStride=keys["stride"])
        elif "empty" not in keys:
            accessor["bufferView"] = view(array)
        accessors.append(accessor | {key: keys[key] for key in ("normalized", "count", "byteOffset") if key in keys})
    primitives = [{"attributes": {"POSITION": 0}, "indices": 1} | primitive for primitive in parts]
    stored = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes}
    stored |= {"meshes": [{"primitives": primitives}], "accessors": accessors, "bufferViews": views}
    stored |= {"buffers": [{"byteLength": len(binary)}], **more}
    return packed(stored, bytes(binary))


def packed(stored: dict, binary: bytes) -> bytes:
    """A file of a table of contents and the numbers."""
    text = json.dumps(stored).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


SHARE = {"normalized": True}
LARGE = (VERTICES * 32767 / 3).round().astype(np.int16)
SMALL = ((VERTICES - 3) * 127 / 3).round().astype(np.int8)
FLAT = np.float32([1, 1, 0]) * VERTICES
TURN = Rotation.from_euler("xyz", (30, 40, 50), degrees=True)
MOVED = {"translation": [5, 6, 7], "rotation": TURN.as_quat().tolist(), "scale": [2, 3, 0.5]}
MATRIX = np.eye(4)
MATRIX[:3] = np.c_[TURN.as_matrix() * [2, 3, 0.5], [5, 6, 7]]
MOVED_VERTICES = VERTICES @ MATRIX[:3, :3].T + MATRIX[:3, 3]
PARENT = [{"children": [1], **MOVED}, {"mesh": 0}]
TARGET = ({"targets": [{"POSITION": 2}]},)
INSTANCES = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 2, "ROTATION": 3}}}
SHIFTED = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 2}}}
OFFSETS = np.float32([(0, 0, 0), (9, 0, 0)]), np.array([(0, 0, 0, 1), TURN.as_quat()], np.float32)
BIND = np.stack([np.eye(4), np.eye(4)]).astype(np.float32)
BIND[1, 3, :3] = -1, 0, 0  # a column
BONES = np.array([(0, 1, 0, 0)] * 4, np.uint8), (np.array([(127, 128, 0, 0)] * 4, np.uint8), SHARE), BIND
SKINNED = [{"mesh": 0, "skin": 0, "translation": [50, 0, 0]}, {"translation": [0, 0, 4]}, {"translation": [3, 0, 4]}]
SKIN = {"skins": [{"joints": [1, 2], "inverseBindMatrices": 4}], "scenes": [{"nodes": [0, 1, 2]}]}
EXTRA = {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3, "JOINTS_1": 5, "WEIGHTS_1": 6}
HALF = np.float32([(0.5, 0, 0, 0)] * 4)
BENT = np.array([2 * 128 / 255, 0, 4])  # one joint moves by (0, 0, 4), the other by (2, 0, 4)

READ = {  # a file, and the vertices of its tetrahedra
    "no indices": (glb(VERTICES[CORNERS], meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}]), VERTICES),
    "plain": (glb(), VERTICES),
    "bytes as indices": (glb(VERTICES, FACES.astype(np.uint8).ravel()), VERTICES),
    "bytes as positions": (glb(VERTICES.astype(np.uint8), extensionsRequired=["KHR_mesh_quantization"]), VERTICES),
    "normalised": (glb((LARGE, SHARE)), LARGE / 32767),
    "normalised bytes below zero": (glb((SMALL, SHARE | {"stride": 4})), SMALL / 127),
    "with strides": (glb((VERTICES, {"stride": 32})), VERTICES),
    "interleaved with others": (glb((VERTICES, {"stride": 28, "byteOffset": 12})), VERTICES),
    "normalised bytes below -1": (glb((np.where(SMALL == -127, -128, SMALL).astype(np.int8), SHARE)), SMALL / 127),
    "sparse": (glb((FLAT, {"sparse": (np.array([3], np.uint8), VERTICES[3:])})), VERTICES),
    "sparse over zeros": (
        glb((VERTICES, {"empty": True, "sparse": (np.arange(1, 4, dtype=np.uint16), VERTICES[1:])})), VERTICES),
    "strip": (glb(VERTICES, np.array([0, 2, 1, 3, 0, 2], np.uint16), parts=({"mode": 5},)), VERTICES),
    "fan, and its base": (
        glb(VERTICES, np.array([0, 1, 3, 2, 1], np.uint16), FACES[2], parts=({"mode": 6}, {"indices": 2})), VERTICES),
    "lines and points beside": (glb(parts=({"mode": 0}, {"mode": 1}, {"mode": 3}, {})), VERTICES),
    "moved by parts": (glb(nodes=[{"mesh": 0, **MOVED}]), MOVED_VERTICES),
    "moved by a matrix": (glb(nodes=[{"mesh": 0, "matrix": MATRIX.T.ravel().tolist()}]), MOVED_VERTICES),
    "moved by its parent": (glb(nodes=PARENT), MOVED_VERTICES),
    "mirrored": (glb(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}]), VERTICES * [-1, 1, 1]),
    "twice": (glb(nodes=[{"mesh": 0, **MOVED}, {"mesh": 0}], scenes=[{"nodes": [0, 1]}]), MOVED_VERTICES, VERTICES),
    "instances": (
        glb(VERTICES, CORNERS, *OFFSETS, nodes=[{"mesh": 0, "extensions": INSTANCES}], extensionsRequired=[*INSTANCES]),
        VERTICES, TURN.apply(VERTICES) + OFFSETS[0][1]),
    "instances without a turn": (
        glb(VERTICES, CORNERS, OFFSETS[0], nodes=[{"mesh": 0, "extensions": SHIFTED}]),
        *(VERTICES + offset for offset in OFFSETS[0]),
    ),
    "a morph target": (
        glb(VERTICES, CORNERS, VERTICES, nodes=[{"mesh": 0, "weights": [0.5]}], parts=TARGET), 1.5 * VERTICES),
    "a morph target at zero": (glb(VERTICES, CORNERS, VERTICES, parts=TARGET), VERTICES),
    "a morph target by the node before the mesh": (
        glb(
            *(VERTICES, CORNERS, VERTICES),
            nodes=[{"mesh": 0, "weights": [0.5]}],
            meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, **TARGET[0]}], "weights": [1.0]}],
        ),
        1.5 * VERTICES,
    ),
    "a skin with weights of any sum": (
        glb(
            *(VERTICES, CORNERS, BONES[0], 4 * np.float32([(127, 128, 0, 0)] * 4), BIND),
            nodes=SKINNED,
            parts=({"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}},),
            **SKIN,
        ),
        VERTICES + BENT,
    ),
    "a skin with more than four joints": (
        glb(
            *(VERTICES, CORNERS, np.zeros((4, 4), np.uint8), HALF, BIND, np.ones((4, 4), np.uint8), HALF),
            nodes=SKINNED,
            parts=({"attributes": EXTRA},),
            **SKIN,
        ),
        VERTICES + np.array([1, 0, 4]),
    ),
    "a skin": (
        glb(
            *(VERTICES, CORNERS, *BONES),
            nodes=SKINNED,
            parts=({"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}},),
            **SKIN,
        ),
        VERTICES + BENT,
    ),
    "another scene beside": (glb(nodes=PARENT, scene=1, scenes=[{"nodes": [0]}, {"nodes": [1]}]), VERTICES),
    "no scene": (glb(nodes=PARENT, scenes=[]), MOVED_VERTICES),
}  # fmt: skip


def ordered(triangles: np.ndarray) -> np.ndarray:
    """Each triangle from its least corner on, in the order of their numbers."""
    least = triangles.sum(axis=2).round(4).argmin(axis=1)
    turned = np.take_along_axis(triangles, ((least[:, None] + np.arange(3)) % 3)[..., None], axis=1)
    return turned[np.lexsort(turned.reshape(-1, 9).round(4).T)]


@each("name", [*READ])
def test_each_triangle_is_where_it_is_shown_and_winds_outward(name):
    content, *solids = READ[name]
    read = read_glb(content)
    inward = [np.linalg.det(solid[1:] - solid[0]) < 0 for solid in solids]
    expected = [solid[FACES[:, ::-1] if turned else FACES] for solid, turned in zip(solids, inward, strict=True)]
    assert ordered(read.vertices[read.triangles]) == pytest.approx(ordered(np.concatenate(expected)), abs=1e-5)


COLOURS = np.float32([(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.5, 0.25, 1)])


def coloured(content: bytes) -> bytes:
    """The file with four colours, of the vertices of each tetrahedron."""
    (size,) = struct.unpack_from("<I", content, 12)
    stored, binary = json.loads(content[20 : 20 + size]), content[28 + size :]
    uri = "data:;base64," + base64.b64encode(COLOURS.tobytes()).decode()
    buffers = [*stored["buffers"], {"byteLength": COLOURS.nbytes, "uri": uri}]
    views = [*stored["bufferViews"], {"buffer": 1, "byteLength": COLOURS.nbytes}]
    accessor = {"componentType": 5126, "count": 4, "type": "VEC3", "bufferView": len(views) - 1}
    for primitive in stored["meshes"][0]["primitives"]:
        primitive["attributes"]["COLOR_0"] = len(stored["accessors"])
    stored |= {"buffers": buffers, "bufferViews": views, "accessors": [*stored["accessors"], accessor]}
    return packed(stored, binary)


@each("name", [name for name in READ if name != "no indices"])
def test_each_vertex_has_its_colour_where_it_is_shown(tmp_path, name):
    path = tmp_path / f"{name}.glb"
    path.write_bytes(coloured(READ[name][0]))
    mesh = read_mesh(path)
    assert mesh.colours is not None and np.array_equal(mesh.colours[:4], COLOURS)
    seen = FileColours(path, mesh, mesh)(mesh.vertices, mesh.vertices)
    assert seen == pytest.approx(mesh.colours, abs=1e-5)


def test_a_texture_is_laid_on_as_its_coordinates_are_stored_and_transformed(tmp_path):
    ramp, picture = np.arange(256, dtype=np.uint8), io.BytesIO()
    across, down = np.meshgrid(ramp, ramp)
    Image.fromarray(np.stack([across, down, 0 * down], axis=2)).save(picture, "png")
    stored = np.array([(0, 0), (0.5, 0), (0, 0.5), (0.5, 0.75)])
    transform = {"scale": [0.8, 0.4], "rotation": np.pi / 6, "offset": [0.1, 0.35]}
    texture = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    path = tmp_path / "textured.glb"
    path.write_bytes(
        glb(
            (LARGE, SHARE),
            CORNERS,
            ((stored * 65535).round().astype(np.uint16), SHARE),
            parts=({"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "material": 0},),
            materials=[{"pbrMetallicRoughness": {"baseColorTexture": texture}}],
            textures=[{"source": 0}],
            images=[{"uri": "data:image/png;base64," + base64.b64encode(picture.getvalue()).decode()}],
        )
    )
    mesh = read_mesh(path)
    turned = ((stored * transform["scale"]) @ (1, -1j)) * np.exp(1j * transform["rotation"])  # v points down
    expected = np.stack([turned.real + 0.1, 0.35 - turned.imag, np.zeros(4)], axis=1)
    seen = FileColours(path, mesh, mesh)(mesh.vertices, mesh.vertices)
    assert seen == pytest.approx(expected, abs=0.005)


def test_the_colour_of_a_material_multiplies_those_of_vertices(tmp_path):
    path, factor = tmp_path / "factor.glb", [0.5, 1.0, 0.25, 1.0]
    red = {"parts": ({"material": 0},), "materials": [{"pbrMetallicRoughness": {"baseColorFactor": factor}}]}
    for content, expected in ((glb(**red), np.ones((4, 3))), (coloured(glb(**red)), COLOURS)):
        path.write_bytes(content)
        mesh = read_mesh(path)
        seen = FileColours(path, mesh, mesh)(mesh.vertices, mesh.vertices)
        assert seen == pytest.approx(expected * factor[:3], abs=1e-5)


def test_colours_are_shares_of_1_and_parts_without_are_grey_beside_others():
    bytes_of = np.array([(255, 51, 0, 255)] * 4, np.uint8)
    painted = {"attributes": {"POSITION": 0, "COLOR_0": 2}}
    for keys in ({}, SHARE):
        read = read_glb(glb(VERTICES, CORNERS, (bytes_of, keys), parts=(painted, {})))
        expected = np.repeat([(1, 0.2, 0), (UNCOLOURED_GREY, UNCOLOURED_GREY, UNCOLOURED_GREY)], 4, axis=0)
        assert read.vertex_colours == pytest.approx(expected)
    assert read_glb(glb()).vertex_colours is None


DRACO = ({"extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}},)
REFUSED = {
    "draco": (glb(extensionsRequired=["KHR_draco_mesh_compression"]), "without 'KHR_draco_mesh_compression'; export"),
    "draco, named only where it is used": (
        glb((VERTICES, {"empty": True}), parts=DRACO, extensionsUsed=["KHR_draco_mesh_compression"]),
        "accessor 0 has none .extensions: KHR_draco_mesh_compression",
    ),
    "meshopt": (glb(extensionsRequired=["EXT_meshopt_compression"]), "without 'EXT_meshopt_compression'"),
    "numbers in another file": (glb(buffers=[{"byteLength": 72, "uri": "a.bin"}]), "buffer 0 is elsewhere, 'a.bin'"),
    "beyond the vertices": (glb(VERTICES, CORNERS + 1), "4 vertices, but one uses number 4"),
    "an accessor beyond its bytes": (glb((VERTICES, {"count": 400})), "is damaged .*; export or copy"),
    "a node twice": (glb(nodes=[{"mesh": 0, "children": [0]}]), "has node 0 twice"),
    "version 1": (b"glTF" + struct.pack("<IIII", 1, 20, 0, 0), "found version 1; export"),
    "another file": (b"this is no mesh", "must begin with 'glTF', .*, found 'this is no mesh'"),
    "no table": (b"glTF" + struct.pack("<III4s", 2, 20, 4, b"JSON") + b"{{{{", "as JSON"),
}


@each("name", [*REFUSED])
def test_what_is_not_read_is_named(name):
    content, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        read_glb(content)
