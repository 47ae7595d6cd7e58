"""Whether a mesh file is whole: a truncated one holds less than its header says, or its faces name missing vertices."""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

UNUSED = 0.1  # share of the vertices that no face uses: in a whole .obj next to none, in one without its end many
BYTES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8} | {
    f"{kind}{bits}": bits // 8 for kind in ("int", "uint", "float") for bits in (8, 16, 32, 64)
}  # of a number in a binary .ply
STL_HEADER, STL_FACE = 84, 50  # bytes
VERTEX = re.compile(rb"^[ \t]*v[ \t]", re.M)  # of an .obj
FACE = re.compile(rb"^[ \t]*[flp][ \t]([^\r\n#]*)", re.M)  # or line or point
GLB_HEADER = struct.Struct("<4sII")  # magic, version, length of the file


class Truncated(ValueError):
    """A file lacks its end; the message says what is missing."""


def check_whole(path: Path) -> tuple[str, ...]:
    """Compares the contents of a mesh file with its header, or with what its faces refer to.

    Other errors of a file are left to its reader.

    Returns:
        doubts: warnings, where a file is probably truncated but may be whole.

    Raises:
        ValueError: where the file is truncated for certain.
    """
    suffix = path.suffix.lower()
    try:
        return CHECKS[suffix](path.read_bytes())
    except Truncated as error:
        remedy = "copy it again, or export it as a binary .stl" if suffix == ".stl" else "export or copy it again"
        raise ValueError(f"must be a whole {suffix} file, but it is truncated: {error}; {remedy}") from None


def _obj(data: bytes) -> tuple[str, ...]:
    """An .obj has no header: its faces must refer to existing vertices, and most vertices should be in a face."""
    data = data.replace(b"\\\n", b" ").replace(b"\\\r\n", b" ")  # lines that go on
    vertices = len(re.findall(VERTEX, data))
    words = b" ".join(re.findall(FACE, data))
    words = re.sub(rb"(?<=\d)/\S*", b"", words) if b"/" in words else words  # without texture and normal
    try:
        named = np.array(list(map(int, words.split())), dtype=np.int64)
    except (ValueError, OverflowError):
        return ()  # no numbers: the reader says so
    if named.size and (named.min() < 0 or named.max() > vertices):
        named = _in_range(data, named)
    unused = vertices - np.count_nonzero(np.bincount(named, minlength=1)[1:])
    without = f"{unused} of {vertices} vertices are in no face"
    many = bool(named.size) and unused > UNUSED * vertices
    if data and not data.endswith((b"\n", b"\r")):
        lines = data.splitlines()
        last = lines[-1].split() or [b""]
        if last[0] in (b"v", b"f") and len(last) < 4:
            raise Truncated(f"it ends within line {len(lines)}, '{lines[-1].decode('ascii', 'replace')}'")
        if many:
            raise Truncated(f"it ends within line {len(lines)}, and {without}")
    return (f"warning: {without}: the file may be truncated",) if many else ()


def _in_range(data: bytes, named: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """The vertices of the faces, counted from 1; a negative number counts backwards from the latest vertex.

    Raises:
        Truncated: where a vertex does not exist.
    """
    vertices = [match.start() for match in re.finditer(VERTEX, data)]
    faces = list(re.finditer(FACE, data))
    starts = np.repeat([face.start() for face in faces], [len(face[1].split()) for face in faces])
    named = np.where(named < 0, np.searchsorted(vertices, starts) + 1 + named, named)
    for wrong in (named.argmax(), named.argmin()):
        if not 0 <= named[wrong] <= len(vertices):
            line = data.count(b"\n", 0, int(starts[wrong])) + 1
            raise Truncated(f"the face in line {line} names vertex {named[wrong]}, and there are {len(vertices)}")
    return named


def _stl(data: bytes) -> tuple[str, ...]:
    if data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:STL_HEADER]:
        text = data.lower()
        if text.rfind(b"endsolid") < max(text.rfind(b"facet normal"), text.rfind(b"endfacet")):
            raise Truncated(f"it ends after {_faces(text.count(b'endfacet'))}, without 'endsolid'")
        return ()
    if len(data) < STL_HEADER:
        raise Truncated(f"it has {len(data)} bytes, and its header takes {STL_HEADER}")
    (claimed,), held = struct.unpack_from("<I", data, STL_HEADER - 4), (len(data) - STL_HEADER) // STL_FACE
    if claimed > held:
        raise Truncated(f"its header claims {_faces(claimed)}, and it holds {held}")
    return ()


def _off(data: bytes) -> tuple[str, ...]:
    text = data.decode("ascii", "replace")
    lines = [line for line in (line.split("#", 1)[0].strip() for line in text.splitlines()) if line]
    first, *counts = (lines or [""])[0].split() or [""]
    if not first.upper().endswith("OFF"):
        return ()
    if not counts:  # they may be in the line of the name
        del lines[0]
        counts = (lines or [""])[0].split()
    if len(counts) < 2 or not (counts[0].isdigit() and counts[1].isdigit()):
        return ()
    elements = [Element("vertex", int(counts[0]), [("", "")] * 3), Element("face", int(counts[1]), [("n", "")])]
    _check_rows(elements, lines[1:])
    return ()


@dataclass(frozen=True)
class Element:
    """One kind of element in a header: their count, and the types of a row's numbers.

    A number is a pair: the type of the length of a list, empty where it is none, and the type of each number.
    """

    name: str
    count: int
    numbers: list[tuple[str, str]]

    def least_bytes(self) -> int:
        """The least size of all rows in a binary file; a face has three corners at least."""
        corners = 3 if self.name == "face" else 0
        sizes = (BYTES[of] if not length else BYTES[length] + corners * BYTES[of] for length, of in self.numbers)
        return self.count * sum(sizes)

    def fits(self, row: str) -> bool:
        """Whether a row of text has all its numbers."""
        words, place = row.split(), 0
        for length, _ in self.numbers:
            if place >= len(words):
                return False
            place += 1 + (int(words[place]) if length else 0)
        return place <= len(words)


def _ply(data: bytes) -> tuple[str, ...]:
    header, end, body = data.partition(b"end_header")
    if not header.startswith(b"ply"):
        return ()
    if not end:
        raise Truncated("its header has no end")
    body = body[body.find(b"\n") + 1 :]
    elements: list[Element] = []
    binary = b"format ascii" not in header
    for line in header.decode("ascii", "replace").splitlines():
        match line.split():
            case ["element", name, count] if count.isdigit():
                elements.append(Element(name, int(count), []))
            case ["property", "list", length, of, _] if elements and length in BYTES and of in BYTES:
                elements[-1].numbers.append((length, of))
            case ["property", of, _] if elements and of in BYTES:
                elements[-1].numbers.append(("", of))
            case ["property" | "element", *_]:
                return ()  # no header that is known: the reader says so
    if binary:
        least = sum(element.least_bytes() for element in elements)
        if len(body) < least:
            raise Truncated(f"its header claims {_counts(elements)}, in {least} bytes at least, and {len(body)} follow")
        return ()
    _check_rows(elements, [line for line in body.decode("ascii", "replace").splitlines() if line.strip()])
    return ()


def _check_rows(elements: list[Element], rows: list[str]) -> None:
    """Raises Truncated where rows of text are fewer than the elements of a header, or the last one is cut off."""
    wanted = sum(element.count for element in elements)
    filled = [element for element in elements if element.count]
    try:
        cut = bool(filled) and len(rows) == wanted and not filled[-1].fits(rows[-1])
    except ValueError:
        return  # no numbers: the reader says so
    if len(rows) >= wanted and not cut:
        return
    left, held = len(rows) - cut, []
    for element in elements:
        held.append(Element(element.name, min(element.count, left), []))
        left -= held[-1].count
    raise Truncated(f"its header claims {_counts(elements)}, and it holds {_counts(held)}")


def _glb(data: bytes) -> tuple[str, ...]:
    if len(data) < GLB_HEADER.size:
        raise Truncated(f"it has {len(data)} bytes, and its header takes {GLB_HEADER.size}")
    magic, _, length = GLB_HEADER.unpack_from(data)
    if magic == b"glTF" and length > len(data):
        raise Truncated(f"its header claims {length} bytes, and it has {len(data)}")
    return ()


def _counts(elements: list[Element]) -> str:
    nouns = {"vertex": "vertices", "face": "faces"}
    named = [f"{element.count} {nouns.get(element.name, element.name)}" for element in elements]
    return " and ".join([", ".join(named[:-1]), named[-1]] if len(named) > 1 else named)


def _faces(count: int) -> str:
    return f"{count} face{'' if count == 1 else 's'}"


CHECKS: dict[str, Callable[[bytes], tuple[str, ...]]] = {
    ".obj": _obj, ".ply": _ply, ".stl": _stl, ".off": _off, ".glb": _glb,
}  # fmt: skip
