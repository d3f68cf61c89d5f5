"""The header of a PLY file: its elements and their properties, in file order.

References: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

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
}
_BYTE_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Property:
    name: str
    dtype: str  # numpy code without byte order
    is_list: bool = False


@dataclass(frozen=True)
class Element:
    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        return any(p.is_list for p in self.properties)

    def row_dtype(self, encoding: str) -> np.dtype:
        """One record with fields "0", "1", ...: an element that is only skipped may repeat a property's name."""
        return np.dtype([(f"{i}", _BYTE_ORDER[encoding] + p.dtype) for i, p in enumerate(self.properties)])


@dataclass(frozen=True)
class PlyHeader:
    encoding: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    n_bytes: int

    @property
    def before_vertices(self) -> tuple[Element, ...]:
        names = [e.name for e in self.elements]
        return self.elements[: names.index("vertex")]

    @property
    def vertex(self) -> Element:
        return next(e for e in self.elements if e.name == "vertex")


def _header_lines(stream: BinaryIO, where: str) -> Iterator[str]:
    """Each header line down to `end_header`."""
    n_bytes = 0
    while True:
        line = stream.readline(MAX_LINE_BYTES)
        n_bytes += len(line)
        if not line.endswith(b"\n") or n_bytes > MAX_HEADER_BYTES:
            allowed = f"at most {MAX_HEADER_BYTES} bytes, lines of at most {MAX_LINE_BYTES}, closed by end_header"
            raise InvalidScan(f"{where}:header", f"no end_header in the first {n_bytes} bytes", allowed)
        text = line.decode("utf-8", errors="replace").strip()
        yield text
        if text == "end_header":
            return


def _parse_property(words: list[str], where: str) -> Property:
    is_list = len(words) == 5 and words[1] == "list"
    types = words[2:4] if is_list else words[1:2]
    if len(words) != (5 if is_list else 3) or any(t not in _TYPES for t in types):
        raise InvalidScan(f"{where}:header", f"line {' '.join(words)!r}", f"property TYPE NAME, TYPE of {list(_TYPES)}")
    return Property(words[-1], _TYPES[types[-1]], is_list)


def _parse_element(words: list[str], where: str) -> tuple[str, int]:
    # int() also takes "-1", "1_0" and Arabic digits.
    if len(words) != 3 or not (words[2].isascii() and words[2].isdigit()):
        raise InvalidScan(f"{where}:header", f"line {' '.join(words)!r}", "element NAME COUNT")
    return words[1], int(words[2])


def parse_header(stream: BinaryIO, where: str) -> PlyHeader:
    """The header of a PLY, with the stream left at the first byte after it.

    Raises: InvalidScan for a header that breaks the format, naming the line.
    """
    if stream.read(3) != b"ply" or stream.readline(3).strip():
        raise InvalidScan(where, "no 'ply' in its first line", "a PLY file")
    encoding, comments, elements = "", [], []
    for line in _header_lines(stream, where):
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            comments += [line.partition(" ")[2]] if words else []
        elif words[0] == "format" and len(words) == 3 and words[1] in _BYTE_ORDER and words[2] == "1.0":
            encoding = words[1]
        elif words[0] == "element":
            elements.append((*_parse_element(words, where), []))
        elif words[0] == "property" and elements:
            elements[-1][2].append(_parse_property(words, where))
        elif words[0] != "end_header":
            allowed = f"format {'|'.join(_BYTE_ORDER)} 1.0, comment, obj_info, element, property, end_header"
            raise InvalidScan(f"{where}:header", f"line {line[:80]!r}", allowed)
    if not encoding:
        raise InvalidScan(f"{where}:header", "no format line", f"format {'|'.join(_BYTE_ORDER)} 1.0")
    return PlyHeader(encoding, tuple(Element(n, c, tuple(p)) for n, c, p in elements), tuple(comments), stream.tell())
