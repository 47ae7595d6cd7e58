"""Reads the polygons of .ply files, text or binary, and their triangle strips."""

import re
import struct
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from jaxtyping import Float, Int

from datasets.files.readers.polygons import Polygons, cut_strips, scale_colours

TYPES = {  # for numpy and struct
    "char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d",
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q",
    "float16": "e", "float32": "f", "float64": "d",
}  # fmt: skip
HEADER = re.compile(rb"ply[ \t]*(?:\r?\n(.*?)\nend_header[ \t]*\r?(?:\n|$)|\r(.*?)\rend_header[ \t]*\r)", re.DOTALL)
BRIGHTEST = {"B": 255, "H": 65535}  # keys are type codes
BYTE_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
COLOUR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))


@dataclass(frozen=True)
class Element:
    """A table of the file.

    Args:
        count: of its rows.
        codes: the type code of each column's numbers, and the code of its lists' lengths, "" without lists.
        columns: the numbers of each column, its lists one after the other; filled when the body is read.
        lengths: of the lists of each column with lists.
    """

    name: str
    count: int
    codes: dict[str, tuple[str, str]] = field(default_factory=dict)
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    lengths: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def colours(self) -> Float[np.ndarray, "n 3"] | None:
        """RGB of each row, from 0 to 1."""
        for names in COLOUR_NAMES:
            if all(name in self.columns for name in names):
                rgb = np.stack([self.columns[name] for name in names], axis=1)
                return scale_colours(rgb.astype(np.float64), BRIGHTEST.get(self.codes[names[0]][0]))
        return None

    def indices(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"]]:
        """The number of vertices of each row, and the vertices of all rows."""
        for name, lengths in self.lengths.items():
            if name.startswith("vertex_ind"):
                return lengths.astype(np.int64), self.columns[name].astype(np.int64)
        if self.count:
            columns = ", ".join(self.codes) or "nothing"
            raise ValueError(f"must have lists vertex_indices in its '{self.name}', found {columns}; export it again")
        return np.empty(0, np.int64), np.empty(0, np.int64)


@dataclass(frozen=True)
class Body:
    """The bytes after the header; the numbers of a text file are converted to doubles."""

    content: bytes
    order: str
    text: bool

    def stored_type(self, code: str) -> str:
        """The type code and byte order of a stored number."""
        return "<d" if self.text else self.order + code

    def take(self, code: str, size: int, offset: int) -> tuple[tuple, int]:
        """Reads `size` numbers at a byte offset; returns them and the offset after them."""
        byte_order, stored_type = self.stored_type(code)
        layout = f"{byte_order}{size}{stored_type}"
        return struct.unpack_from(layout, self.content, offset), offset + struct.calcsize(layout)


def read_ply(content: bytes) -> Polygons:
    """The polygons of a .ply file, or the triangles of its strips, with their colours.

    Raises:
        ValueError: the header is not supported, or the body is shorter or longer than the header describes.
    """
    elements, kind, rest = _header(content.removeprefix(b"\xef\xbb\xbf"))
    if kind != "ascii":
        _fill_elements(elements, Body(rest, BYTE_ORDERS[kind], text=False))
        return _polygons(elements)
    try:
        _fill_elements(elements, _text_body(rest.split()))
    except ValueError:  # lines may have more words than the header describes
        _fill_elements(elements, _text_body(_described_words(rest, elements)))
    return _polygons(elements)


def _fill_elements(elements: dict[str, Element], body: Body) -> None:
    offset = 0
    for element in elements.values():
        try:
            offset = _fill(element, body, offset)
        except (struct.error, ValueError, MemoryError, OverflowError):
            raise ValueError(
                f"must be a whole .ply file, but it is truncated or damaged: it ends within the {element.count} rows "
                f"of '{element.name}' that its header claims; export or copy it again"
            ) from None
    surplus = (len(body.content) - offset) // 8 if body.text else len(body.content[offset:].strip(b"\0\r\n\t "))
    if surplus:
        what = "numbers more" if body.text else "bytes more; copy it again, as a binary file"
        raise ValueError(f"must end where its header says, found {surplus} {what}; export or copy it again")


def _header(content: bytes) -> tuple[dict[str, Element], str, bytes]:
    """The elements, not yet filled, the format, and the bytes after the header."""
    match = HEADER.match(content)
    if match is None:
        begins = content.startswith(b"ply")
        why = "its header has no line 'end_header'" if begins else "it does not begin with a line 'ply'"
        raise ValueError(f"must be a whole .ply file, but {why}; export or copy it again")
    elements, kind, element = {}, "", Element("", 0)
    for line in (match[1] or match[2]).decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", word, _] if word in BYTE_ORDERS:
                kind = word
            case ["element", name, count] if count.isdigit():
                element = elements[name] = Element(name, int(count))
            case ["property", "list", length, code, name] if {length, code} <= {*TYPES} and name not in element.codes:
                element.codes[name] = TYPES[code], TYPES[length]
            case ["property", code, name] if code in TYPES and name not in element.codes:
                element.codes[name] = TYPES[code], ""
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"must have a header that is understood, found '{line[:60]}'; export it again")
    if not kind:
        raise ValueError("must name its format in the header, as 'format ascii 1.0'; export it again")
    return elements, kind, content[match.end() :]


def _text_body(words: list[bytes]) -> Body:
    try:
        return Body(np.array(words, dtype="<f8").tobytes(), "<", text=True)
    except ValueError as error:
        raise ValueError(f"must hold numbers after its header ({error}); export it again") from None


def _described_words(text: bytes, elements: dict[str, Element]) -> list[bytes]:
    """The words of a text, without words at the end of a line that the header does not describe."""
    lines = (line.split() for line in text.splitlines() if line.strip())
    words = []
    for element in elements.values():
        for line in islice(lines, element.count):
            column = 0
            for _, length in element.codes.values():
                size = int(line[column]) if length and column < len(line) and line[column].isdigit() else 0
                column += 1 + size
            words += line[:column]
    return words + [word for line in lines for word in line]


def _fill(element: Element, body: Body, offset: int) -> int:
    """Reads an element's columns at a byte offset; returns the offset after them."""
    fields: list[tuple] = []
    for name, (code, length) in element.codes.items() if element.count else ():
        if length:  # assumed to be the length in the first row
            (size,), _ = body.take(length, 1, offset + np.dtype(fields).itemsize)
            fields += [(f"{name} count", body.stored_type(length)), (name, body.stored_type(code), (int(size),))]
        else:
            fields.append((name, body.stored_type(code)))
    row_type = np.dtype(fields)
    if not element.count or offset + element.count * row_type.itemsize > len(body.content):
        return _fill_by_rows(element, body, offset)
    rows = np.frombuffer(body.content, row_type, element.count, offset)
    lengths = {name: rows[f"{name} count"] for name, (_, length) in element.codes.items() if length}
    if any((counts != counts[0]).any() for counts in lengths.values()):
        return _fill_by_rows(element, body, offset)
    element.columns.update({name: rows[name].ravel() for name in element.codes})
    element.lengths.update(lengths)
    return offset + rows.nbytes


def _fill_by_rows(element: Element, body: Body, offset: int) -> int:
    """Does the same as `_fill` for lists of different lengths."""
    columns: dict[str, list] = {name: [] for name in element.codes}
    counts: dict[str, list] = {name: [] for name, (_, length) in element.codes.items() if length}
    for _ in range(element.count):
        for name, (code, length) in element.codes.items():
            size = 1
            if length:
                (size,), offset = body.take(length, 1, offset)
                counts[name].append(size := int(size))
            numbers, offset = body.take(code, size, offset)
            columns[name] += numbers
    element.columns.update({name: np.array(numbers) for name, numbers in columns.items()})
    element.lengths.update({name: np.array(lengths) for name, lengths in counts.items()})
    return offset


def _polygons(elements: dict[str, Element]) -> Polygons:
    vertex, face, strips = (elements.get(name, Element(name, 0)) for name in ("vertex", "face", "tristrips"))
    if not {"x", "y", "z"} <= {*vertex.columns}:
        raise ValueError("must have an element 'vertex' with x, y and z; export it again")
    coordinates = [vertex.columns[axis].astype(vertex.codes[axis][0]) for axis in "xyz"]  # text files have doubles
    counts, corners = face.indices()
    lengths, strip = strips.indices()
    cut = cut_strips(strip, lengths)
    return Polygons(
        np.stack(coordinates, axis=1).astype(np.float64),
        np.concatenate([counts, np.full(len(cut), 3)]),
        np.concatenate([corners, cut.ravel()]),
        vertex.colours,
        None if len(cut) else face.colours,
    )
