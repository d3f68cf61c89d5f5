"""PLY: the header first, then the vertices as a stream, from a file or from a member of an archive.

ASCII and both binary byte orders, scalar vertex properties of any type in any order. Positions are `x y z`, normals
`nx ny nz`, colours `red green blue` or `diffuse_red ...`; other properties are skipped. An element that holds lists
can be skipped when it stands after the vertices, not before them.

References: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import BinaryIO

import numpy as np

from pipeline.readers.ply.header import MAX_LINE_BYTES, Element, PlyHeader, parse_header
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, UnsupportedScan

_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_INTENSITY = ("intensity", "scalar_intensity", "scalar_Intensity")  # the latter two are CloudCompare's

Opener = Callable[[], AbstractContextManager[BinaryIO]]


@dataclass(frozen=True)
class Vertices:
    """The vertices of an opened PLY, not yet read. `columns` maps what a Piece holds to property names."""

    opener: Opener
    where: str
    header: PlyHeader
    columns: dict[str, tuple[str, ...]]
    warnings: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        return self.header.vertex.count

    @property
    def has_slices(self) -> bool:
        """Whether rows can be read without those before them."""
        return self.header.encoding != "ascii"

    def pieces(self, max_points: int) -> Iterator[Piece]:
        """The vertices in file order, at most `max_points` a piece."""
        read_rows = (
            _ascii_rows(self, max_points)
            if self.header.encoding == "ascii"
            else _binary_rows(self, 0, self.count, max_points)
        )
        return self._pieces(0, read_rows)

    def slice(self, first: int, stop: int, max_points: int) -> Iterator[Piece]:
        """Vertices first..stop of a binary file, at most `max_points` a piece."""
        return self._pieces(first, _binary_rows(self, first, stop, max_points))

    def _pieces(self, first: int, read_rows: Iterator[dict[str, np.ndarray]]) -> Iterator[Piece]:
        for rows in read_rows:
            yield _piece(self, rows, first)
            first += len(next(iter(rows.values())))


def _check_elements(header: PlyHeader, where: str) -> None:
    names = [e.name for e in header.elements]
    if names.count("vertex") != 1:
        raise InvalidScan(f"{where}:header", f"elements {names}", "one element named vertex")
    properties = [p.name for p in header.vertex.properties]
    for name in properties:
        if properties.count(name) > 1:
            raise InvalidScan(f"{where}:vertex.{name}", "a property that occurs twice", "every property once")
    for name in _POSITION:
        if name not in properties:
            raise InvalidScan(f"{where}:vertex.{name}", "missing", "x, y and z", f"found {properties}")
    for names in _COLORS:
        types = {p.dtype for p in header.vertex.properties if p.name in names}
        if len(types) > 1:
            raise InvalidScan(f"{where}:vertex.{names[0]}", f"colours of types {sorted(types)}", "one type for all")
    for p in header.vertex.properties:
        if p.is_list:
            raise UnsupportedScan(f"{where}:vertex.{p.name}", "a list in every vertex", "scalar vertex properties")
    for e in header.before_vertices:
        if e.has_lists and e.count and header.encoding != "ascii":
            hint = "write the vertices first"
            raise UnsupportedScan(f"{where}:{e.name}", "lists before the vertices", "scalars before them", hint)


def _start_of_vertices(header: PlyHeader) -> int:
    skipped = (e.count * e.row_dtype(header.encoding).itemsize for e in header.before_vertices if e.count)
    return header.n_bytes + sum(skipped)


def _check_length(header: PlyHeader, n_bytes: int, where: str) -> tuple[str, ...]:
    """Refuses a file that cannot hold what its header promises; returns warnings."""
    vertex = header.vertex
    if header.encoding == "ascii":
        # a digit and a space or line end for each value; the last line end may be missing
        needed = header.n_bytes + 2 * vertex.count * len(vertex.properties) - 1
    else:
        needed = _start_of_vertices(header) + vertex.count * vertex.row_dtype(header.encoding).itemsize
    if n_bytes < needed:
        found = f"{vertex.count} vertices promised, which need {needed} bytes or more, in a file of {n_bytes}"
        raise InvalidScan(f"{where}:vertex", found, "a whole file", "the file may be truncated")
    if n_bytes > needed and header.encoding != "ascii" and header.elements[-1] is vertex:
        return (f"{where}: {n_bytes - needed} bytes after the last vertex are ignored",)
    return ()


def _columns(vertex: Element) -> dict[str, tuple[str, ...]]:
    present = {p.name for p in vertex.properties}
    columns = {"position": _POSITION}
    if present.issuperset(_NORMAL):
        columns["normal"] = _NORMAL
    for names in reversed(_COLORS):
        if present.issuperset(names):
            columns["color"] = names
    # Stanford's range scans carry `intensity` beside `confidence`; it is no brightness that one would want to see.
    for name in reversed(_INTENSITY if "confidence" not in present else ()):
        if name in present:
            columns["intensity"] = (name,)
    return columns


# --- vertices ---


def _binary_rows(vertices: Vertices, begin: int, stop: int, max_points: int) -> Iterator[dict[str, np.ndarray]]:
    header, where = vertices.header, vertices.where
    start, dtype = _start_of_vertices(header), header.vertex.row_dtype(header.encoding)
    with vertices.opener() as stream:
        stream.seek(start + begin * dtype.itemsize)
        for first in range(begin, stop, max_points):
            n = min(max_points, stop - first)
            block = stream.read(n * dtype.itemsize)
            if len(block) < n * dtype.itemsize:
                end = start + first * dtype.itemsize + len(block)
                raise InvalidScan(f"{where}:vertex", f"the data ends at byte {end}", f"{vertices.count} vertices")
            rows = np.frombuffer(block, dtype)
            yield {p.name: rows[f"{i}"] for i, p in enumerate(header.vertex.properties)}


def _ascii_lines(stream: BinaryIO, n: int) -> list[str]:
    lines = islice(iter(partial(stream.readline, MAX_LINE_BYTES), b""), n)
    return [line.decode("ascii", errors="replace") for line in lines]


def _ascii_rows(vertices: Vertices, max_points: int) -> Iterator[dict[str, np.ndarray]]:
    header, where = vertices.header, f"{vertices.where}:vertex"
    names = [p.name for p in header.vertex.properties]
    with vertices.opener() as stream:
        stream.seek(header.n_bytes)
        for _ in range(sum(e.count for e in header.before_vertices)):
            stream.readline(MAX_LINE_BYTES)
        for first in range(0, vertices.count, max_points):
            n = min(max_points, vertices.count - first)
            lines = _ascii_lines(stream, n)
            if len(lines) < n:
                found = f"the data ends after {first + len(lines)} vertices"
                raise InvalidScan(where, found, f"{vertices.count} vertices")
            values = _parse_rows(lines, len(names), first, where)
            yield dict(zip(names, values.T, strict=True))


def _plain_numbers(line: str) -> str:
    """The line with what Microsoft's C libraries print for NaN and infinity as others print it."""
    if "#" not in line and "(" not in line:
        return line
    return re.sub(r"(-?)(?:1\.#INF|inf\(?)\S*", r"\1inf", re.sub(r"-?(?:1\.#(?:QNAN|SNAN|IND)|nan\()\S*", "nan", line))


def _parse_rows(lines: list[str], n_columns: int, first: int, where: str) -> np.ndarray:  # (n, n_columns)
    try:
        values = np.loadtxt(map(_plain_numbers, lines), dtype=np.float64, comments=None, ndmin=2)
    except ValueError:
        values = None
    if values is not None and values.shape == (len(lines), n_columns):
        return values
    for i, line in enumerate(lines):
        try:
            n_found = len([float(word) for word in _plain_numbers(line).split()])
        except ValueError:
            n_found = -1
        if n_found != n_columns:
            raise InvalidScan(f"{where} {first + i}", f"line {line.strip()[:80]!r}", f"{n_columns} numbers")
    raise InvalidScan(where, f"rows {first} to {first + len(lines) - 1} are not numbers", f"{n_columns} numbers a line")


def _to_8_bit(values: np.ndarray, dtype: str, where: str, first: int) -> np.ndarray:  # (n, 3) uint8
    """Colours as 8 bits: floats are 0 to 1, 16 bits are scaled, other integers are taken as they are. NaN is black."""
    is_float = dtype.startswith("f")
    top = 1.0 if is_float else 65535 if dtype == "u2" else 255
    scaled = np.rint(np.where(np.isnan(values) & is_float, 0, values) * (255 / top))  # beyond 1 by rounding is 255
    wrong = ~((scaled >= 0) & (scaled <= 255))
    if wrong.any():
        row, channel = np.argwhere(wrong)[0]
        found = f"a colour of {values[row, channel]}"
        hint = "write colours of 0 to 255 as uchar" if is_float else ""
        raise InvalidScan(f"{where} {first + row}", found, f"0 to {top} in type {dtype}", hint)
    return scaled.astype(np.uint8)


def _piece(vertices: Vertices, rows: dict[str, np.ndarray], first: int) -> Piece:
    def stack(key: str, dtype: type | None = None) -> np.ndarray | None:
        names = vertices.columns.get(key)
        return None if names is None else np.stack([rows[n] for n in names], axis=1).astype(dtype)

    color, colorless = stack("color", np.float64), None
    if color is not None:
        declared = next(p.dtype for p in vertices.header.vertex.properties if p.name == vertices.columns["color"][0])
        colorless = np.isnan(color).any(axis=1) if declared.startswith("f") else None
        color = _to_8_bit(color, declared, f"{vertices.where}:vertex", first)
    intensity = stack("intensity", np.float32)
    return Piece(
        position=stack("position", np.float64),
        normal=stack("normal", np.float32),
        color=color,
        colorless=colorless,
        intensity=None if intensity is None else intensity[:, 0],
    )


# --- public ---


def open_vertices(opener: Opener, n_bytes: int, where: str) -> Vertices:
    """The checked header of a PLY of `n_bytes` behind `opener`, which may be called again and again.

    Guarantees: reads the header alone; a file shorter than its header promises is refused here.
    Raises: InvalidScan, UnsupportedScan.
    """
    with opener() as stream:
        header = parse_header(stream, where)
    _check_elements(header, where)
    warnings = _check_length(header, n_bytes, where)
    return Vertices(opener, where, header, _columns(header.vertex), warnings)


def open_ply(path: str) -> ScanSource:
    """A PLY file as a scan without cameras. Raises: InvalidScan, UnsupportedScan."""
    vertices = open_vertices(partial(open, path, "rb"), os.path.getsize(path), path)
    header = vertices.header
    return ScanSource(
        path=path,
        format="ply",
        n_points=vertices.count,
        pieces=vertices.pieces,
        read_slice=vertices.slice if vertices.has_slices else None,
        has_normals="normal" in vertices.columns,
        has_colors="color" in vertices.columns,
        has_intensity="intensity" in vertices.columns,
        warnings=vertices.warnings,
        details={
            "encoding": header.encoding,
            "comments": list(header.comments),
            "elements": {e.name: e.count for e in header.elements},
            "properties": [p.name for p in header.vertex.properties],
        },
    )
