"""Readers of .obj, .off, .ply and .stl files in each spelling, checked by the volume."""

import struct
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from datasets.files.meshes import load_mesh
from datasets.files.readers.ply import read_ply
from datasets.files.readers.polygons import Polygons, ears
from datasets.files.readers.text import read_obj, read_off, read_stl
from datasets.mesh import Mesh
from tests.looped import each

FEW = settings(max_examples=30, deadline=None)
SEEDS = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class Solid:
    """A closed solid of polygons that wind outward."""

    vertices: np.ndarray
    polygons: list[list[int]]
    volume: float
    area: float


def star(draw: np.random.Generator) -> np.ndarray:
    """A polygon about the origin, most often concave."""
    count = draw.integers(4, 13)
    angles = 2 * np.pi * (np.arange(count) + 0.8 * draw.random(count)) / count
    return draw.uniform(0.2, 1, (count, 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def comb(draw: np.random.Generator) -> np.ndarray:
    """A comb: it is not star-shaped about any point."""
    teeth = draw.integers(2, 6)
    x, y = np.arange(2 * teeth), np.full(2 * teeth, 0.2)
    upper = np.stack([np.repeat(x, 2)[1:-1], np.tile([1, 1, 0.2, 0.2], teeth)[: 4 * teeth - 2]], axis=1)
    return np.concatenate([[(x[-1], -y[0]), (x[-1], y[0])][:1], upper[::-1], [(0, -y[0])]])


def with_flat_corners(polygon: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    """The polygon with up to three additional corners on each edge."""
    points = []
    for first, second in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        fractions = np.sort(draw.random(draw.integers(0, 4)))[:, None]
        points += [first[None], first + fractions * (second - first)]
    return np.concatenate(points)


def prism(seed: int) -> Solid:
    """A rotated prism over a random polygon, with its polygons in random order."""
    draw = np.random.default_rng(seed)
    polygon = (star, comb)[draw.integers(2)](draw)
    polygon = with_flat_corners(polygon, draw) if draw.integers(2) else polygon
    count, height = len(polygon), draw.uniform(0.3, 2)
    ring, after = np.arange(count), np.roll(np.arange(count), -1)
    x, y = polygon.T
    base = (x * y[after] - y * x[after]).sum() / 2
    assert base > 0
    sides = np.stack([ring, after, after + count, ring + count], axis=1).tolist()
    caps = [np.roll(ring[::-1], draw.integers(count)).tolist(), np.roll(ring + count, draw.integers(count)).tolist()]
    flat = np.concatenate([np.c_[polygon, np.zeros(count)], np.c_[polygon, np.full(count, height)]])
    vertices = Rotation.random(rng=draw).apply(flat) + draw.uniform(-3, 3, 3)
    around = np.linalg.norm(polygon[after] - polygon, axis=1).sum()
    polygons = sides + caps
    order = draw.permutation(len(polygons))
    return Solid(vertices, [polygons[i] for i in order], base * height, 2 * base + around * height)


def check(read: Polygons, solid: Solid) -> None:
    """Checks that the polygons are the closed solid, with its volume and its area, which folds would exceed."""
    mesh = Mesh(read.vertices, read.triangles)
    assert mesh.watertight and mesh.volume == pytest.approx(solid.volume, rel=1e-9)
    assert mesh.area == pytest.approx(solid.area, rel=1e-9)
    assert len(mesh.faces) == sum(len(polygon) - 2 for polygon in solid.polygons)


def obj_text(solids: list[Solid], draw: np.random.Generator) -> str:
    """The solids one after another, in a random spelling of .obj files."""
    gap, indent = draw.choice([" ", "\t", "  "]), draw.choice(["", " ", "\t"])
    corner = draw.choice(["{0}", "{0}/{0}", "{0}//{0}", "{0}/{0}/{0}"])
    relative, joint = draw.integers(2), draw.choice([gap, f"{gap}\\\n"])
    lines, before = ["# C:\\made\\"], 0
    for solid in solids:
        count = len(solid.vertices)
        lines += [f"o part # {count}", *("v " + " ".join(map(repr, map(float, v))) for v in solid.vertices)]
        lines += [f"vt {v[0]} {v[1]}" for v in solid.vertices] + [f"vn {v[0]} {v[1]} {v[2]}" for v in solid.vertices]
        first = -count if relative else before + 1
        for polygon in solid.polygons:
            lines.append("f " + joint.join(corner.format(first + i) for i in polygon))
        before += count
    text = "\n".join(indent + line.replace(" ", gap) for line in lines) + draw.choice(["", "\n", "  # end\n"])
    return draw.choice(["", "\ufeff"]) + text.replace("\n", draw.choice(["\n", "\r\n", "\r"]))


def off_text(solid: Solid, draw: np.random.Generator) -> str:
    """The solid in a random spelling of .off files."""
    letters = draw.choice(["", "C", "N", "CN", "ST"])
    more = " 0 0 1" * ("N" in letters) + " 255 0 0 255" * ("C" in letters) + " 0.5 0.5" * ("T" in letters)
    numbers = f"{len(solid.vertices)} {len(solid.polygons)} 0"
    lines = [f"{letters}OFF" + draw.choice(["", " ", "\n", " # comment\n", "\n# comment\n\n"]) + numbers]
    lines += [" ".join(map(repr, map(float, v))) + more for v in solid.vertices]
    paint = draw.choice(["", " 255 0 0", " 0.1 0.2 0.3 1", " # face"])
    if not letters and draw.integers(2):
        lines = [lines[0] + "\n" + " ".join(lines[1:])]  # all vertices in one line
        paint = ""
    lines += [f"{len(polygon)} " + " ".join(map(str, polygon)) + paint for polygon in solid.polygons]
    return draw.choice(["", "\ufeff"]) + ("\n".join(lines) + "\n").replace("\n", draw.choice(["\n", "\r\n"]))


def ply_bytes(solid: Solid, draw: np.random.Generator) -> bytes:
    """The solid in a random spelling of .ply files, with additional elements and properties."""
    kind, end = draw.choice(["ascii", "binary_little_endian", "binary_big_endian"]), draw.choice(["\n", "\r\n"])
    name, lengths = draw.choice(["vertex_index", "vertex_indices"]), draw.choice(["uchar", "int"])
    extra = draw.integers(2)
    header = ["ply", f"format {kind} 1.0", "comment made", *(["element camera 1", "property float view"] * extra)]
    header += [f"element vertex {len(solid.vertices)}", *(f"property double {axis}" for axis in "xyz")]
    header += ["property float nx"] * extra + [f"element face {len(solid.polygons)}"]
    header += ["property uchar flags", "property list uchar float texcoord"] * extra
    header += [f"property list {lengths} int {name}", "end_header", ""]
    rows = [("f", [0.5])] * extra
    for vertex in solid.vertices:
        rows += [("ddd", vertex)] + [("f", [1.0])] * extra
    for polygon in solid.polygons:
        rows += [("B", [3]), ("Bff", [2, 0.5, 0.5])] * extra
        rows.append(({"uchar": "B", "int": "i"}[lengths] + "i" * len(polygon), [len(polygon), *polygon]))
    order = ">" if "big" in kind else "<"
    if kind == "ascii":
        body = end.join(" ".join(repr(x) for x in map(float, row)) for _, row in rows).replace(".0 ", " ").encode()
    else:
        body = b"".join(struct.pack(order + code, *row) for code, row in rows)
    return end.join(header).encode() + body


@FEW
@given(seed=SEEDS)
def test_triangles_fill_a_polygon_with_all_of_its_corners(seed):
    draw = np.random.default_rng(seed)
    polygon = with_flat_corners((star, comb)[seed % 2](draw), draw)
    cut = ears(polygon[None])[0]
    corners = polygon[cut]
    (ax, ay), (bx, by) = np.moveaxis(corners[:, 1:] - corners[:, :1], 0, -1).transpose(1, 0, 2)
    areas, (x, y) = (ax * by - ay * bx) / 2, polygon.T
    assert (areas > 0).all() and areas.sum() == pytest.approx((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
    assert {*cut.ravel().tolist()} == {*range(len(polygon))}


@FEW
@given(seed=SEEDS)
def test_files_are_read_in_each_spelling(seed):
    first, second = prism(seed), prism(seed + 1)
    shift = len(first.vertices)
    both = Solid(
        np.concatenate([first.vertices, second.vertices]),
        first.polygons + [[i + shift for i in polygon] for polygon in second.polygons],
        first.volume + second.volume,
        first.area + second.area,
    )
    check(read_obj(obj_text([first, second], np.random.default_rng(seed)).encode()), both)
    check(read_off(off_text(first, np.random.default_rng(seed)).encode()), first)
    check(read_ply(ply_bytes(first, np.random.default_rng(seed))), first)


POINTS = "0 0 0", "1 0 0", "0 1 0", "0 0 1"
FACES = "0 2 1", "0 1 3", "1 2 3", "0 3 2"
V, F = "".join(f"v {point}\n" for point in POINTS), "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
ROWS = "\n".join([*POINTS, *(f"3 {face}" for face in FACES)])
HEAD = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
STRIPS = f"{HEAD}element tristrips 1\nproperty list int int vertex_indices\nend_header\n" + "\n".join(POINTS)
CORNERS = [[POINTS[int(i)] for i in face.split()] for face in FACES]
LOOPS = [" outer loop\n" + "".join(f"  vertex {point}\n" for point in corners) + " endloop\n" for corners in CORNERS]
SOLID = "solid A #1\n" + "".join(f"facet normal nan 0 0\n{loop}endfacet\n" for loop in LOOPS) + "endsolid A\n"
TRIANGLES = np.array([[point.split() for point in corners] for corners in CORNERS], np.float32)
BINARY = b"".join(struct.pack("<12fH", 0, 0, 0, *corners.ravel(), 0) for corners in TRIANGLES)
TETRAHEDRA = {
    "faces before their vertices": (read_obj, F + V),
    "relative after half of the vertices": (read_obj, V[:16] + "f 1 3 -1\n" + V[16:] + F[8:]),
    "a folder's name that ends in a backslash": (read_obj, "mtllib C:\\made\\\n" + V + F),
    "a mark of another line in a name": (read_obj, "o a\u2028f 1 2 3\x0bf 1 2 3\n" + V + F),
    "corners twice": (read_obj, V + F.replace("1 3 2", "1 3 2 2").replace("1 2 4", "1 2 4 4 4")),
    "with lines and points": (read_obj, V + F + "l 1 2\np 3\nf 1 2\n"),
    "weights": (read_obj, V.replace("\n", " 1.0\n") + F),
    "utf-16": (read_obj, (V + F).encode("utf-16")),
    "a glued header": (read_off, "OFF4 4 6\n" + ROWS),
    "a comment that names OFF": (read_off, "# an OFF file\nOFF\n4 4 0\n" + ROWS),
    "two counts": (read_off, "off\n4 4\n" + ROWS),
    "no header": (read_off, "4 4 6\n" + ROWS),
    "one line": (read_off, " ".join(f"OFF 4 4 6 {ROWS}".split())),
    "normals, in one line": (read_off, " ".join(f"NOFF 4 4 6 {' 0 0 1 '.join(POINTS)} 0 0 1 {ROWS[23:]}".split())),
    "textures, in one line": (read_off, " ".join(f"STOFF 4 4 6 {' 0 1 '.join(POINTS)} 0 1 {ROWS[23:]}".split())),
    "a binary .stl named solid": (read_stl, b"solid facet normal".ljust(80) + struct.pack("<I", 4) + BINARY),
    "a text of .stl": (read_stl, SOLID),
    "two solids, in one line of capitals": (
        read_stl,
        " ".join(f"solid {first}{second} endsolid" for first, second in (LOOPS[:2], LOOPS[2:]))
        .upper()
        .replace("\n", " "),
    ),
    "end loop in .stl": (read_stl, SOLID.replace("endloop", "end loop").replace("endsolid", "END  SOLID")),
    "a wide text of .stl": (read_stl, SOLID.encode("utf-16")),
    "a text with more in a line than its header says": (
        read_ply,
        HEAD + "element face 4\nproperty list uchar int vertex_indices\nend_header\n" + ROWS.replace("\n", " 9 8 x\n"),
    ),
    "a strip": (read_ply, STRIPS + "\n6 0 2 1 3 0 2\n"),
    "strips that restart": (read_ply, STRIPS + "\n13 0 2 1 -1 1 2 3 3 -1 1 3 0 2\n"),
}


@each("name", TETRAHEDRA)
def test_a_tetrahedron_is_read_in_unusual_spellings(name):
    reader, content = TETRAHEDRA[name]
    read = reader(content if isinstance(content, bytes) else content.encode())
    welded, vertex = np.unique(read.vertices, axis=0, return_inverse=True)
    mesh = Mesh(welded, vertex.ravel()[read.triangles])
    assert mesh.watertight and mesh.volume == pytest.approx(1 / 6)


def ply_of(kind: str, numbers: str) -> str:
    bands = "".join(f"property {kind} {band}\n" for band in ("red", "green", "blue"))
    faces = "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    return HEAD + bands + faces + "\n".join([f"{point} {numbers}" for point in POINTS] + ROWS.split("\n")[4:])


COLOURED = {  # the same colours of four vertices
    "bytes of .ply": (read_ply, ply_of("uchar", "255 51 0")),
    "16 bits of .ply": (read_ply, ply_of("ushort", "65535 13107 0")),
    "shares of .ply": (read_ply, ply_of("float", "1 0.2 0")),
    "bytes of .obj": (read_obj, V.replace("\n", " 255 51 0\n") + F),
    "shares of .obj": (read_obj, V.replace("\n", " 1 0.2 0\n") + F),
    "bytes of .off": (read_off, "COFF\n4 4 6\n" + ROWS.replace("\n", " 255 51 0 255\n", 4)),
    "shares of .off, with normals": (read_off, "CNOFF\n4 4 6\n" + ROWS.replace("\n", " 0 0 1 1 0.2 0 1\n", 4)),
}


@each("name", COLOURED)
def test_colours_are_read_as_fractions_in_each_spelling(name):
    reader, content = COLOURED[name]
    assert reader(content.encode()).vertex_colours == pytest.approx(np.tile([1, 0.2, 0], (4, 1)))


def test_a_vertex_has_the_mean_colour_of_its_triangles():
    square = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (9, 9, 9)]
    polygons = Polygons(
        np.array(square, float), np.array([3, 4]), np.array([1, 4, 2, 0, 1, 2, 3]),
        face_colours=np.array([(0.0, 0, 1), (1, 0, 0)]),
    )  # fmt: skip
    red, both, of_three = (1, 0, 0), (0.5, 0, 0.5), (2 / 3, 0, 1 / 3)
    assert polygons.shaded == pytest.approx(np.array([red, both, of_three, red, (0, 0, 1), (0, 0, 0)]))


def test_face_colours_are_ignored_if_strips_have_none():
    face = "element face 1\nproperty list uchar int vertex_indices\nproperty uchar red\nproperty uchar green\n"
    strips = "property uchar blue\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    points = "\n".join(POINTS)
    read = read_ply(f"{HEAD}{face}{strips}{points}\n3 0 2 1 255 0 0\n5 0 1 3 2 0\n".encode())
    assert len(read.triangles) == 4 and read.shaded is None


REFUSED = {  # the name of a file, its content, and the message
    "longer.stl": ("x".ljust(80) + "\4\0\0\0" + "\0" * 201, "284 bytes for the 4 faces that it claims, found 285"),
    "endless.stl": (SOLID[:-11], "from 'solid' to 'endsolid', found 'solid a facet norma' to "),
    "commas.stl": (SOLID.replace("1 0 0", "1,0 0 0"), "'vertex x y z' .*'1,0'"),
    "two corners.stl": (SOLID.replace("  vertex 1 0 0\n", "", 1), "3 corners or more in a facet, found 2"),
    "page.stl": ("\n<!DOCTYPE html>\n", "is a web page"),
    "empty.obj": ("", "found 0 bytes"),
    "commas.obj": ("v 0,5 0 0\n", r"'v x y z', found 'v 0,5 0 0'"),
    "zero.obj": (V + "f 0 1 2\n", "found 'f 0 1 2'"),
    "too far back.obj": (V + "f -5 1 2\n", "from -4 to -1, found 'f -5 1 2'"),
    "beyond.obj": (V + "f 1 2 5\n", "4 vertices, but one uses number 4 counted from 0, 5 from 1"),
    "nan.obj": (V + "v nan 0 0\nf 1 2 5\n", "NaN"),
    "free form.obj": (V + F + "surf 0 1 0 1 1 2 3 4\n", "has a free-form surface"),
    "points.obj": (V, "must have faces, found none: it holds 4 vertices"),
    "other.obj": ("OFF\n4 4 6\n" + ROWS, "it holds at most points or lines, as .obj writes them"),
    "line.obj": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "must have an area, found 0"),
    "point.obj": ("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "must have an area, found 0"),
    "packed.obj": (b"\x1f\x8b\x08\x00", "is compressed by gzip; unpack it"),
    "four dimensions.off": ("4OFF\n4 4 6\n" + ROWS, "must be text and begin with OFF.*found '4OFF'"),
    "binary.off": ("OFF BINARY\n\0\0", "must be text .*found 'OFF BINARY'"),
    "fewer.off": ("OFF4 5 6\n" + ROWS, "truncated.* claims 4 vertices and 5 faces, and it holds 4 and 4"),
    "fewer, with colours.off": ("OFF4 9 6\n" + ROWS.replace("\n3", " 1 0 0\n3"), "and it holds 4 and 4"),
    "more.off": ("OFF4 3 6\n" + ROWS, "claims 4 vertices and 3 faces, and it holds 4 and 4"),
    "words.off": ("OFF\n4 4 6\n" + ROWS.replace("3 0 2 1", "3 0 two 1"), "'two'"),
    "inf.off": ("OFF\n4 4 6\n" + ROWS.replace("0 0 1", "0 0 inf"), "infinite"),
    "no list.ply": (f"{HEAD}element face 1\nproperty int a\nend_header\n" + "0 " * 13, "found a;"),
    "cut short.ply": (STRIPS, "ends within the 1 rows of 'tristrips'"),
    "longer.ply": (STRIPS + "\n3 0 1 2\n7 7\n", "header says, found 2 numbers more"),
    "endless.ply": (HEAD, "its header has no line 'end_header'"),
    "an unknown type.ply": (HEAD.replace("float x", "real x") + "end_header\n", "found 'property real x'"),
    "words.ply": ("this is\nno mesh\n", "does not begin with a line 'ply'"),
    "mac.ply": (b"\x00\x05\x16\x07\x00\x02", "holds a Mac's notes on a file"),
    "pointer.glb": ("version https://git-lfs.github.com/spec/v1\noid", "Git LFS pointer; fetch it with 'git lfs pull'"),
}


@each("name", REFUSED)
def test_a_broken_file_is_one_clear_error(tmp_path, name):
    content, message = REFUSED[name]
    (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as caught:
        load_mesh(tmp_path / name)
    assert str(caught.value).startswith(f"mesh file '{tmp_path / name}': ")
    assert "; " in str(caught.value)  # the remedy
    assert caught.value.__cause__ is None and caught.value.__suppress_context__  # no traceback of a library
