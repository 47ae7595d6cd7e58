"""Reads the polygons of .obj and .off files."""

import re
from collections.abc import Sequence
from itertools import islice

import numpy as np

from datasets.readers.polygons import Polygons, shades

UNREAD = {"surf": "a free-form surface", "call": "another file that it includes"}  # of .obj: would be missing
BROKEN_LINE = re.compile(r"^[ \t]*[vf][ \t](?:[^\\\n]|\\[ \t]*\n)*", re.MULTILINE)  # \ at the end: the next one goes on


def read_obj(content: bytes) -> Polygons:
    """The polygons of a Wavefront file. Lines, points, textures, normals and materials are not read.

    Raises:
        ValueError: where a line is not as the format has it.
    """
    text = decoded(content)
    if "\\" in text:
        text = BROKEN_LINE.sub(lambda line: re.sub(r"\\[ \t]*\n", " ", line[0]), text)
    vertices, colours, counts, corners = [], [], [], []
    for line in text.splitlines():
        key, *words = line.split() or [""]
        try:
            if key == "v":
                vertices.append(_three(words))
                colours += [_three(words[3:])] if len(words) > 5 else []
            elif key in ("f", "fo"):
                numbers = [int(word.partition("/")[0]) for word in words]
                corners += [_from_zero(number, len(vertices)) for number in numbers]
                counts.append(len(numbers))
        except ValueError:
            what = "'v x y z'" if key == "v" else f"'f a b c', numbers from 1, or from -{len(vertices)} to -1"
            raise ValueError(f"a line must be {what}, found '{line.strip()[:60]}'; export it again") from None
        if key in UNREAD:
            raise ValueError(f"must hold polygons, but has {UNREAD[key]} ('{key}'); export it as triangles")
    return _polygons(vertices, counts, corners, colours)


def read_off(content: bytes) -> Polygons:
    """The polygons of an .off file, with the colours of its vertices (COFF).

    Raises:
        ValueError: where it is binary, has other than three coordinates, is not whole, or has a word for a number.
    """
    text = decoded(content).strip()
    header = re.match(r"(?:ST)?([CN]*)OFF(?![^\W\d])|off(?![^\W\d])|(?=\d+\s)", text)  # the word may be left out
    if header is None or re.match(r"\s*BINARY", text[header.end() :]):
        found = text[:20].splitlines()[0] if text else "nothing"
        raise ValueError(f"must be text and begin with OFF, COFF, NOFF or STOFF, found '{found}'; export it as .ply")
    letters = header[1] or ""
    shade = 6 if "N" in letters else 3  # where a vertex's colour begins
    lines = [line.split() for line in text[header.end() :].splitlines() if line.strip()]
    try:
        vertex_count, face_count = (int(word) for word in lines[0][:2])
        rows = lines[1:]
        if len(rows) != vertex_count + face_count:
            rows = _in_rows(lines, vertex_count, face_count) or rows
        faces = [[int(number) for number in row[: 1 + int(row[0])]] for row in rows[vertex_count:]]
        vertices = [_three(row) for row in rows[:vertex_count] if len(row) >= 3]
        colours = [_three(row[shade:]) for row in rows[:vertex_count] if "C" in letters and len(row) >= shade + 3]
    except (ValueError, IndexError) as error:
        raise ValueError(
            f"must give its numbers of vertices and faces, then these, as numbers ({error}); export or copy it again"
        ) from None
    whole = [face for face in faces if face and 0 <= face[0] < len(face)]
    if len(vertices) < vertex_count or not len(whole) == len(faces) == face_count:
        raise ValueError(
            f"must be a whole .off file, but it is truncated or damaged: its header claims {vertex_count} vertices and "
            f"{face_count} faces, and it holds {len(vertices)} and {len(whole)}; export or copy it again"
        )
    return _polygons(vertices, [face[0] for face in whole], [corner for face in whole for corner in face[1:]], colours)


def decoded(content: bytes) -> str:
    """The text of a file with plain ends of lines, without comments and the mark that some editors write first."""
    wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = content.decode("utf-16" if wide else "utf-8-sig", "replace").replace("\r\n", "\n").replace("\r", "\n")
    return re.sub(r"#[^\n]*", "", text)


def _in_rows(lines: list[list[str]], vertex_count: int, face_count: int) -> list[list[str]]:
    """The words of each vertex and face of an .off file that breaks its lines elsewhere; none if it is not whole."""
    if min(vertex_count, face_count) < 0 or 3 * vertex_count + face_count > sum(map(len, lines)):
        return []
    rest = islice((word for line in lines for word in line), 3, None)
    rows = [[*islice(rest, 3)] for _ in range(vertex_count)]
    rows += [[count, *islice(rest, int(count))] for count in rest if count.isdigit()]
    whole = len(rows) == vertex_count + face_count and (not face_count or len(rows[-1]) == 1 + int(rows[-1][0]))
    return rows if whole else []


def _three(words: Sequence[str]) -> list[float]:
    x, y, z = words[:3]
    return [float(x), float(y), float(z)]


def _from_zero(number: int, vertex_count: int) -> int:
    """The vertex that a number in an .obj file means, counted from 0: from 1, or back from the last one so far."""
    if number == 0 or number < -vertex_count:
        raise ValueError
    return number - 1 if number > 0 else vertex_count + number


def _polygons(vertices: list, counts: list, corners: list, colours: list) -> Polygons:
    return Polygons(
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        np.array(counts, dtype=np.int64),
        np.array(corners, dtype=np.int64),
        shades(np.array(colours)) if colours and len(colours) == len(vertices) else None,
    )
