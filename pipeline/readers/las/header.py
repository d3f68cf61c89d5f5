"""The header and the variable length records of LAS and LAZ, every count checked against the file's length before it is used.

Records that cannot be read are named and left out; only what the points need is refused.

References: ASPRS LAS 1.4 R15, sections 2.4 to 2.7; M. Isenburg, LASzip (the record 22204 of "laszip encoded").
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from storage.errors import InvalidScan, UnsupportedScan

RECORD_SIZES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)  # of point formats 0 to 10
MAX_RECORDS = 10_000  # variable length records that are looked at
MAX_RECORD_BYTES = 1 << 26
MAX_CHUNK_POINTS = 1 << 25  # LASzip writes chunks of 50,000
MAX_CHUNK_BYTES = 1 << 30  # what one chunk unpacks to
LASZIP = ("laszip encoded", 22204)
EXTRA_BYTES = ("LASF_Spec", 4)

_HEADER_BYTES = {0: 227, 1: 227, 2: 227, 3: 235, 4: 375}
_EXTRA_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8")


@dataclass(frozen=True)
class Record:
    """A variable length record, its content as bytes."""

    user: str
    id: int
    content: bytes


@dataclass(frozen=True)
class ExtraField:
    """A property that a writer added to every point; `at` counts from the end of the standard fields."""

    name: str
    dtype: str
    at: int
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class LasHeader:
    """The header of a LAS or LAZ file, checked against its length."""

    version: str
    point_format: int
    record_size: int
    n_points: int
    points_at: int
    compressed: bool
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    records: tuple[Record, ...]
    warnings: tuple[str, ...]

    def record(self, user: str, id: int) -> bytes | None:
        """The content of the first such record."""
        return next((r.content for r in self.records if (r.user, r.id) == (user, id)), None)


def read_header(path: str) -> LasHeader:
    """The checked header of a LAS or LAZ file.

    Guarantees: reads no more than the header and the records that fit into the file.
    Raises: InvalidScan for a header that contradicts itself or the file's length, UnsupportedScan for a point format.
    """
    n_bytes = os.path.getsize(path)
    with open(path, "rb") as stream:
        head = stream.read(375)
        if head[:4] != b"LASF":
            raise InvalidScan(path, f"begins with {head[:4]!r}", "a LAS or LAZ file, which begins with b'LASF'")
        if len(head) < 227:
            raise InvalidScan(path, f"{len(head)} bytes", "a header of 227 bytes or more", "the file may be truncated")
        minor = head[25]
        if head[24] != 1 or minor not in _HEADER_BYTES:
            raise UnsupportedScan(path, f"LAS version {head[24]}.{minor}", "LAS 1.0 to 1.4")
        if len(head) < _HEADER_BYTES[minor]:
            allowed = f"a header of {_HEADER_BYTES[minor]} bytes"
            raise InvalidScan(path, f"{len(head)} bytes", allowed, "the file may be truncated")
        header_size, points_at, n_records, format_, record_size, n_points = struct.unpack_from("<HIIBHI", head, 94)
        numbers = struct.unpack_from("<12d", head, 131)
        _check_layout(path, header_size, points_at, format_ & 0x3F, record_size, n_bytes)
        warnings: list[str] = []
        records = _records(stream, path, header_size, n_records, points_at, warnings)
        if minor >= 4:
            first_long, n_long = struct.unpack_from("<QI", head, 235)
            n_points = struct.unpack_from("<Q", head, 247)[0] or n_points
            records += _long_records(stream, path, first_long, n_long, n_bytes, warnings)
    if not n_points and n_bytes - points_at >= max(record_size, 1):
        found = f"0 points, with {n_bytes - points_at} bytes after its header"
        raise InvalidScan(f"{path}:point_count", found, "how many they are", "its writer may not have come to its end")
    _check_numbers(path, numbers)
    header = LasHeader(
        version=f"1.{minor}",
        point_format=format_ & 0x3F,
        record_size=record_size,
        n_points=n_points,
        points_at=points_at,
        compressed=bool(format_ & 0xC0),
        scales=numbers[0:3],
        offsets=numbers[3:6],
        low=numbers[7::2],
        high=numbers[6::2],
        records=tuple(records),
        warnings=tuple(warnings),
    )
    _check_length(path, header, n_bytes)
    return header


def _check_layout(path: str, header_size: int, points_at: int, format_: int, record_size: int, n_bytes: int) -> None:
    if format_ >= len(RECORD_SIZES):
        raise UnsupportedScan(f"{path}:point format", f"{format_}", f"0 to {len(RECORD_SIZES) - 1}")
    if record_size < RECORD_SIZES[format_]:
        found = f"records of {record_size} bytes in point format {format_}"
        raise InvalidScan(f"{path}:point record length", found, f"{RECORD_SIZES[format_]} or more")
    if not 227 <= header_size <= points_at <= n_bytes:
        found = f"points at byte {points_at} behind a header of {header_size} bytes in a file of {n_bytes}"
        raise InvalidScan(f"{path}:offset to point data", found, "a whole file", "the file may be truncated")


def _check_numbers(path: str, numbers: tuple[float, ...]) -> None:
    scales, offsets = np.array(numbers[0:3]), np.array(numbers[3:6])
    if not (np.isfinite(scales).all() and (scales != 0).all()):
        raise InvalidScan(f"{path}:scale", f"{scales.tolist()}", "finite and not 0")
    if not np.isfinite(offsets).all():
        raise InvalidScan(f"{path}:offset", f"{offsets.tolist()}", "finite")


def _records(stream: BinaryIO, path: str, at: int, n: int, end: int, warnings: list[str]) -> list[Record]:
    """The records between the header and the points; of more than fit, those that fit."""
    found: list[Record] = []
    for i in range(n):
        if i == MAX_RECORDS or at + 54 > end:
            warnings.append(f"{path}: {n:,} variable length records promised before byte {end}, {i:,} read")
            break
        stream.seek(at)
        user, id_, size = struct.unpack("<2x16sHH32x", stream.read(54))
        if at + 54 + size > end:
            what = f"{_text(user)!r} {id_} of {size} bytes at byte {at} runs into the points"
            warnings.append(f"{path}: the variable length record {what}; it and those after it are not read")
            break
        found.append(Record(_text(user), id_, stream.read(size)))
        at += 54 + size
    return found


def _long_records(stream: BinaryIO, path: str, at: int, n: int, n_bytes: int, warnings: list[str]) -> list[Record]:
    """The extended records, which stand after the points."""
    found: list[Record] = []
    for i in range(n):
        if i == MAX_RECORDS or at + 60 > n_bytes:
            warnings.append(f"{path}: {n:,} extended records promised in a file of {n_bytes} bytes, {i:,} read")
            break
        stream.seek(at)
        user, id_, size = struct.unpack("<2x16sHQ32x", stream.read(60))
        if at + 60 + size > n_bytes:
            warnings.append(f"{path}: the extended record {_text(user)!r} {id_} of {size} bytes is cut off; not read")
            break
        if size <= MAX_RECORD_BYTES:
            found.append(Record(_text(user), id_, stream.read(size)))
        at += 60 + size
    return found


def _text(padded: bytes) -> str:
    return padded.split(b"\0")[0].decode("latin-1")


def _check_length(path: str, header: LasHeader, n_bytes: int) -> None:
    """Refuses a file that cannot hold the points that its header promises."""
    if not header.compressed:
        needed = header.points_at + header.n_points * header.record_size
        if n_bytes < needed:
            found = f"{header.n_points} points promised, which need {needed} bytes, in a file of {n_bytes}"
            raise InvalidScan(f"{path}:point_count", found, "a whole file", "the file may be truncated")
        return
    with open(path, "rb") as stream:
        stream.seek(header.points_at)
        pointer = stream.read(8)
        table = struct.unpack("<q", pointer)[0] if len(pointer) == 8 else n_bytes
        if table == -1:  # written to a pipe: the pointer stands at the end of the file
            stream.seek(max(0, n_bytes - 8))
            table = struct.unpack("<q", stream.read(8))[0]
        if not header.points_at + 8 <= table < n_bytes:
            found = f"a chunk table at byte {table} in a file of {n_bytes}"
            raise InvalidScan(f"{path}:chunk table", found, "a whole file", "the file may be truncated")
        stream.seek(table)
        counts = stream.read(8)
    _check_packing(path, header, struct.unpack("<4xI", counts)[0] if len(counts) == 8 else 0, n_bytes)


def _check_packing(path: str, header: LasHeader, n_chunks: int, n_bytes: int) -> None:
    """The record that says how points are packed, before the decoder trusts it."""
    content = header.record(*LASZIP)
    if content is None or len(content) < 34:
        raise InvalidScan(f"{path}:laszip record", "missing or cut off", "the record that says how points are packed")
    chunk_points, n_items = struct.unpack_from("<12xI16xH", content)
    sizes = [
        struct.unpack_from("<2xH2x", content, 34 + 6 * i)[0] for i in range(min(n_items, (len(content) - 34) // 6))
    ]
    if len(sizes) < n_items or sum(sizes) != header.record_size:
        found = f"{n_items} items of {sum(sizes)} bytes in records of {header.record_size}"
        raise InvalidScan(f"{path}:laszip record", found, "items that make a record")
    if chunk_points == 0 or (chunk_points > MAX_CHUNK_POINTS and chunk_points != 0xFFFFFFFF):
        raise InvalidScan(f"{path}:laszip record", f"chunks of {chunk_points} points", f"1 to {MAX_CHUNK_POINTS}")
    most = -(-header.n_points // chunk_points) if chunk_points != 0xFFFFFFFF else n_bytes // 16
    if n_chunks > most + 1:
        raise InvalidScan(f"{path}:chunk table", f"{n_chunks} chunks", f"{most} for {header.n_points} points")
    # A point takes a bit or more, whatever the coder.
    if header.n_points > 1 << 16 and header.n_points > 64 * 8 * n_bytes:
        raise InvalidScan(
            f"{path}:point_count", f"{header.n_points} points in a file of {n_bytes} bytes", "a whole file"
        )


def extra_fields(header: LasHeader) -> tuple[ExtraField, ...]:
    """The properties that the points have besides the standard ones; those of several values are named NAME 0, NAME 1, ..."""
    content = header.record(*EXTRA_BYTES) or b""
    room, at, found = header.record_size - RECORD_SIZES[header.point_format], 0, []
    for first in range(0, len(content) - 191, 192):
        kind, options = content[first + 2], content[first + 3]
        name = _text(content[first + 4 : first + 36])
        if kind == 0:
            at += options
            continue
        if kind > 30:
            break
        dtype, n = _EXTRA_TYPES[(kind - 1) % 10], (kind - 1) // 10 + 1
        scales = struct.unpack_from("<3d", content, first + 112)
        offsets = struct.unpack_from("<3d", content, first + 136)
        for i in range(n):
            scale = scales[i] if options & 8 and np.isfinite(scales[i]) else 1.0
            offset = offsets[i] if options & 16 and np.isfinite(offsets[i]) else 0.0
            if at + int(dtype[1]) <= room:
                found.append(ExtraField(name if n == 1 else f"{name} {i}", dtype, at, scale, offset))
            at += int(dtype[1])
    return tuple(found)
