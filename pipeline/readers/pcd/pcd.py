"""PCD, PCL's point clouds: ASCII, binary, and packed by LZF; colours as packed numbers or as columns.

References: PCL, "The PCD (Point Cloud Data) file format", version 0.7.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import numpy as np

from pipeline.readers.attributes.decisions import Decision, probe_starts
from pipeline.readers.attributes.looks import Look, Looks
from pipeline.readers.attributes.named import Named, Rows, is_nowhere
from pipeline.readers.attributes.names import columns_of
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.pcd.lzf import unpack
from pipeline.readers.ply.rows import parse_rows
from pipeline.readers.text.lines import numbered_lines
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan

MAX_HEADER_BYTES = 1 << 16
FIRST_POINTS = 1 << 14

_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_DATA = ("ascii", "binary", "binary_compressed")
_PACKED = ("rgb", "rgba")  # of 4 bytes: alpha, red, green, blue from the highest
_COLORS = ("red", "green", "blue")
_NO_VIEWPOINT = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]


@dataclass(frozen=True)
class _Header:
    path: str
    fields: tuple[tuple[str, str, int], ...]  # name, numpy code, count
    n_points: int
    is_organised: bool
    viewpoint: tuple[float, ...]
    data: str
    data_at: int
    n_lines: int

    @property
    def dtype(self) -> np.dtype:
        return np.dtype([(f"{i}", f"<{code}", (count,)) for i, (_, code, count) in enumerate(self.fields)])

    @property
    def packed(self) -> int | None:
        """The field of packed colours."""
        return next((i for i, f in enumerate(self.fields) if f[0].lower() in _PACKED and f[1][1:] == "4"), None)


def _numbers(words: list[str], where: str, kind: type = int) -> list:
    try:
        return [kind(word) for word in words]
    except ValueError:
        raise InvalidScan(where, f"{' '.join(words)[:60]!r}", "numbers") from None


def read_header(path: str) -> _Header:
    """Raises: InvalidScan naming the line, or where the file cannot hold what it promises."""
    with open(path, "rb") as stream:
        head = stream.read(MAX_HEADER_BYTES)
    found, at, n_lines = {}, 0, 0
    while "DATA" not in found:
        end = head.find(b"\n", at)
        if end < 0:
            raise InvalidScan(f"{path}:header", f"no DATA in the first {len(head)} bytes", "a PCD header")
        words, n_lines = head[at:end].decode("ascii", "replace").split(), n_lines + 1
        at = end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYS:
            raise InvalidScan(f"{path}:line {n_lines}", f"{' '.join(words)[:60]!r}", ", ".join(_KEYS))
        found[words[0]] = words[1:]
    if missing := [k for k in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT") if not found.get(k)]:
        raise InvalidScan(f"{path}:header", f"no {missing[0]}", "a PCD header")
    return _checked(path, found, at, n_lines)


def _checked(path: str, found: dict[str, list[str]], at: int, n_lines: int) -> _Header:
    where, names = f"{path}:header", found["FIELDS"]
    sizes, counts = _numbers(found["SIZE"], where), _numbers(found.get("COUNT", ["1"] * len(names)), where)
    kinds = found["TYPE"]
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise InvalidScan(where, f"{len(names)} fields, {len(sizes)} sizes, {len(kinds)} types", "one of each a field")
    codes = [f"{kind.lower()}{size}" for kind, size in zip(kinds, sizes, strict=True)]
    allowed = [f"{k}{n}" for k in "iu" for n in (1, 2, 4, 8)] + ["f4", "f8"]
    if any(c not in allowed for c in codes) or min(counts) < 0 or max(counts) > 1 << 16:
        raise InvalidScan(where, f"types {codes} of {counts} values", f"{allowed}")
    width, height = _numbers(found["WIDTH"][:1] + found["HEIGHT"][:1], where)
    n_points = _numbers(found["POINTS"][:1], where)[0] if found.get("POINTS") else width * height
    viewpoint = _numbers(found.get("VIEWPOINT") or list(map(str, _NO_VIEWPOINT)), where, float)
    data = found["DATA"][0] if found["DATA"] else ""
    if data not in _DATA or n_points < 0 or len(viewpoint) != 7 or not np.isfinite(viewpoint).all():
        raise InvalidScan(where, f"DATA {data!r}, {n_points} points, viewpoint {viewpoint}", f"DATA {', '.join(_DATA)}")
    fields = tuple((n, c, k) for n, c, k in zip(names, codes, counts, strict=True) if k)
    header = _Header(path, fields, n_points, height > 1, tuple(viewpoint), data, at, n_lines)
    n_bytes = os.path.getsize(path)
    least = 2 * sum(c for *_, c in fields) - 1 if data == "ascii" else header.dtype.itemsize
    needed = at + n_points * least if data != "binary_compressed" else at + 8
    if n_bytes < needed:
        found_ = f"{n_points} points promised, which need {needed} bytes, in a file of {n_bytes}"
        raise InvalidScan(f"{path}:POINTS", found_, "a whole file", "the file may be truncated")
    return header


# --- points ---


def _unpacked(header: _Header) -> np.ndarray:
    """The points of a packed file, (n,) records: it holds one field after the other."""
    with open(header.path, "rb") as stream:
        stream.seek(header.data_at)
        n_packed, n_bytes = np.frombuffer(stream.read(8), "<u4").tolist()
        packed = np.frombuffer(stream.read(n_packed), np.uint8)
    wanted = header.n_points * header.dtype.itemsize
    if n_bytes != wanted or len(packed) < n_packed:
        found = f"{n_packed} packed bytes, of which {len(packed)} are there, that unpack to {n_bytes}"
        raise InvalidScan(f"{header.path}:DATA", found, f"{wanted} for {header.n_points} points")
    data = unpack(packed, n_bytes)
    if data is None:
        raise InvalidScan(f"{header.path}:DATA", "bytes that do not unpack", "LZF", "the file may be damaged")
    records, at = np.empty(header.n_points, header.dtype), 0
    for name in header.dtype.names:
        kind, shape = header.dtype[name].subdtype
        size = kind.itemsize * shape[0] * header.n_points
        records[name] = data[at : at + size].view(kind).reshape(header.n_points, *shape)
        at += size
    return records


def _records(header: _Header, first: int, stop: int, max_points: int) -> Iterator[np.ndarray]:
    if header.data == "ascii":
        yield from _ascii(header, stop, max_points)
        return
    if header.data == "binary_compressed":
        whole = _unpacked(header)
        for at in range(first, stop, max_points):
            yield whole[at : min(stop, at + max_points)]
        return
    with open(header.path, "rb") as stream:
        stream.seek(header.data_at + first * header.dtype.itemsize)
        for at in range(first, stop, max_points):
            records = np.fromfile(stream, header.dtype, min(max_points, stop - at))
            if len(records) < min(max_points, stop - at):
                raise InvalidScan(f"{header.path}:DATA", f"the data ends after {at + len(records)} points", "all")
            yield records


def _ascii(header: _Header, stop: int, max_points: int) -> Iterator[np.ndarray]:
    n_columns = sum(count for *_, count in header.fields)
    with open(header.path, "rb") as stream:
        lines = ((n, line) for n, line in numbered_lines(stream) if n > header.n_lines)
        for at in range(0, stop, max_points):
            block = list(islice(lines, min(max_points, stop - at)))
            if len(block) < min(max_points, stop - at):
                raise InvalidScan(f"{header.path}:DATA", f"the data ends after {at + len(block)} points", "all")
            values, column = parse_rows(block, n_columns, header.path), 0
            records = np.empty(len(block), header.dtype)
            for i, (_, code, count) in enumerate(header.fields):
                part = values[:, column : column + count]
                # A float of packed colours is written as that float.
                with np.errstate(invalid="ignore", over="ignore"):
                    records[f"{i}"] = part.astype(code)
                column += count
            yield records


def _rows(header: _Header, records: np.ndarray) -> Rows:
    rows = {
        name if count == 1 else f"{name} {j}": records[f"{i}"][:, j]
        for i, (name, _, count) in enumerate(header.fields)
        for j in range(min(count, 4))
        if i != header.packed
    }
    if header.packed is not None:
        bits = np.ascontiguousarray(records[f"{header.packed}"][:, 0]).view("<u4")
        rows |= {c: (bits >> np.uint32(16 - 8 * k)).astype(np.uint8) for k, c in enumerate(_COLORS)}
    return rows


# --- opening ---


@dataclass(frozen=True)
class _Opened:
    header: _Header
    options: ReadOptions
    named: Named
    look: Look

    @property
    def decision(self) -> Decision:
        return self.named.decide(self.look)

    @property
    def station(self) -> tuple[float, float, float] | None:
        """Where the sensor stood: the viewpoint, or the origin of what has rows and columns."""
        viewpoint = list(self.header.viewpoint)
        has = self.header.is_organised or viewpoint != _NO_VIEWPOINT
        return (viewpoint[0], viewpoint[1], viewpoint[2]) if has else None


def open_pcd(path: str, options: ReadOptions = ReadOptions()) -> ScanSource:
    """A PCD file. Raises: InvalidScan."""
    header = read_header(path)
    empty = _rows(header, np.empty(0, header.dtype))
    columns = columns_of(empty)
    if not columns.position:
        raise InvalidScan(f"{path}:FIELDS", f"{[f[0] for f in header.fields]}", "x, y and z")
    color = columns.color[0] if columns.color else None
    kind = empty[color].dtype.str[1:] if color else "f8"
    runs = probe_starts(header.n_points) if header.data == "binary" else [(0, min(header.n_points, FIRST_POINTS))]
    seen = (records for start, n in runs for records in _records(header, start, start + n, FIRST_POINTS))
    blocks = [_rows(header, records) for records in seen]
    named, look = Named(columns, kind, is_nowhere(blocks, columns), options.left_out), Look()
    for rows in blocks:
        named.look_at(look, rows)
    return _source(_Opened(header, options, named, look))


def _slice(opened: _Opened, first: int, stop: int, max_points: int) -> Iterator[Piece]:
    is_sample = opened.look.n_points < opened.header.n_points
    for records in _records(opened.header, first, stop, max_points):
        rows, look = _rows(opened.header, records), None
        if is_sample:
            look = opened.look.like()
            opened.named.look_at(look, rows)
        piece = opened.named.piece(rows, opened.decision)
        station = None if opened.station is None else np.zeros(len(records), np.int32)
        yield replace(piece, station=station, look=None if look is None else (0, look))


def _pieces(opened: _Opened, max_points: int) -> Iterator[Piece]:
    return _slice(opened, 0, opened.header.n_points, max_points)


def _source(opened: _Opened) -> ScanSource:
    header, decision = opened.header, opened.decision
    types = {code for name, code, _ in header.fields if name in opened.named.columns.position}
    return ScanSource(
        path=header.path,
        format="pcd",
        n_points=header.n_points,
        pieces=partial(_pieces, opened),
        read_slice=partial(_slice, opened) if header.data == "binary" else None,
        settle=partial(_settled, opened) if opened.look.n_points < header.n_points else None,
        stations=() if opened.station is None else (opened.station,),
        has_normals=bool(opened.named.columns.normal),
        has_colors=opened.named.has_colors(decision),
        has_intensity=decision.intensity,
        position_type="float32" if "f4" in types else "float64",
        is_single=types == {"f4"} and header.data != "ascii",
        warnings=tuple(opened.named.reasons(header.path, opened.look, decision, header.n_points)),
        unused=opened.named.columns.unused,
        details={"data": header.data, "fields": [f[0] for f in header.fields], "viewpoint": list(header.viewpoint)},
    )


def _settled(opened: _Opened, looks: Looks) -> ScanSource | None:
    as_all = replace(opened, look=looks.parts[0])
    return None if as_all.decision == opened.decision else _source(as_all)
