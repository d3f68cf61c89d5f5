"""PLY: the header first, then the vertices as a stream, from a file or from a member of an archive.

ASCII and both binary byte orders, scalar vertex properties of any type in any order, lists skipped. What properties
mean is told by pipeline/readers/attributes/names.py, what colours range over by pipeline/readers/ranges.py.

References: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import BinaryIO

import numpy as np

from pipeline.readers.attributes.decisions import Decision, probe_starts
from pipeline.readers.attributes.looks import Look, Looks
from pipeline.readers.attributes.named import Named, is_nowhere
from pipeline.readers.attributes.names import Columns, columns_of
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.ply.header import PlyHeader, parse_header
from pipeline.readers.ply.rows import Rows, ascii_rows, binary_rows
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan

_POSITION = ("x", "y", "z")
_FIRST_POINTS = 1 << 14  # that are looked at where reading further means reading all before
MOST_AT_ONCE = 1 << 14
_N_FEW, _FEW = 4, 128  # runs, and points of each, where only their places say something

Opener = Callable[[], AbstractContextManager[BinaryIO]]


@dataclass(frozen=True)
class Vertices:
    """The vertices of an opened PLY, and how their attributes are used."""

    opener: Opener
    where: str
    header: PlyHeader
    named: Named
    look: Look
    decision: Decision
    own_warnings: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        return self.header.vertex.count

    @property
    def columns(self) -> Columns:
        return self.named.columns

    @property
    def has_colors(self) -> bool:
        return self.named.has_colors(self.decision)

    @property
    def warnings(self) -> tuple[str, ...]:
        of_look = self.named.reasons(self.where, self.look, self.decision, self.count)
        return (*self.own_warnings, *of_look)

    @property
    def position_type(self) -> str:
        kinds = {p.dtype for p in self.header.vertex.properties if p.name in self.columns.position}
        return "float32" if kinds & {"f4", "f2"} and self.header.encoding != "ascii" else "float64"

    @property
    def is_single(self) -> bool:
        kinds = {p.dtype for p in self.header.vertex.properties if p.name in self.columns.position}
        return kinds <= {"f4", "f2"} and self.header.encoding != "ascii"

    @property
    def is_sample(self) -> bool:
        return self.look.n_points < self.count

    @property
    def has_slices(self) -> bool:
        """Whether rows can be read without those before them."""
        return self.header.encoding != "ascii" and not self.header.vertex.has_lists

    def pieces(self, max_points: int) -> Iterator[Piece]:
        """The vertices in file order, at most `max_points` a piece."""
        return self.slice(0, self.count, max_points)

    def slice(self, first: int, stop: int, max_points: int) -> Iterator[Piece]:
        """Vertices first..stop, of a file that has no slices from 0 on, `at_once(max_points)` a piece."""
        max_points = at_once(max_points)
        with self.opener() as stream:
            for rows in _rows(stream, self.header, self.where, max_points, (first, stop - first), in_place=True):
                look = self.look.like() if self.is_sample else None
                piece = self.named.piece(_named(rows, self.header), self.decision, look)
                yield piece if look is None else replace(piece, look=(0, look))

    def settled(self, looks: Looks) -> Vertices | None:
        """As all points have it; None where that is as it is."""
        look = looks.parts[0]
        decision = self.named.decide(look)
        return None if decision == self.decision else replace(self, look=look, decision=decision)


# --- header ---


def _check_elements(header: PlyHeader, columns: Columns, where: str) -> None:
    properties = [p.name for p in header.vertex.properties]
    for name in (*columns.position, *columns.normal, *columns.color, *columns.intensity):
        if properties.count(name) > 1:
            raise InvalidScan(f"{where}:vertex.{name}", "a property that occurs twice", "every property once")
    if not columns.position:
        missing = next((name for name in _POSITION if name not in properties), "x")
        raise InvalidScan(f"{where}:vertex.{missing}", "missing", "x, y and z", f"found {properties}")
    types = {p.dtype for p in header.vertex.properties if p.name in columns.color}
    if len(types) > 1:
        raise InvalidScan(f"{where}:vertex.{columns.color[0]}", f"colours of types {sorted(types)}", "one type for all")


def _check_length(header: PlyHeader, n_bytes: int, where: str) -> tuple[str, ...]:
    """Refuses a file that cannot hold what its header promises; returns warnings."""
    vertex = header.vertex
    if header.encoding == "ascii":
        # a digit and a space or line end for each value; the last line end may be missing
        needed = header.n_bytes + 2 * vertex.count * len(vertex.properties) - 1
    else:
        before = sum(e.count * e.least_row_bytes for e in header.before_vertices)
        needed = header.n_bytes + before + vertex.count * vertex.least_row_bytes
    if n_bytes < needed:
        found = f"{vertex.count} vertices promised, which need {needed} bytes or more, in a file of {n_bytes}"
        raise InvalidScan(f"{where}:vertex", found, "a whole file", "the file may be truncated")
    has_lists = any(e.has_lists for e in header.elements)
    if n_bytes > needed and header.encoding != "ascii" and header.elements[-1] is vertex and not has_lists:
        return (f"{where}: {n_bytes - needed} bytes after the last vertex are ignored",)
    return ()


def _color_type(header: PlyHeader, columns: Columns) -> str:
    return next((p.dtype for p in header.vertex.properties if p.name in columns.color), "f8")


# --- vertices ---


def at_once(max_points: int) -> int:
    """Points a piece: of 2^18, new memory took three times as long as reading (2.7 us each 4 kB of a virtual machine)."""
    return min(max_points, MOST_AT_ONCE)


def _rows(
    stream: BinaryIO, header: PlyHeader, where: str, max_points: int, run: tuple[int, int], in_place: bool = False
) -> Iterator[Rows]:
    first, n = run
    if header.encoding == "ascii":
        return ascii_rows(stream, header, where, max_points, n)
    return binary_rows(stream, header, where, max_points, first, n, in_place)


def _named(rows: Rows, header: PlyHeader) -> dict[str, np.ndarray]:
    return {p.name: rows[i] for i, p in enumerate(header.vertex.properties) if i in rows}


# --- public ---


def open_vertices(
    opener: Opener, n_bytes: int, where: str, can_seek: bool = True, left_out: frozenset[str] = frozenset()
) -> Vertices:
    """The checked header of a PLY of `n_bytes` behind `opener`, which may be called again and again.

    Guarantees: of a large file a few runs of points are read, of one without `can_seek` the first points; a file
    shorter than its header promises is refused here.
    Raises: InvalidScan.
    """
    with opener() as stream:
        header = parse_header(stream, where)
        names = [e.name for e in header.elements]
        if names.count("vertex") != 1:
            raise InvalidScan(f"{where}:header", f"elements {names[:20]}", "one element named vertex")
        columns = columns_of(p.name for p in header.vertex.properties if not p.is_list)
        _check_elements(header, columns, where)
        warnings = _check_length(header, n_bytes, where)
        named, look, n = Named(columns, _color_type(header, columns), left_out=left_out), Look(), header.vertex.count
        blocks = list(_first_rows(stream, header, where, bool(columns.color or columns.intensity), can_seek))
        named = replace(named, origin_is_nowhere=is_nowhere(blocks, columns))
        for rows in blocks if columns.color or columns.intensity else ():
            named.look_at(look, rows)
    if not (columns.color or columns.intensity):
        look.n_points = n
    return Vertices(opener, where, header, named, look, named.decide(look), warnings)


def _first_rows(
    stream: BinaryIO, header: PlyHeader, where: str, has_looks: bool, can_seek: bool
) -> Iterator[dict[str, np.ndarray]]:
    """Rows that are looked at: of attributes many, of mere positions a few."""
    n, most = header.vertex.count, _FIRST_POINTS if has_looks else _FEW
    runs = [(0, min(n, most))]
    if can_seek and header.encoding != "ascii" and not any(e.has_lists for e in header.elements):
        step = max(_FEW, -(-n // _N_FEW))
        runs = probe_starts(n) if has_looks else [(at, min(_FEW, n - at)) for at in range(0, n, step)]
    for run in runs:
        for rows in _rows(stream, header, where, most, run):
            yield _named(rows, header)


def unused_properties(vertices: Vertices) -> tuple[str, ...]:
    """Those of the file that are not used, lists among them."""
    lists = tuple(p.name for p in vertices.header.vertex.properties if p.is_list)
    return (*vertices.columns.unused, *lists)


def open_ply(path: str, options: ReadOptions = ReadOptions()) -> ScanSource:
    """A PLY file as a scan without cameras. Raises: InvalidScan."""
    opener = partial(open, path, "rb")
    return _source(path, options, open_vertices(opener, os.path.getsize(path), path, left_out=options.left_out))  # type: ignore[arg-type]


def _source(path: str, options: ReadOptions, vertices: Vertices) -> ScanSource:
    header = vertices.header
    return ScanSource(
        path=path,
        format="ply",
        n_points=vertices.count,
        pieces=vertices.pieces,
        read_slice=vertices.slice if vertices.has_slices else None,
        settle=partial(_settled, path, options, vertices) if vertices.is_sample else None,
        has_normals=bool(vertices.columns.normal),
        has_colors=vertices.has_colors,
        has_intensity=vertices.decision.intensity,
        position_type=vertices.position_type,
        is_single=vertices.is_single,
        warnings=vertices.warnings,
        unused=unused_properties(vertices),
        details={
            "encoding": header.encoding,
            "comments": list(header.comments),
            "elements": {e.name: e.count for e in header.elements},
            "properties": [p.name for p in header.vertex.properties],
        },
    )


def _settled(path: str, options: ReadOptions, vertices: Vertices, looks: Looks) -> ScanSource | None:
    settled = vertices.settled(looks)
    return settled and _source(path, options, settled)  # type: ignore[return-value]
