"""Reads the polygons of .ply files, text or binary, and their triangle strips."""

import re
import struct
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from jaxtyping import Float, Int

from datasets.readers.polygons import Polygons, cut_strips, shades

CODES = {  # of numpy and of struct
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float16": "e", "float32": "f", "float64": "d",
}  # fmt: skip
HEADER = re.compile(rb"ply[ \t]*(?:\r?\n(.*?)\nend_header[ \t]*\r?(?:\n|$)|\r(.*?)\rend_header[ \t]*\r)", re.DOTALL)
FULL = {"B": 255, "H": 65535}  # the brightest colour of a code
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
BANDS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


@dataclass(frozen=True)
class Element:
    """A table of the file.

    Args:
        count: of its rows.
        codes: of each column that of its numbers, and that of its lists' lengths or "".
        columns: the numbers of each, those of its lists one after the other; filled when the body is read.
        lengths: of the lists of each column that has some.
    """

    name: str
    count: int
    codes: dict[str, tuple[str, str]] = field(default_factory=dict)
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    lengths: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def colours(self) -> Float[np.ndarray, "n 3"] | None:
        """RGB of each row, from 0 to 1."""
        for names in BANDS:
            if all(name in self.columns for name in names):
                rgb = np.stack([self.columns[name] for name in names], axis=1)
                return shades(rgb.astype(np.float64), FULL.get(self.codes[names[0]][0]))
        return None

    def indices(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"]]:
        """How many vertices each row names, and which."""
        for name, lengths in self.lengths.items():
            if name.startswith("vertex_ind"):
                return lengths.astype(np.int64), self.columns[name].astype(np.int64)
        if self.count:
            found = ", ".join(self.codes) or "nothing"
            raise ValueError(f"must have lists vertex_indices in its '{self.name}', found {found}; export it again")
        return np.empty(0, np.int64), np.empty(0, np.int64)


@dataclass(frozen=True)
class Body:
    """What follows the header, as bytes; the numbers of a text are doubles."""

    content: bytes
    order: str
    text: bool

    def code(self, code: str) -> str:
        """The code of a number as it is stored."""
        return "<d" if self.text else self.order + code

    def take(self, code: str, size: int, at: int) -> tuple[tuple, int]:
        """So many numbers from a place on, and the place after them."""
        order, stored = self.code(code)
        layout = f"{order}{size}{stored}"
        return struct.unpack_from(layout, self.content, at), at + struct.calcsize(layout)


def read_ply(content: bytes) -> Polygons:
    """The polygons of a .ply file, or the triangles of its strips, with their colours.

    Raises:
        ValueError: where its header is not understood, or what follows is less or more than the header describes.
    """
    elements, kind, rest = _header(content.removeprefix(b"\xef\xbb\xbf"))
    if kind != "ascii":
        _fill_all(elements, Body(rest, ORDERS[kind], text=False))
        return _polygons(elements)
    try:
        _fill_all(elements, _numbers(rest.split()))
    except ValueError:  # with more in a line, perhaps, than the header describes
        _fill_all(elements, _numbers(_described(rest, elements)))
    return _polygons(elements)


def _fill_all(elements: dict[str, Element], body: Body) -> None:
    at = 0
    for element in elements.values():
        try:
            at = _fill(element, body, at)
        except (struct.error, ValueError, MemoryError, OverflowError):
            raise ValueError(
                f"must be a whole .ply file, but it is truncated or damaged: it ends within the {element.count} rows "
                f"of '{element.name}' that its header claims; export or copy it again"
            ) from None
    more = (len(body.content) - at) // 8 if body.text else len(body.content[at:].strip(b"\0\r\n\t "))
    if more:
        what = "numbers more" if body.text else "bytes more; copy it again, as a binary file"
        raise ValueError(f"must end where its header says, found {more} {what}; export or copy it again")


def _header(content: bytes) -> tuple[dict[str, Element], str, bytes]:
    """The elements, not yet filled, the format, and what follows the header."""
    match = HEADER.match(content)
    if match is None:
        begins = content.startswith(b"ply")
        why = "its header has no line 'end_header'" if begins else "it does not begin with a line 'ply'"
        raise ValueError(f"must be a whole .ply file, but {why}; export or copy it again")
    elements, kind, element = {}, "", Element("", 0)
    for line in (match[1] or match[2]).decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", word, _] if word in ORDERS:
                kind = word
            case ["element", name, count] if count.isdigit():
                element = elements[name] = Element(name, int(count))
            case ["property", "list", length, code, name] if {length, code} <= {*CODES} and name not in element.codes:
                element.codes[name] = CODES[code], CODES[length]
            case ["property", code, name] if code in CODES and name not in element.codes:
                element.codes[name] = CODES[code], ""
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"must have a header that is understood, found '{line[:60]}'; export it again")
    if not kind:
        raise ValueError("must name its format in the header, as 'format ascii 1.0'; export it again")
    return elements, kind, content[match.end() :]


def _numbers(words: list[bytes]) -> Body:
    try:
        return Body(np.array(words, dtype="<f8").tobytes(), "<", text=True)
    except ValueError as error:
        raise ValueError(f"must hold numbers after its header ({error}); export it again") from None


def _described(text: bytes, elements: dict[str, Element]) -> list[bytes]:
    """The words of a text, without those at the end of a line of which the header says nothing."""
    lines = (line.split() for line in text.splitlines() if line.strip())
    words = []
    for element in elements.values():
        for line in islice(lines, element.count):
            at = 0
            for _, length in element.codes.values():
                size = int(line[at]) if length and at < len(line) and line[at].isdigit() else 0
                at += 1 + size
            words += line[:at]
    return words + [word for line in lines for word in line]


def _fill(element: Element, body: Body, at: int) -> int:
    """Reads an element's columns from a place on; gives the place after them."""
    fields: list[tuple] = []
    for name, (code, length) in element.codes.items() if element.count else ():
        if length:  # as in the first row, perhaps
            (size,), _ = body.take(length, 1, at + np.dtype(fields).itemsize)
            fields += [(f"{name} count", body.code(length)), (name, body.code(code), (int(size),))]
        else:
            fields.append((name, body.code(code)))
    row = np.dtype(fields)
    if not element.count or at + element.count * row.itemsize > len(body.content):
        return _fill_by_rows(element, body, at)
    rows = np.frombuffer(body.content, row, element.count, at)
    lengths = {name: rows[f"{name} count"] for name, (_, length) in element.codes.items() if length}
    if any((counts != counts[0]).any() for counts in lengths.values()):
        return _fill_by_rows(element, body, at)
    element.columns.update({name: rows[name].ravel() for name in element.codes})
    element.lengths.update(lengths)
    return at + rows.nbytes


def _fill_by_rows(element: Element, body: Body, at: int) -> int:
    """The same for lists of several lengths."""
    columns: dict[str, list] = {name: [] for name in element.codes}
    counts: dict[str, list] = {name: [] for name, (_, length) in element.codes.items() if length}
    for _ in range(element.count):
        for name, (code, length) in element.codes.items():
            size = 1
            if length:
                (size,), at = body.take(length, 1, at)
                counts[name].append(size := int(size))
            numbers, at = body.take(code, size, at)
            columns[name] += numbers
    element.columns.update({name: np.array(numbers) for name, numbers in columns.items()})
    element.lengths.update({name: np.array(lengths) for name, lengths in counts.items()})
    return at


def _polygons(elements: dict[str, Element]) -> Polygons:
    vertex, face, strips = (elements.get(name, Element(name, 0)) for name in ("vertex", "face", "tristrips"))
    if not {"x", "y", "z"} <= {*vertex.columns}:
        raise ValueError("must have an element 'vertex' with x, y and z; export it again")
    places = [vertex.columns[axis].astype(vertex.codes[axis][0]) for axis in "xyz"]  # a text's are doubles
    counts, corners = face.indices()
    lengths, strip = strips.indices()
    cut = cut_strips(strip, lengths)
    return Polygons(
        np.stack(places, axis=1).astype(np.float64),
        np.concatenate([counts, np.full(len(cut), 3)]),
        np.concatenate([corners, cut.ravel()]),
        vertex.colours,
        None if len(cut) else face.colours,
    )
