"""LAS and LAZ: records of known layout, unpacked by lazrs; scale and offset applied in float64, the unit from the coordinate system.

The header is read here and not by a library, as its counts have to be checked before anything is read
(pipeline/readers/las/header.py). Colours are 16 bits by the standard, yet many writers leave 8 or 12 bits there, or zeros:
pipeline/readers/attributes/ranges.py tells. Normals are taken from extra bytes, and colours where
the point format has none.

References: ASPRS LAS 1.4 R15.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import lazrs
import numpy as np

from pipeline.readers.attributes.decisions import Decision, decide, probe_starts, reasons
from pipeline.readers.attributes.looks import Look, Looks
from pipeline.readers.attributes.marks import set_marks
from pipeline.readers.attributes.names import columns_of
from pipeline.readers.attributes.options import ReadOptions
from pipeline.readers.attributes.ranges import to_8_bits
from pipeline.readers.las.columns import RGB_AT, color_fields, colors_of, layout_of, normals_of, placed
from pipeline.readers.las.crs import DEGREE, UNKNOWN, Units, units_from_records
from pipeline.readers.las.header import LASZIP, LasHeader, extra_fields, read_header
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, SplatpressError

NOISE = (7, 18)
OVERLAP = 12  # a class up to point format 5, a flag from 6 on
TOP = 65535.0

_STANDARD = ("return number", "scan angle", "user data", "gps time")


@contextmanager
def _refusing(path: str) -> Iterator[None]:
    """Turns whatever lazrs raises on broken bytes into InvalidScan: it panics with an exception that is no Exception."""
    try:
        yield
    except (SplatpressError, OSError, MemoryError, GeneratorExit):
        raise
    except BaseException as error:
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            found = f"unreadable: {_reason_of(error)}"
            raise InvalidScan(path, found, "a whole LAS or LAZ file", "it is damaged or truncated") from error
        raise


def _reason_of(error: BaseException) -> str:
    """Why points could not be read, in our own words: what lazrs and its panics say is for those who know its sources."""
    text = str(error).lower()
    if "fill whole buffer" in text or isinstance(error, EOFError):
        return "its compressed points end early"
    return "its compressed points are damaged, or contradict its header"


class _Records(Protocol):
    """Points as they lie in the file."""

    def read(self, start: int, n: int) -> np.ndarray: ...

    def close(self) -> None: ...


class _Plain:
    def __init__(self, path: str, header: LasHeader, dtype: np.dtype) -> None:
        self.stream, self.header, self.dtype = open(path, "rb"), header, dtype

    def read(self, start: int, n: int) -> np.ndarray:
        self.stream.seek(self.header.points_at + start * self.dtype.itemsize)
        return np.fromfile(self.stream, self.dtype, n)

    def close(self) -> None:
        self.stream.close()


class _Packed:
    """One thread: what runs many readers side by side decides about cores."""

    def __init__(self, path: str, header: LasHeader, dtype: np.dtype) -> None:
        self.stream, self.dtype, self.at = open(path, "rb"), dtype, 0
        self.stream.seek(header.points_at)
        self.decoder = lazrs.LasZipDecompressor(self.stream, header.record(*LASZIP))

    def read(self, start: int, n: int) -> np.ndarray:
        if start != self.at:
            self.decoder.seek(start)
        rows = bytearray(n * self.dtype.itemsize)
        self.decoder.decompress_many(rows)
        self.at = start + n
        return np.frombuffer(rows, self.dtype)

    def close(self) -> None:
        self.stream.close()


def _open_records(path: str, header: LasHeader) -> _Records:
    return (_Packed if header.compressed else _Plain)(path, header, layout_of(header))


# --- what a record says ---


def _masks(rows: np.ndarray, header: LasHeader, wanted: frozenset[str]) -> dict[str, np.ndarray]:
    """Which points bear which of the `wanted` marks."""
    flags, new = rows["flags"], header.point_format >= 6
    class_ = rows["class"] if new else rows["class"] & 31
    found = {
        "withheld": lambda: flags & (4 if new else 128) != 0,
        "synthetic": lambda: flags & (1 if new else 32) != 0,
        "noise": lambda: (class_ == NOISE[0]) | (class_ == NOISE[1]),
        "overlap": lambda: (class_ == OVERLAP) | (flags & 8 != 0 if new else False),
    }
    return {name: mask() for name, mask in found.items() if name in wanted}


# --- opening ---


@dataclass(frozen=True)
class _Opened:
    """All that a file's source is made of."""

    path: str
    header: LasHeader
    options: ReadOptions
    look: Look
    source_ids: tuple[int, ...]  # of the points that were looked at

    @property
    def decision(self) -> Decision:
        return _decide(self.look, self.header)

    @property
    def is_sample(self) -> bool:
        return self.look.n_points < self.header.n_points


def _pieces(opened: _Opened, max_points: int) -> Iterator[Piece]:
    return _slice(opened, 0, opened.header.n_points, max_points)


def _slice(opened: _Opened, start: int, stop: int, max_points: int) -> Iterator[Piece]:
    header, options, decision = opened.header, opened.options, opened.decision
    wanted = options.left_out
    scales, offsets = np.array(header.scales), np.array(header.offsets)
    scales[2], offsets[2] = scales[2] * options.height_scale, offsets[2] * options.height_scale
    normals, fields = columns_of(f.name for f in extra_fields(header)).normal, color_fields(header)
    with _refusing(opened.path), closing(_open_records(opened.path, header)) as records:
        for first in range(start, stop, max_points):
            n = min(max_points, stop - first)
            rows = records.read(first, n)
            if len(rows) < n:
                found = f"{first + len(rows)} points read"
                raise InvalidScan(f"{opened.path}:point_count", found, f"{header.n_points}, as the header promises")
            masks = _masks(rows, header, wanted)
            look = opened.look.like() if opened.is_sample else None
            colors = colors_of(rows, fields) if look is not None or decision.top else None
            if look is not None:
                look.add(n, colors, rows["intensity"], masks)
            yield Piece(
                position=placed(rows["X"], rows["Y"], rows["Z"], scales, offsets),
                normal=normals_of(rows, header, normals),
                color=to_8_bits(colors, decision.top) if colors is not None and decision.top else None,
                intensity=rows["intensity"].astype(np.float32) if decision.intensity else None,
                mark=set_marks(len(rows), masks, wanted - decision.ignored),
                source_id=rows["source id"].astype(np.int64) if options.station_by_source else None,
                look=None if look is None else (0, look),
            )


def _decide(look: Look, header: LasHeader) -> Decision:
    return decide(look, bool(color_fields(header)), False, TOP, True)


def _settled(opened: _Opened, looks: Looks) -> ScanSource | None:
    as_all = replace(opened, look=looks.parts[0])
    return None if as_all.decision == opened.decision else _source(as_all)


def _chunk_rows(header: LasHeader) -> int:
    """Points a chunk of a LAZ file, which is decoded from its start; 1 where nothing is, or chunks differ."""
    if not header.compressed:
        return 1
    laz = lazrs.LazVlr(header.record(*LASZIP))
    return 1 if laz.uses_variable_size_chunks() else max(1, laz.chunk_size())


def _source(opened: _Opened) -> ScanSource:
    path, header, options, look = opened.path, opened.header, opened.options, opened.look
    decision = opened.decision
    units = units_from_records(header.records)  # type: ignore[arg-type]
    has_bounds = bool(np.isfinite([*header.low, *header.high]).all())
    warnings = [*header.warnings, *_warnings(path, units, has_bounds, options)]
    warnings += reasons(path, look, decision, bool(color_fields(header)), False, TOP, True, header.n_points)
    columns = columns_of(f.name for f in extra_fields(header))
    named = ("red", "green", "blue") if decision.top and header.point_format in RGB_AT else ()
    return ScanSource(
        path=path,
        format="las",
        n_points=header.n_points,
        pieces=partial(_pieces, opened),
        read_slice=partial(_slice, opened),
        slice_rows=_chunk_rows(header),
        settle=partial(_settled, opened) if opened.is_sample else None,
        unit=units.horizontal,
        has_normals=bool(columns.normal),
        has_colors=decision.top is not None,
        has_intensity=decision.intensity,
        bounds=(_scaled(header.low, options), _scaled(header.high, options)) if has_bounds else None,
        position_step=float(np.abs(header.scales).max()),
        warnings=tuple(warnings),
        unused=(
            *_STANDARD,
            *(() if options.station_by_source else ("point source id",)),
            *columns.unused,
            *(c for c in columns.color if f"extra {c}" not in color_fields(header)),
            *columns.intensity,
        ),
        details={
            "version": header.version,
            "point_format": header.point_format,
            "compressed": header.compressed,
            "scales": list(header.scales),
            "offsets": list(header.offsets),
            "records": [f"{r.user} {r.id}" for r in header.records],
            "point_source_ids": list(opened.source_ids),
            "properties": ["X", "Y", "Z", "intensity", *named, *(f.name for f in extra_fields(header))],
        },
    )


def _scaled(corner: tuple[float, float, float], options: ReadOptions) -> tuple[float, float, float]:
    return corner[0], corner[1], corner[2] * options.height_scale


def _warnings(path: str, units: Units, has_bounds: bool, options: ReadOptions) -> list[str]:
    warnings = [f"{path}: {warning}" for warning in units.warnings]
    if units.horizontal == UNKNOWN:
        warnings.append(f"{path}: no coordinate system that names a unit; the unit is unknown")
    if units.horizontal == DEGREE:
        warnings.append(f"{path}: geographic coordinates in degrees; distances mix degrees with heights")
    elif units.differ and options.height_scale == 1:
        found = f"{path}: its heights are in {units.vertical} and its other coordinates in {units.horizontal}"
        warnings.append(f"{found}; heights are not scaled (scale them: --height-scale {units.height_scale:.10g})")
    if not has_bounds:
        warnings.append(f"{path}: the bounds in the header are not finite and are ignored")
    return warnings


def open_las(path: str, options: ReadOptions = ReadOptions()) -> ScanSource:
    """A LAS or LAZ file as a scan without cameras.

    Guarantees: positions are scaled and offset; reads the header and, of a large scan, a few short runs of points.
    Raises: InvalidScan for a file that is truncated, damaged or contradicts itself; UnsupportedScan.
    """
    header = read_header(path)
    look, source_ids, fields = Look(), set[int](), color_fields(header)
    if header.n_points:
        with _refusing(path), closing(_open_records(path, header)) as records:
            for start, n in probe_starts(header.n_points):
                rows = records.read(start, n)
                source_ids |= set(np.flatnonzero(np.bincount(rows["source id"])).tolist())
                look.add(len(rows), colors_of(rows, fields), rows["intensity"], _masks(rows, header, options.left_out))
    with _refusing(path):
        return _source(_Opened(path, header, options, look, tuple(sorted(source_ids))))
