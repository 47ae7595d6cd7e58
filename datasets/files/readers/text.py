"""Reads the polygons of .obj, .off and .stl files and the materials of .mtl files; detects files of other kinds."""

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from datasets.extras import named_image
from datasets.files.readers.polygons import WHITE, Material, Polygons, scale_colours

UNSUPPORTED_KEYS = {"surf": "a free-form surface", "call": "another file that it includes"}  # keys of .obj
STL_FACE_DTYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
OTHER_FILE_SIGNATURES = {  # first bytes in lower case: the kind of file, and the remedy
    b"\x00\x05\x16\x07": "holds a Mac's notes on a file, whose names begin with '._'; take the file without '._'",
    b"version https://git-lfs": "is a Git LFS pointer; fetch it with 'git lfs pull'",
    b"\x1f\x8b": "is compressed by gzip; unpack it",
    b"pk\x03\x04": "is a .zip archive; unpack it",
    b"<!doctype html": "is a web page; download the file itself",
    b"<html": "is a web page; download the file itself",
}
UTF16_MARKS = b"\xff\xfe", b"\xfe\xff"
LINE_WITH_NAME = re.compile(r"\s*(?:usemtl|newmtl|map_kd)\s", re.IGNORECASE)  # a name may contain #
BROKEN_LINE = re.compile(r"^[ \t]*[vf][ \t](?:[^\\\n]|\\[ \t]*\n)*", re.MULTILINE)  # \ continues a line


def read_obj(content: bytes) -> Polygons:
    """The polygons of a Wavefront file, with texture coordinates and the names of materials, without normals.

    Raises:
        ValueError: a line does not follow the format.
    """
    text = decode(content)
    if "\\" in text:
        text = BROKEN_LINE.sub(lambda line: re.sub(r"\\[ \t]*\n", " ", line[0]), text)
    vertices, colours, counts, corners = [], [], [], []
    coordinates, texels, material, names, material_index = [], [], [], {"": 0}, 0
    for line in text.split("\n"):
        key, *words = line.split() or [""]
        try:
            if key == "v":
                vertices.append(_vector(words))
                colours += [_vector(words[3:])] if len(words) > 5 else []
            elif key in ("f", "fo"):
                pairs = [word.split("/") for word in words]
                corners += [_vertex_index(int(pair[0]), len(vertices)) for pair in pairs]
                texels += [int(pair[1]) if len(pair) > 1 and pair[1] else 0 for pair in pairs]
                counts.append(len(pairs))
                material.append((material_index, len(coordinates)))
            elif key == "vt":
                coordinates.append(_texture_coordinates(words))
            elif key == "usemtl":
                material_index = names.setdefault(" ".join(words), len(names))
        except ValueError:
            what = "'v x y z'" if key == "v" else f"'f a b c', numbers from 1, or from -{len(vertices)} to -1"
            raise ValueError(f"a line must be {what}, found '{line.strip()[:60]}'; export it again") from None
        if key in UNSUPPORTED_KEYS:
            raise ValueError(f"must hold polygons, but has {UNSUPPORTED_KEYS[key]} ('{key}'); export it as triangles")
    material, coordinate_counts = np.array(material, dtype=np.int64).reshape(-1, 2).T
    return replace(
        _polygons(vertices, counts, corners, colours),
        coordinates=_corner_coordinates(coordinates, texels, np.repeat(coordinate_counts, counts)),
        materials=tuple(map(Material, names)),
        material=material,
    )


def read_mtl(path: Path) -> dict[str, Material]:
    """The materials of an .mtl file by name, each with its image, or else its diffuse colour."""
    materials, name = {}, ""
    for line in decode(path.read_bytes()).split("\n"):
        key, *words = line.split() or [""]
        if key.lower() == "newmtl":
            name = " ".join(words)
            materials[name] = Material(name)
        elif key.lower() == "kd" and name in materials and materials[name].image is None:
            with suppress(ValueError):  # a spectrum
                red, green, blue = _vector(words * 3 if len(words) == 1 else words)
                materials[name] = Material(name, (red, green, blue))
        elif key.lower() == "map_kd" and name in materials and words:
            materials[name] = Material(name, WHITE, named_image(path.absolute(), line))
    return materials


def read_off(content: bytes) -> Polygons:
    """The polygons of an .off file, with the colours of its vertices (COFF).

    Raises:
        ValueError: it is binary, has vertices without three coordinates, is incomplete, or a number is no number.
    """
    text = decode(content).strip()
    header = re.match(r"(?:ST)?([CN]*)OFF(?![^\W\d])|off(?![^\W\d])|(?=\d+\s)", text)  # the word may be left out
    if header is None or re.match(r"\s*BINARY", text[header.end() :]):
        start = text[:20].splitlines()[0] if text else "nothing"
        raise ValueError(f"must be text and begin with OFF, COFF, NOFF or STOFF, found '{start}'; export it as .ply")
    variant = header[1] or ""
    offset = 6 if "N" in variant else 3  # where a vertex's colour begins
    width = offset + 4 * ("C" in variant) + 2 * header[0].startswith("ST")
    lines = [line.split() for line in text[header.end() :].split("\n") if line.strip()]
    try:
        vertex_count, face_count = (int(word) for word in lines[0][:2])
        rows = lines[1:]
        if len(rows) != vertex_count + face_count:
            rows = _regroup_rows(lines, vertex_count, face_count, width) or rows
        faces = [[int(number) for number in row[: 1 + int(row[0])]] for row in rows[vertex_count:]]
        vertices = [_vector(row) for row in rows[:vertex_count] if len(row) >= 3]
        colours = [_vector(row[offset:]) for row in rows[:vertex_count] if "C" in variant and len(row) >= offset + 3]
    except (ValueError, IndexError) as error:
        raise ValueError(
            f"must give its numbers of vertices and faces, then these, as numbers ({error}); export or copy it again"
        ) from None
    valid = [face for face in faces if face and 0 <= face[0] < len(face)]
    if len(vertices) < vertex_count or not len(valid) == len(faces) == face_count:
        raise ValueError(
            f"must be a whole .off file, but it is truncated or damaged: its header claims {vertex_count} vertices and "
            f"{face_count} faces, and it holds {len(vertices)} and {len(valid)}; export or copy it again"
        )
    return _polygons(vertices, [face[0] for face in valid], [corner for face in valid for corner in face[1:]], colours)


def read_stl(content: bytes) -> Polygons:
    """The polygons of an .stl file, binary or text with one solid or more. Normals and colours are not read.

    Raises:
        ValueError: it is incomplete, or a number is no number.
    """
    if b"\0" in content[:84] and not content.startswith(UTF16_MARKS):
        count = int.from_bytes(content[80:84], "little")
        if len(content) != 84 + 50 * count:
            raise ValueError(
                f"must be a whole .stl file, {84 + 50 * count} bytes for the {count} faces that it claims, found "
                f"{len(content)}; export or copy it again"
            )
        vertices, counts = np.frombuffer(content, STL_FACE_DTYPE, count, 84)["corners"].reshape(-1, 3), [3] * count
    else:
        text = re.sub(r"\bend\s+(loop|facet|solid)\b", r"end\1", decode(content).lower())
        if not re.match(r"\s*solid\b", text) or not re.search(r"\bendsolid\b[^\n]*\s*$", text):
            first, last = (" ".join(end.split()) for end in (text[:20], text[-20:]))
            raise ValueError(
                f"must be a whole .stl file, from 'solid' to 'endsolid', found '{first}' to '{last}'; "
                "export or copy it again"
            )
        loops = [facet.rpartition("loop")[2].split("vertex")[1:] for facet in text.split("endloop")[:-1]]
        try:
            vertices, counts = [_vector(vertex.split()) for loop in loops for vertex in loop], [*map(len, loops)]
        except ValueError as error:
            raise ValueError(f"must have lines 'vertex x y z' ({error}); export it again") from None
        if min(counts, default=3) < 3:
            raise ValueError(f"must have 3 corners or more in a facet, found {min(counts)}; export or copy it again")
    return _polygons(vertices, counts, np.arange(len(vertices)), [])


def wrong_kind_message(path: Path) -> str:
    """A message with the kind of a file that is no mesh or image, by its first bytes, and the remedy; else ""."""
    with path.open("rb") as file:
        begins = file.read(64).lstrip().lower()
    return next((what for start, what in OTHER_FILE_SIGNATURES.items() if begins.startswith(start)), "")


def decode_with_comments(content: bytes) -> str:
    """The text of a file with line ends \\n and without byte-order mark."""
    text = content.decode("utf-16" if content.startswith(UTF16_MARKS) else "utf-8-sig", "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def decode(content: bytes) -> str:
    """The text of a file with line ends \\n, without comments and without byte-order mark.

    A `#` in the name of a material or of its image does not begin a comment.
    """
    text = decode_with_comments(content)

    def keep_names(comment: re.Match) -> str:
        return comment[0] if LINE_WITH_NAME.match(text, text.rfind("\n", 0, comment.start()) + 1) else ""

    return re.sub(r"#[^\n]*", keep_names, text)


def _regroup_rows(lines: list[list[str]], vertex_count: int, face_count: int, width: int) -> list[list[str]]:
    """The words of each vertex and face of an .off file with other line breaks; empty if the file is incomplete."""
    if min(vertex_count, face_count) < 0 or width * vertex_count + face_count > sum(map(len, lines)):
        return []
    rest = islice((word for line in lines for word in line), 3, None)
    rows = [[*islice(rest, width)] for _ in range(vertex_count)]
    rows += [[count, *islice(rest, int(count))] for count in rest if count.isdigit()]
    complete = len(rows) == vertex_count + face_count and (not face_count or len(rows[-1]) == 1 + int(rows[-1][0]))
    return rows if complete else []


def _vector(words: Sequence[str]) -> list[float]:
    x, y, z = words[:3]
    return [float(x), float(y), float(z)]


def _texture_coordinates(words: Sequence[str]) -> list[float]:
    """Texture coordinates, NaN if they are no numbers."""
    try:
        return [float(word) for word in (*words, "0", "0")[:2]]
    except ValueError:
        return [np.nan, np.nan]


def _corner_coordinates(
    coordinates: list[list[float]], texels: list[int], coordinate_counts: Int[np.ndarray, " c"]
) -> Float[np.ndarray, "c 2"]:
    """The texture coordinates of corners by number, from 1 or back from the last one so far; NaN without any."""
    numbers = np.array(texels, dtype=np.int64)
    index = numbers + np.where(numbers < 0, coordinate_counts, -1)
    index[(index < 0) | (index >= len(coordinates))] = len(coordinates)
    return np.array([*coordinates, (np.nan, np.nan)])[index]


def _vertex_index(number: int, vertex_count: int) -> int:
    """The vertex index, from 0, for a number in an .obj file, which counts from 1 or back from the last one so far."""
    if number == 0 or number < -vertex_count:
        raise ValueError
    return number - 1 if number > 0 else vertex_count + number


def _polygons(vertices: Any, counts: list, corners: Any, colours: list) -> Polygons:
    return Polygons(
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        np.array(counts, dtype=np.int64),
        np.array(corners, dtype=np.int64),
        scale_colours(np.array(colours)) if colours and len(colours) == len(vertices) else None,
    )
