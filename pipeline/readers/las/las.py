"""LAS and LAZ through laspy and lazrs: scale and offset applied in float64, the unit from the coordinate system.

Colours are 16 bits by the standard, yet many writers leave 8-bit values there, or nothing but zeros. A few runs of
points, spread over the file, decide for all of it; a point that contradicts 8 bits is refused, never clipped.

References: ASPRS LAS 1.4 R15.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import GeoDoubleParamsVlr, GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from pipeline.readers.las.crs import DEGREE, UNKNOWN, unit_from_geokeys, unit_from_wkt
from pipeline.scan import Piece, ScanSource
from storage.errors import InvalidScan, SplatpressError

N_PROBES = 8
PROBE_POINTS = 2048

_UNIT_SIZE_KEY = 3077
_RGB = ("red", "green", "blue")


@contextmanager
def _refusing(path: str) -> Iterator[None]:
    """Turns whatever laspy and lazrs raise on broken bytes into InvalidScan.

    Both index and unpack without checks, and lazrs panics with an exception that is no Exception.
    """
    try:
        yield
    except (SplatpressError, OSError, MemoryError, GeneratorExit):
        raise
    except BaseException as error:
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            found = f"unreadable ({type(error).__name__}: {str(error)[:200]})"
            raise InvalidScan(path, found, "a whole LAS or LAZ file", "the file may be truncated") from error
        raise


def _open(path: str) -> laspy.LasReader:
    # One thread: what runs many readers side by side decides about cores.
    return laspy.open(path, laz_backend=laspy.LazBackend.Lazrs)


def _check_length(path: str, header: laspy.LasHeader) -> None:
    n_bytes, start = os.path.getsize(path), header.offset_to_point_data
    if not header.are_points_compressed:
        needed = start + header.point_count * header.point_format.size
        if n_bytes < needed:
            found = f"{header.point_count} points promised, which need {needed} bytes, in a file of {n_bytes}"
            raise InvalidScan(f"{path}:point_count", found, "a whole file", "the file may be truncated")
        return
    with open(path, "rb") as stream:
        stream.seek(start)
        pointer = stream.read(8)
    chunk_table = struct.unpack("<q", pointer)[0] if len(pointer) == 8 else n_bytes
    if chunk_table >= n_bytes:  # -1: written to a pipe, and found at the end of the file
        found = f"a chunk table at byte {chunk_table} in a file of {n_bytes}"
        raise InvalidScan(f"{path}:chunk table", found, "a whole file", "the file may be truncated")


def _check_header(path: str, header: laspy.LasHeader) -> None:
    scales, offsets = np.asarray(header.scales), np.asarray(header.offsets)
    if not (np.isfinite(scales).all() and (scales != 0).all()):
        raise InvalidScan(f"{path}:scale", f"{scales.tolist()}", "finite and not 0")
    if not np.isfinite(offsets).all():
        raise InvalidScan(f"{path}:offset", f"{offsets.tolist()}", "finite")
    _check_length(path, header)


def _unit(header: laspy.LasHeader) -> str:
    records = [*header.vlrs, *(header.evlrs or [])]
    for record in records:
        if isinstance(record, WktCoordinateSystemVlr) and (unit := unit_from_wkt(record.string)) != UNKNOWN:
            return unit
    keys = [k for r in records if isinstance(r, GeoKeyDirectoryVlr) for k in r.geo_keys]
    doubles = [float(d) for r in records if isinstance(r, GeoDoubleParamsVlr) for d in np.asarray(r.doubles)]
    sizes = [k.value_offset for k in keys if k.id == _UNIT_SIZE_KEY and k.value_offset < len(doubles)]
    size = doubles[sizes[0]] if sizes else None
    return unit_from_geokeys({k.id: k.value_offset for k in keys}, size)


def _probe(reader: laspy.LasReader, names: tuple[str, ...]) -> int | None:
    """The largest value of some dimensions in a few runs of points, or None where no point has them."""
    header = reader.header
    if not header.point_count or not set(names) <= set(header.point_format.dimension_names):
        return None
    top = 0
    for start in np.linspace(0, max(0, header.point_count - PROBE_POINTS), N_PROBES).astype(int):
        reader.seek(int(start))
        points = reader.read_points(PROBE_POINTS)
        top = max([top, *(int(np.max(points[c], initial=0)) for c in names)])
    return top


def _color(points: laspy.ScaleAwarePointRecord, top: int, path: str, first: int) -> np.ndarray:  # (n, 3) uint8
    values = np.stack([np.asarray(points[c]) for c in _RGB], axis=1).astype(np.uint32)
    if top > 255:
        return ((values + 128) // 257).astype(np.uint8)
    if values.size and values.max() > 255:
        row, channel = np.argwhere(values > 255)[0]
        found = f"{values[row, channel]}, though the points sampled across the file hold 8-bit values"
        raise InvalidScan(f"{path}:{_RGB[channel]} of point {first + row}", found, "0 to 255, or 16 bits throughout")
    return values.astype(np.uint8)


def _pieces(path: str, n_points: int, top: int | None, has_intensity: bool, max_points: int) -> Iterator[Piece]:
    return _slice(path, n_points, top, has_intensity, 0, n_points, max_points)


def _slice(
    path: str, n_points: int, top: int | None, has_intensity: bool, first: int, stop: int, max_points: int
) -> Iterator[Piece]:
    with _refusing(path), _open(path) as reader:
        scales, offsets = np.asarray(reader.header.scales), np.asarray(reader.header.offsets)
        if first:
            reader.seek(first)
        while first < stop and len(points := reader.read_points(min(max_points, stop - first))):
            raw = np.stack([np.asarray(points.X), np.asarray(points.Y), np.asarray(points.Z)], axis=1)
            yield Piece(
                position=raw * scales + offsets,
                color=_color(points, top, path, first) if top else None,
                intensity=np.asarray(points.intensity).astype(np.float32) if has_intensity else None,
            )
            first += len(points)
    if first != stop:
        raise InvalidScan(f"{path}:point_count", f"{first} points read", f"{n_points}, as the header promises")


def _chunk_rows(header: laspy.LasHeader) -> int:
    """Points a chunk of a LAZ file, which is decoded from its start; 1 where nothing is, or chunks differ."""
    if not header.are_points_compressed:
        return 1
    laz = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
    return 1 if laz.uses_variable_size_chunks() else max(1, laz.chunk_size())


def _bounds(header: laspy.LasHeader) -> tuple | None:
    low, high = np.asarray(header.mins, np.float64), np.asarray(header.maxs, np.float64)
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return None
    return tuple(low.tolist()), tuple(high.tolist())


def _warnings(path: str, unit: str, top: int | None, has_intensity: bool, has_bounds: bool) -> tuple[str, ...]:
    warnings = []
    if unit == UNKNOWN:
        warnings.append(f"{path}: no coordinate system that names a unit; the unit is unknown")
    if unit == DEGREE:
        warnings.append(f"{path}: geographic coordinates in degrees; distances mix degrees with heights")
    if top == 0:
        warnings.append(f"{path}: its colours are all 0 in the points sampled and are not used")
    elif top is not None and top <= 255:
        warnings.append(f"{path}: 16-bit colours hold 8-bit values (largest sampled: {top}); taken as 8 bits")
    if not has_intensity:
        warnings.append(f"{path}: its intensity is 0 in all points sampled and is not used")
    if not has_bounds:
        warnings.append(f"{path}: the bounds in the header are not finite and are ignored")
    return tuple(warnings)


def open_las(path: str) -> ScanSource:
    """A LAS or LAZ file as a scan without cameras.

    Guarantees: positions are scaled and offset; reads the header and N_PROBES short runs of points.
    Raises: InvalidScan for a file that is truncated, damaged or contradicts itself.
    """
    with _refusing(path), _open(path) as reader:
        header = reader.header
        _check_header(path, header)
        chunk_rows = _chunk_rows(header)  # before points are read: laspy takes the record out of the header then
        top, has_intensity = _probe(reader, _RGB), bool(_probe(reader, ("intensity",)))
        unit, bounds = _unit(header), _bounds(header)
    return ScanSource(
        path=path,
        format="las",
        n_points=int(header.point_count),
        pieces=partial(_pieces, path, int(header.point_count), top, has_intensity),
        read_slice=partial(_slice, path, int(header.point_count), top, has_intensity),
        slice_rows=chunk_rows,
        unit=unit,
        has_colors=bool(top),
        has_intensity=has_intensity,
        bounds=bounds,
        warnings=_warnings(path, unit, top, has_intensity, bounds is not None),
        details={
            "version": str(header.version),
            "point_format": int(header.point_format.id),
            "compressed": bool(header.are_points_compressed),
            "scales": [float(s) for s in header.scales],
            "offsets": [float(o) for o in header.offsets],
            "properties": list(header.point_format.dimension_names),
        },
    )
