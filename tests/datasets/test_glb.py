"""What a .glb file may hold: numbers in every coding, placed in every way; each is one tetrahedron or more."""

import json
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets.readers.glb import read_glb
from tests.looped import each

VERTICES = np.array([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], dtype=np.float32)
FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)], dtype=np.uint16)
CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


def glb(arrays: list, nodes: list | None = None, primitive: dict | None = None, **more) -> bytes:
    """A file with a mesh. Accessors are the `arrays`, of which any may be a pair with keys that it also has.

    `sparse` as a key is a pair of indices and values; `stride` is in bytes.
    """
    views, accessors, binary = [], [], b""

    def view(array: np.ndarray, **keys) -> int:
        nonlocal binary
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes, **keys})
        binary += array.tobytes() + b"\0" * (-array.nbytes % 4)
        return len(views) - 1

    for entry in arrays:
        array, keys = entry if isinstance(entry, tuple) else (entry, {})
        array, keys = array.astype(np.float32) if array.dtype == np.float64 else array, dict(keys)
        accessor = {"componentType": CODES[array.dtype.str[1:]], "count": len(array), "type": TYPES[array.shape[1:]]}
        if "sparse" in keys:
            index, values = keys.pop("sparse")
            parts = (
                {"bufferView": view(index), "componentType": CODES[index.dtype.str[1:]]},
                {"bufferView": view(values)},
            )
            accessor["sparse"] = {"count": len(index), "indices": parts[0], "values": parts[1]}
        if stride := keys.pop("stride", 0):
            padded = np.zeros((len(array), stride), np.uint8)
            padded[:, : array[0].nbytes] = np.ascontiguousarray(array).view(np.uint8).reshape(len(array), -1)
            accessor["bufferView"] = view(padded, byteStride=stride)
        elif not keys.pop("empty", False):
            accessor["bufferView"] = view(array)
        accessors.append(accessor | keys)
    primitive = {"attributes": {"POSITION": 0}, "indices": 1} | (primitive or {})
    primitive = {key: value for key, value in primitive.items() if value is not None}
    stored = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    } | more
    text = json.dumps(stored).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


PLAIN = [VERTICES, FACES]
HALVES = [(0, 1, 3), (0, 3, 2), (0, 2, 1)]  # a fan about the first vertex; the fourth face is its own primitive
STRIP = np.array([0, 2, 1, 3, 0, 2], np.uint16)
TURN = Rotation.from_euler("xyz", (30, 40, 50), degrees=True)
MOVED = {"translation": [5, 6, 7], "rotation": TURN.as_quat().tolist(), "scale": [2, 3, 0.5]}
MATRIX = np.eye(4)
MATRIX[:3] = np.c_[TURN.as_matrix() @ np.diag([2, 3, 0.5]), [5, 6, 7]]
PLACES = VERTICES @ MATRIX[:3, :3].T + MATRIX[:3, 3]
MIRROR = VERTICES * [-1, 1, 1]
TWO = np.array([(0, 0, 0), (9, 0, 0)], np.float32)
QUATS = np.array([(0, 0, 0, 1), TURN.as_quat()], np.float32)
BIND = np.stack([np.eye(4), np.eye(4)]).astype(np.float32)
BIND[1, 3, :3] = -1, 0, 0  # by columns
JOINTS = np.array([(0, 1, 0, 0)] * 4, np.uint8)
HALF = np.array([(127, 128, 0, 0)] * 4, np.uint8)  # of 255
SKINNED = [{"mesh": 0, "skin": 0, "translation": [50, 0, 0]}, {"translation": [0, 0, 4]}, {"translation": [3, 0, 4]}]
SKIN = {"skins": [{"joints": [1, 2], "inverseBindMatrices": 4}], "scenes": [{"nodes": [0, 1, 2]}]}
BENT = VERTICES + np.array([2 * 128 / 255, 0, 4])  # one joint moves by (0, 0, 4), the other by (2, 0, 4)
INSTANCED = [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 2, "ROTATION": 3}}}}]
QUANTISED = {"extensionsRequired": ["KHR_mesh_quantization"], "extensionsUsed": ["KHR_mesh_quantization"]}

READ = {  # a file, and the vertices of its tetrahedra
    "plain": (glb([VERTICES, FACES.ravel()]), [VERTICES]),
    "without indices": (glb([VERTICES[FACES].reshape(-1, 3)], primitive={"indices": None}), [VERTICES]),
    "bytes as indices": (glb([VERTICES, FACES.astype(np.uint8).ravel()]), [VERTICES]),
    "bytes as positions": (glb([VERTICES.astype(np.uint8), FACES.ravel()], **QUANTISED), [VERTICES]),
    "normalised": (
        glb([((VERTICES * 32767 / 3).round().astype(np.int16), {"normalized": True}), FACES.ravel()], **QUANTISED),
        [(VERTICES * 32767 / 3).round() / 32767],
    ),
    "normalised bytes below zero": (
        glb([(((VERTICES - 3) * 127 / 3).round().astype(np.int8), {"normalized": True, "stride": 4}), FACES.ravel()]),
        [((VERTICES - 3) * 127 / 3).round() / 127],
    ),
    "with strides": (glb([(VERTICES, {"stride": 32}), FACES.ravel()]), [VERTICES]),
    "sparse": (
        glb(
            [(0 * VERTICES + VERTICES * [1, 1, 0], {"sparse": (np.array([3], np.uint8), VERTICES[3:])}), FACES.ravel()]
        ),
        [VERTICES],
    ),
    "sparse over zeros": (
        glb([(VERTICES, {"empty": True, "sparse": (np.arange(1, 4, dtype=np.uint16), VERTICES[1:])}), FACES.ravel()]),
        [VERTICES],
    ),
    "strip": (glb([VERTICES, STRIP], primitive={"mode": 5}), [VERTICES]),
    "strip without indices": (glb([VERTICES[STRIP]], primitive={"mode": 5, "indices": None}), [VERTICES]),
    "fan, and its base": (
        glb(
            [VERTICES, np.array([0, 1, 3, 2, 1], np.uint16), FACES[2]],
            meshes=[
                {
                    "primitives": [
                        {"attributes": {"POSITION": 0}, "indices": 1, "mode": 6},
                        {"attributes": {"POSITION": 0}, "indices": 2},
                    ]
                }
            ],
        ),
        [VERTICES],
    ),
    "lines and points beside": (
        glb(
            [VERTICES, FACES.ravel()],
            meshes=[
                {
                    "primitives": [{"attributes": {"POSITION": 0}, "mode": mode} for mode in (0, 1, 3)]
                    + [{"attributes": {"POSITION": 0}, "indices": 1}]
                }
            ],
        ),
        [VERTICES],
    ),
    "moved by parts": (glb([VERTICES, FACES.ravel()], [{"mesh": 0, **MOVED}]), [PLACES]),
    "moved by a matrix": (glb([VERTICES, FACES.ravel()], [{"mesh": 0, "matrix": MATRIX.T.ravel().tolist()}]), [PLACES]),
    "moved by its parent": (glb([VERTICES, FACES.ravel()], [{"children": [1], **MOVED}, {"mesh": 0}]), [PLACES]),
    "mirrored": (glb([VERTICES, FACES.ravel()], [{"mesh": 0, "scale": [-1, 1, 1]}]), [MIRROR]),
    "twice": (
        glb([VERTICES, FACES.ravel()], [{"mesh": 0}, {"mesh": 0, **MOVED}], scenes=[{"nodes": [0, 1]}]),
        [VERTICES, PLACES],
    ),
    "instances": (
        glb([VERTICES, FACES.ravel(), TWO, QUATS], INSTANCED, extensionsRequired=["EXT_mesh_gpu_instancing"]),
        [VERTICES, VERTICES @ TURN.as_matrix().T + TWO[1]],
    ),
    "a morph target": (
        glb(
            [VERTICES, FACES.ravel(), VERTICES],
            [{"mesh": 0, "weights": [0.5]}],
            {"targets": [{"POSITION": 2}]},
        ),
        [1.5 * VERTICES],
    ),
    "a morph target of the mesh, at zero": (
        glb([VERTICES, FACES.ravel(), VERTICES], None, {"targets": [{"POSITION": 2}]}),
        [VERTICES],
    ),
    "a skin": (
        glb(
            [VERTICES, FACES.ravel(), JOINTS, (HALF, {"normalized": True}), BIND],
            SKINNED,
            {"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}},
            **SKIN,
        ),
        [BENT],
    ),
    "another scene beside": (
        glb(
            [VERTICES, FACES.ravel()],
            [{"mesh": 0, **MOVED}, {"mesh": 0}],
            scene=1,
            scenes=[{"nodes": [0]}, {"nodes": [1]}],
        ),
        [VERTICES],
    ),
    "no scene": (glb([VERTICES, FACES.ravel()], [{"children": [1], **MOVED}, {"mesh": 0}], scenes=[]), [PLACES]),
}


@each("name", READ)
def test_each_triangle_is_where_it_is_meant(name):
    content, solids = READ[name]
    read = read_glb(content)
    triangles = read.vertices[read.triangles()[0]]
    expected = np.concatenate(
        [solid[FACES[:, ::-1] if np.linalg.det(solid[1:] - solid[0]) < 0 else FACES] for solid in solids]
    )
    assert _rolled(triangles) == pytest.approx(_rolled(expected), abs=1e-5)


def _rolled(triangles: np.ndarray) -> np.ndarray:
    """Triangles in the order of their corners' sums, each from its least corner on."""
    least = triangles.sum(axis=2).round(4).argmin(axis=1)
    rolled = np.take_along_axis(triangles, ((least[:, None] + np.arange(3)) % 3)[..., None], axis=1)
    return rolled[np.lexsort(rolled.reshape(-1, 9).round(4).T)]


DRACO = {"extensions": {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}}}
REFUSED = {
    "draco": (
        glb([VERTICES, FACES.ravel()], extensionsRequired=["KHR_draco_mesh_compression"]),
        "without 'KHR_draco_mesh_compression'; export it without that, uncompressed",
    ),
    "draco, told only where it is used": (
        glb([(VERTICES, {"empty": True}), FACES.ravel()], None, DRACO, extensionsUsed=["KHR_draco_mesh_compression"]),
        "accessor 0 has none .extensions: KHR_draco_mesh_compression",
    ),
    "meshopt": (
        glb([VERTICES, FACES.ravel()], extensionsRequired=["EXT_meshopt_compression"]),
        "without 'EXT_meshopt_compression'",
    ),
    "numbers in another file": (
        glb([VERTICES, FACES.ravel()], buffers=[{"byteLength": 72, "uri": "a.bin"}]),
        "buffer 0 is elsewhere a.bin .*; export it as one file",
    ),
    "beyond the vertices": (glb([VERTICES, FACES.ravel() + 1]), "4 vertices, but one uses number 4"),
    "an accessor beyond its bytes": (glb([(VERTICES, {"count": 400}), FACES.ravel()]), "is damaged .*; export or copy"),
    "a node twice": (glb([VERTICES, FACES.ravel()], [{"mesh": 0, "children": [0]}]), "has node 0 twice"),
    "version 1": (b"glTF" + struct.pack("<IIII", 1, 20, 0, 0), "found version 1; export"),
    "another file": (b"this is no mesh", "must begin with 'glTF', .*, found 'this is no mesh'"),
    "no table": (b"glTF" + struct.pack("<III4s", 2, 20, 4, b"JSON") + b"{{{{", "as JSON"),
}


@each("name", REFUSED)
def test_what_is_not_read_is_named(name):
    content, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        read_glb(content)
