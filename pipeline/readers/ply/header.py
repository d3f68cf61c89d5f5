"""The header of a PLY file: its elements and their properties, in file order.

Lines may end with LF, CR LF, CR or LF CR; a byte order mark of UTF-8 may stand before text. Where the data begins after `end_header` is told from how the first line ends.

References: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from storage.errors import InvalidScan

MAX_HEADER_BYTES = 1 << 20
MAX_LINE_BYTES = 1 << 16

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float": "f4",
    "double": "f8",
    "float32": "f4",
    "float64": "f8",
    "int64": "i8",
    "uint64": "u8",
    "long": "i8",
    "ulong": "u8",
}
_BYTE_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_BOM = b"\xef\xbb\xbf"
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
_BINARY = re.compile(rb"[\r\n][ \t]*format[ \t]+binary")
_SAVED = "a text editor saved it anew; export it again"
_LINE_END = re.compile(rb"\r\n|\n\r|\r|\n")
END = re.compile(rb"(?:^|[\r\n])[ \t]*end_header[ \t]*(?=[\r\n])")


@dataclass(frozen=True)
class Property:
    """A property of a PLY element: a scalar, or a list with its count."""

    name: str
    dtype: str  # numpy code without byte order; of a list, that of its items
    count_dtype: str = ""  # of a list, that of its length; "" for a scalar

    @property
    def is_list(self) -> bool:
        return bool(self.count_dtype)


@dataclass(frozen=True)
class Element:
    """An element of a PLY file: so many rows of the same properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(p.is_list for p in self.properties)

    @property
    def least_row_bytes(self) -> int:
        """Of a binary record whose lists are empty."""
        return sum(int((p.count_dtype or p.dtype)[1:]) for p in self.properties)

    def row_dtype(self, encoding: str) -> np.dtype:
        """One record without lists, with fields "0", "1", ...: an element that is only skipped may repeat a property's name."""
        scalars = [(f"{i}", p) for i, p in enumerate(self.properties) if not p.is_list]
        return np.dtype([(name, _BYTE_ORDER[encoding] + p.dtype) for name, p in scalars])


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file, and where its rows begin."""

    encoding: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    n_bytes: int
    n_lines: int

    @property
    def before_vertices(self) -> tuple[Element, ...]:
        names = [e.name for e in self.elements]
        return self.elements[: names.index("vertex")]

    @property
    def vertex(self) -> Element:
        return next(e for e in self.elements if e.name == "vertex")

    @property
    def byte_order(self) -> str:
        return _BYTE_ORDER[self.encoding]


def _header_bytes(stream: BinaryIO, where: str) -> tuple[bytes, int]:
    """The header without the end of its last line, and where the data begins."""
    head, n_before = stream.read(3), 0
    if head.startswith(_UTF_16):
        raise InvalidScan(where, "text in UTF-16", "a PLY file in ASCII, or a binary one", _SAVED)
    if head == _BOM:
        head, n_before = stream.read(3), len(_BOM)
    if head != b"ply":
        raise InvalidScan(where, f"no 'ply' in its first line, which begins with {head!r}", "a PLY file")
    while not (end := END.search(head)) and len(head) <= MAX_HEADER_BYTES:
        block = stream.read(4096)
        if not block:
            break
        head += block
    first = _LINE_END.search(head)
    if first is None or head[3 : first.start()].strip():
        raise InvalidScan(where, "no 'ply' in its first line", "a PLY file")
    if not end or end.end() > MAX_HEADER_BYTES:
        allowed = f"at most {MAX_HEADER_BYTES} bytes, lines of at most {MAX_LINE_BYTES}, closed by end_header"
        raise InvalidScan(f"{where}:header", f"no end_header in the first {len(head)} bytes", allowed)
    if n_before and _BINARY.search(head[: end.end()]):
        found = "a byte order mark of UTF-8 before a header of binary data"
        raise InvalidScan(where, found, "a binary PLY file as it was written", _SAVED)
    after = (head + stream.read(2))[end.end() : end.end() + 2]
    # A CR alone, or a LF alone, ends the line unless the file's own line ends have two characters.
    n_end = 2 if after in (b"\r\n", b"\n\r") and (after == b"\r\n" and first[0] != b"\r" or after == first[0]) else 1
    return head[: end.end()], n_before + end.end() + n_end


def _lines(head: bytes, where: str) -> Iterator[str]:
    for line in _LINE_END.split(head)[1:]:
        if len(line) > MAX_LINE_BYTES:
            raise InvalidScan(f"{where}:header", f"a line of {len(line)} bytes", f"lines of at most {MAX_LINE_BYTES}")
        yield line.decode("utf-8", errors="replace").strip()


def _parse_property(words: list[str], where: str) -> Property:
    is_list = len(words) == 5 and words[1] == "list"
    types = words[2:4] if is_list else words[1:2]
    if len(words) != (5 if is_list else 3) or any(t not in _TYPES for t in types):
        raise InvalidScan(f"{where}", f"line {' '.join(words)[:80]!r}", f"property TYPE NAME, TYPE of {list(_TYPES)}")
    if is_list and _TYPES[types[0]].startswith("f"):
        raise InvalidScan(f"{where}", f"a list whose length is of type {types[0]}", "a whole number")
    return Property(words[-1], _TYPES[types[-1]], _TYPES[types[0]] if is_list else "")


def _parse_element(words: list[str], where: str) -> tuple[str, int]:
    # int() also takes "-1", "1_0" and Arabic digits.
    if len(words) != 3 or not (words[2].isascii() and words[2].isdigit() and len(words[2]) < 19):
        raise InvalidScan(f"{where}", f"line {' '.join(words)[:80]!r}", "element NAME COUNT")
    return words[1], int(words[2])


def parse_header(stream: BinaryIO, where: str) -> PlyHeader:
    """The header of a PLY, with the stream left at the first byte after it.

    Raises: InvalidScan for a header that breaks the format, naming the line.
    """
    head, n_bytes = _header_bytes(stream, where)
    comments: list[str] = []
    elements: list = []
    encoding, number = "", 1
    for number, line in enumerate(_lines(head, where), 2):
        words, at = line.split(), f"{where}:header line {number}"
        if not words or words[0] in ("comment", "obj_info"):
            comments += [line.partition(" ")[2]] if words else []
        elif words[0] == "format" and len(words) == 3 and words[1] in _BYTE_ORDER and words[2] == "1.0":
            encoding = words[1]
        elif words[0] == "element":
            elements.append((*_parse_element(words, at), []))
        elif words[0] == "property" and elements:
            elements[-1][2].append(_parse_property(words, at))
        elif words[0] != "end_header":
            allowed = f"format {'|'.join(_BYTE_ORDER)} 1.0, comment, obj_info, element, property, end_header"
            raise InvalidScan(at, f"line {line[:80]!r}", allowed)
    if not encoding:
        raise InvalidScan(f"{where}:header", "no format line", f"format {'|'.join(_BYTE_ORDER)} 1.0")
    stream.seek(n_bytes)
    made = tuple(Element(n, c, tuple(p)) for n, c, p in elements)
    return PlyHeader(encoding, made, tuple(comments), n_bytes, number)
