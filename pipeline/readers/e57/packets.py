"""Any run of an E57 scan's points, without those before it: libe57 reads from the first point on only.

A scan's points are one byte stream a field, each cut into the packets of a binary section: so many bits a point, without
gaps. The lengths of the streams in all packets, told by their headers, say where the bits of a point lie.

References: ASTM E2807-11, sections 7 (pages and their checksums), 9.3 (compressed vectors), 9.7 (bit packing).
"""

from __future__ import annotations

import functools
import os
import struct
from dataclasses import dataclass
from typing import BinaryIO
from xml.etree import ElementTree

import google_crc32c
import numpy as np
from pye57 import libe57

from pipeline.execution.compiled import kernel
from pipeline.readers.e57.damage import HEADER, check_header
from storage.errors import InvalidScan

_CRC_BYTES = 4  # at the end of every page
_SECTION = struct.Struct("<B7xQQQ")
_PACKET = struct.Struct("<BBHH")
_COMPRESSED_VECTOR, _DATA = 1, 1  # kind of section; kind of packet


@dataclass(frozen=True)
class BitField:
    """One field of a point as its stream has it: value = (bits + minimum) * scale + offset, or an IEEE number."""

    name: str
    n_bits: int
    is_float: bool
    minimum: int = 0
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Packets:
    """The data packets of one scan: where the streams of each begin in the file's logical bytes, and how long they are."""

    begin: np.ndarray  # (p,) int64
    end: np.ndarray  # (p,) int64
    length: np.ndarray  # (p, n_fields) int64 bytes

    @functools.cached_property
    def n_before(self) -> np.ndarray:  # (p + 1, n_fields): bytes of each stream before each packet
        return np.concatenate([np.zeros((1, self.length.shape[1]), np.int64), np.cumsum(self.length, axis=0)])


def bit_fields(prototype: libe57.StructureNode) -> tuple[BitField, ...] | None:
    """The fields of a scan's points in the order of their streams; None where one is of a kind that is not handled."""
    fields = []
    for i in range(prototype.childCount()):
        name = prototype.get(i).elementName()
        node = prototype[name]
        if isinstance(node, libe57.FloatNode):
            fields.append(BitField(name, 32 if node.precision() == libe57.FloatPrecision.E57_SINGLE else 64, True))
        elif isinstance(node, (libe57.IntegerNode, libe57.ScaledIntegerNode)):
            low, high = int(node.minimum()), int(node.maximum())
            scaled = (node.scale(), node.offset()) if isinstance(node, libe57.ScaledIntegerNode) else (1.0, 0.0)
            fields.append(BitField(name, (high - low).bit_length(), False, low, *map(float, scaled)))
        else:
            return None
    return tuple(fields)


_NONE = Packets(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 0), np.int64))


def packets_of(path: str, n_fields: tuple[int, ...]) -> tuple[Packets, ...]:
    """The packets of each scan of a file, of so many fields each; none of one of 0 fields, which is not to be read.

    Raises InvalidScan for what cannot be.
    """
    stat = os.stat(path)
    return _packets_of(path, n_fields, stat.st_size, stat.st_mtime_ns)


@functools.lru_cache(maxsize=4)
def _packets_of(path: str, n_fields: tuple[int, ...], _size: int, _changed: int) -> tuple[Packets, ...]:
    with open(path, "rb") as stream:
        pages, xml = _opened(path, stream)
        offsets = _sections(path, xml, len(n_fields))
        return tuple(_walk(pages, offset, n) if n else _NONE for offset, n in zip(offsets, n_fields))


def read_points(
    path: str, packets: Packets, fields: tuple[BitField, ...], wanted: list[str], first: int, stop: int
) -> dict[str, np.ndarray]:
    """Points first..stop of a scan by the names of `wanted` fields, (n,) float64 each, as libe57 converts them.

    Raises: InvalidScan where the file ends before them, or a checksum is wrong.
    """
    with open(path, "rb") as stream:
        pages, _ = _opened(path, stream, with_xml=False)
        chosen = [(i, field) for i, field in enumerate(fields) if field.name in wanted]
        spans = [
            (packets.n_before[:, i], first * f.n_bits // 8, -(-stop * f.n_bits // 8)) for i, f in chosen if f.n_bits
        ]
        for before, _, high in spans:
            if high > before[-1]:
                raise InvalidScan(
                    path, f"streams of {before[-1]} bytes, where point {stop - 1} needs {high}", "a whole E57 file"
                )
        lowest = min((int(np.searchsorted(before, low, "right")) - 1 for before, low, _ in spans), default=0)
        highest = max((int(np.searchsorted(before, high, "left")) for before, _, high in spans), default=0)
        there = (
            pages.read(int(packets.begin[lowest]), int(packets.end[highest - 1]))
            if highest > lowest
            else np.empty(0, np.uint8)
        )
        return {field.name: _values(there, packets, i, field, lowest, highest, first, stop) for i, field in chosen}


def _values(
    there: np.ndarray, packets: Packets, i: int, field: BitField, lowest: int, highest: int, first: int, stop: int
) -> np.ndarray:
    if not field.n_bits:
        return np.full(stop - first, float(field.minimum) * field.scale + field.offset)
    begin = packets.begin[lowest:highest] - packets.begin[lowest] + packets.length[lowest:highest, :i].sum(axis=1)
    stream = np.concatenate([there[at : at + n] for at, n in zip(begin, packets.length[lowest:highest, i])])
    bit = first * field.n_bits - 8 * int(packets.n_before[lowest, i])
    if field.is_float:
        size = field.n_bits // 8
        return (
            stream[bit // 8 : bit // 8 + (stop - first) * size].view("<f4" if size == 4 else "<f8").astype(np.float64)
        )
    raw = _unpacked(stream, bit, field.n_bits, stop - first)
    value = raw.astype(np.int64) + field.minimum if field.n_bits < 64 else raw.view(np.int64) + np.int64(field.minimum)
    return value.astype(np.float64) * field.scale + field.offset


@dataclass(frozen=True)
class _Pages:
    """The logical bytes of a file: its pages without their checksums."""

    path: str
    stream: BinaryIO
    n_bytes: int
    page: int

    def logical(self, physical: int) -> int:
        if physical % self.page >= self.page - _CRC_BYTES or physical >= self.n_bytes:
            raise InvalidScan(
                self.path, f"an offset of {physical} in {self.n_bytes} bytes", "one of a byte that is no checksum"
            )
        return physical // self.page * (self.page - _CRC_BYTES) + physical % self.page

    def read(self, begin: int, end: int) -> np.ndarray:
        """Logical bytes begin..end, (end - begin,) uint8, whose pages' checksums hold."""
        payload = self.page - _CRC_BYTES
        first, last = begin // payload, -(-end // payload)
        self.stream.seek(first * self.page)
        block = self.stream.read((last - first) * self.page)
        if len(block) < (last - first) * self.page:
            raise InvalidScan(
                self.path,
                f"the data ends at byte {first * self.page + len(block)}",
                "a whole E57 file",
                "the file may be truncated",
            )
        for at in range(0, len(block), self.page):
            told = int.from_bytes(block[at + payload : at + self.page], "big")
            if google_crc32c.value(block[at : at + payload]) != told:
                raise InvalidScan(
                    self.path,
                    f"a wrong checksum of page {first + at // self.page}",
                    "a whole E57 file",
                    "it is damaged",
                )
        whole = np.frombuffer(block, np.uint8).reshape(-1, self.page)[:, :payload].reshape(-1)
        return whole[begin - first * payload : end - first * payload]


def _opened(path: str, stream: BinaryIO, with_xml: bool = True) -> tuple[_Pages, bytes]:
    check_header(path)
    *_, xml_offset, xml_length, page = HEADER.unpack(stream.read(HEADER.size))
    pages = _Pages(path, stream, os.path.getsize(path), page)
    if not with_xml:
        return pages, b""
    begin = pages.logical(xml_offset)
    return pages, pages.read(begin, begin + xml_length).tobytes()


def _sections(path: str, xml: bytes, n_scans: int) -> list[int]:
    """Where in the file the binary section of each scan begins."""
    try:
        scans = ElementTree.fromstring(xml).findall("{*}data3D/{*}vectorChild/{*}points")
        offsets = [int(points.attrib["fileOffset"]) for points in scans]
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        at = " in line {}, column {}".format(*error.position) if isinstance(error, ElementTree.ParseError) else ""
        raise InvalidScan(path, f"its XML is broken{at}", "a whole E57 file") from error
    if len(offsets) != n_scans or min(offsets, default=0) < 0:
        raise InvalidScan(path, f"the points of {len(offsets)} scans at {offsets[:4]}", f"{n_scans} scans")
    return offsets


def _walk(pages: _Pages, offset: int, n_fields: int) -> Packets:
    start = pages.logical(offset)
    kind, n_bytes, data, _ = _SECTION.unpack(pages.read(start, start + _SECTION.size))  # type: ignore[arg-type]
    if kind != _COMPRESSED_VECTOR or n_bytes > pages.n_bytes:
        raise InvalidScan(
            pages.path, f"a section of kind {kind} and {n_bytes} bytes", f"kind {_COMPRESSED_VECTOR}, within the file"
        )
    at, end, found = pages.logical(data) if n_bytes > _SECTION.size else start + n_bytes, start + n_bytes, []
    head = struct.Struct(f"<{n_fields}H")
    while at + _PACKET.size <= end:
        there = pages.read(at, min(end, at + _PACKET.size + head.size)).tobytes()
        kind, _, last, n_streams = _PACKET.unpack_from(there)
        size = last + 1
        if kind == _DATA:
            lengths = (
                head.unpack_from(there, _PACKET.size)
                if n_streams == n_fields and len(there) == _PACKET.size + head.size
                else None
            )
            if lengths is None or _PACKET.size + head.size + sum(lengths) > size or at + size > end:
                raise InvalidScan(
                    pages.path,
                    f"a packet of {size} bytes with {n_streams} streams",
                    f"{n_fields} streams within the section",
                )
            found.append((at + _PACKET.size + head.size, at + size, lengths))
        elif size < _PACKET.size:
            raise InvalidScan(pages.path, f"a packet of {size} bytes", f"at least {_PACKET.size}")
        at += size
    begin, end = (np.array([p[i] for p in found], np.int64) for i in (0, 1))
    return Packets(begin, end, np.array([p[2] for p in found], np.int64).reshape(-1, n_fields))


@kernel()
def _unpacked(stream, bit, n_bits, n):
    """Values of `n_bits` bits each (n,) uint64, lowest bits first, from a bit of bytes (m,) on."""
    values = np.zeros(n, np.uint64)
    for i in range(n):
        at, got = bit + i * n_bits, 0
        while got < n_bits:
            byte, skip = (at + got) >> 3, (at + got) & 7
            take = min(8 - skip, n_bits - got)
            part = (np.uint64(stream[byte]) >> np.uint64(skip)) & np.uint64((1 << take) - 1)
            values[i] |= part << np.uint64(got)
            got += take
    return values
