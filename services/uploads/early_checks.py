"""What the first bytes of an upload tell already, so that a wrong file is refused then and not after gigabytes.

Nothing is decoded here but headers of fixed form and the first 64 kB of a .ply inside a .zip; the whole is validated
once it is there (services/uploads/validation.py). A .zip has its list of members at its end, but every member's own
header too, in front of its bytes: those are followed as they arrive.

References: PKWARE, APPNOTE.TXT 6.3.10, sections 4.3.7 and 4.5.3; ASPRS LAS 1.4 R15, table 3; ASTM E2807-11, 7.2.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from dataclasses import dataclass, replace
from typing import BinaryIO

from pipeline.readers.files.members import escapes
from pipeline.readers.ply.header import MAX_HEADER_BYTES, PlyHeader, parse_header
from services.problems import Problem
from services.settings import ServiceSettings
from storage.errors import InvalidScan

PEEK_BYTES = 1 << 16  # of a .ply inside a .zip; its header takes about 1 kB
_END = re.compile(rb"end_header\s*\n")
_LOCAL = struct.Struct("<4s5H3I2H")
_STREAMED, _ENCRYPTED = 8, 1  # flags of a member: its sizes stand behind its bytes; it has a password
_ZIP64 = 0xFFFFFFFF


@dataclass(frozen=True)
class Look:
    """How far an upload has been looked at: `at` is the next byte to look at, None when only the whole can tell
    more."""

    at: int | None = 0
    members: int = 0
    unpacked_bytes: int = 0


def look(stream: BinaryIO, n_there: int, length: int, name: str, done: Look, settings: ServiceSettings) -> Look:
    """Look on from `done` at the first `n_there` bytes of a file `name` of `length` bytes, as far as they go.

    Raises: Problem 422 as soon as they cannot be the beginning of a scan that is handled, naming file and field.
    """
    looks = {
        ".zip": _look_at_zip,
        ".ply": _look_at_ply,
        ".las": _look_at_las,
        ".laz": _look_at_las,
        ".e57": _look_at_e57,
    }
    further = looks.get(f".{name.rpartition('.')[2].lower()}")
    if done.at is None or further is None:
        return replace(done, at=None)
    try:
        return further(stream, n_there, length, name, done, settings)
    except InvalidScan as error:
        raise Problem(422, "bad-scan", str(error), hint=error.hint) from error


def _magic(stream: BinaryIO, n_there: int, name: str, magic: bytes, what: str) -> None:
    stream.seek(0)
    found = stream.read(min(len(magic), n_there))
    if found != magic[: len(found)]:
        raise InvalidScan(name, f"begins with {found!r}", f"{what}, which begins with {magic!r}")


def _look_at_ply(stream, n_there, length, name, done, settings) -> Look:
    _magic(stream, n_there, name, b"ply", "a .ply")
    stream.seek(0)
    if not _END.search(stream.read(MAX_HEADER_BYTES)) and n_there < min(length, MAX_HEADER_BYTES):
        return done
    stream.seek(0)
    _check_ply(parse_header(stream, name), length, name)
    return replace(done, at=None)


def _check_ply(header: PlyHeader, length: int, name: str) -> None:
    ascii = header.encoding == "ascii"
    needed = header.n_bytes
    for element in header.elements:
        row = (
            2 * len(element.properties)
            if ascii
            else sum(1 if p.is_list else int(p.dtype[1:]) for p in element.properties)
        )  # a list may be empty: its length alone
        needed += element.count * row
    if needed > length + ascii:  # the last line may lack its end
        counts = ", ".join(f"{e.count:,} {e.name}" for e in header.elements)
        raise InvalidScan(
            f"{name}:header", f"{counts} promised, which need {needed:,} bytes, in a file of {length:,}", "a whole file"
        )


def _look_at_las(stream, n_there, length, name, done, settings) -> Look:
    _magic(stream, n_there, name, b"LASF", "a .las or .laz")
    if n_there < min(length, 375):
        return done
    stream.seek(0)
    head = stream.read(375).ljust(375, b"\0")
    (offset,), (format, row), (count,) = (
        struct.unpack_from(f, head, at) for f, at in (("<I", 96), ("<BH", 104), ("<I", 107))
    )
    count = struct.unpack_from("<Q", head, 247)[0] if head[25] >= 4 else count
    compressed = format & 0xC0
    needed = offset + (0 if compressed else count * row)
    if needed > length:
        raise InvalidScan(
            f"{name}:point_count",
            f"{count:,} points promised, which need {needed:,} bytes, in a file of {length:,}",
            "a whole file",
        )
    return replace(done, at=None)


def _look_at_e57(stream, n_there, length, name, done, settings) -> Look:
    _magic(stream, n_there, name, b"ASTM-E57", "an .e57")
    if n_there < min(length, 48):
        return done
    stream.seek(0)
    promised = struct.unpack_from("<Q", stream.read(48).ljust(48, b"\0"), 16)[0]
    if promised > length:
        raise InvalidScan(
            f"{name}:filePhysicalLength", f"{promised:,} bytes promised in a file of {length:,}", "a whole file"
        )
    return replace(done, at=None)


def _look_at_zip(stream, n_there, length, name, done, settings) -> Look:
    if done.at == 0:
        _magic(stream, n_there, name, b"PK\x03\x04", "a .zip with at least one member")
    while done.at is not None and n_there >= done.at + _LOCAL.size:
        stream.seek(done.at)
        further = _look_at_member(stream, n_there, length, name, done, settings)
        if further == done:
            break  # more of it has to arrive
        done = further
    return done


def _look_at_member(stream, n_there, length, name, done, settings) -> Look:
    magic, _, flags, method, _, _, _, packed, unpacked, n_name, n_extra = _LOCAL.unpack(stream.read(_LOCAL.size))
    begins = done.at + _LOCAL.size + n_name + n_extra
    if magic != b"PK\x03\x04":
        return replace(done, at=None)  # the list of members, or something that only it explains
    if n_there < begins:
        return done
    member = stream.read(n_name).decode("utf-8" if flags & 0x800 else "cp437", errors="replace")
    if escapes(member):
        raise InvalidScan(f"{name}:{member!r}", "a name that leaves the archive", "relative names without '..' or '\\'")
    if flags & _ENCRYPTED:
        raise InvalidScan(f"{name}:{member}", "an encrypted member", "archives without a password")
    if flags & _STREAMED:
        return replace(done, at=None)
    packed, unpacked = _long_sizes(stream.read(n_extra), packed, unpacked)
    if begins + packed > length:
        raise InvalidScan(
            f"{name}:{member}",
            f"{packed:,} bytes promised from byte {begins:,} on, in a file of {length:,}",
            "a whole .zip",
        )
    if member.endswith(".ply") and method in (0, 8):
        peek = min(packed, PEEK_BYTES)
        if n_there < begins + peek:
            return done
        _check_ply_inside(stream.read(peek), method, unpacked, f"{name}/{member}")
    found = Look(begins + packed, done.members + 1, done.unpacked_bytes + unpacked)
    _check_amounts(found, length, name, settings)
    return found


def _long_sizes(extra: bytes, packed: int, unpacked: int) -> tuple[int, int]:
    """Packed and unpacked bytes, from the zip64 field where 32 bits do not hold them."""
    at = 0
    while at + 4 <= len(extra):
        kind, size = struct.unpack_from("<2H", extra, at)
        if kind == 1 and size >= 16 and _ZIP64 in (packed, unpacked) and at + 20 <= len(extra):
            long = struct.unpack_from("<2Q", extra, at + 4)
            return long[1], long[0]
        at += 4 + size
    return packed, unpacked


def _check_ply_inside(content: bytes, method: int, unpacked: int, where: str) -> None:
    try:
        head = zlib.decompressobj(-15).decompress(content, PEEK_BYTES) if method else content
    except zlib.error as error:
        raise InvalidScan(where, "damaged inside the archive", "a whole .zip") from error
    if _END.search(head) or len(head) >= min(unpacked, PEEK_BYTES):
        _check_ply(parse_header(io.BytesIO(head), where), unpacked, where)


def _check_amounts(found: Look, length: int, name: str, settings: ServiceSettings) -> None:
    for n, allowed, what in (
        (found.members, settings.max_archive_files, "members"),
        (found.unpacked_bytes, settings.max_unpacked_bytes, "bytes unpacked"),
        (found.unpacked_bytes / max(1, length), settings.max_archive_ratio, "bytes unpacked for one packed"),
    ):
        if n > allowed:
            raise Problem(422, "archive-too-large", f"{name}: {n:,.0f} {what}; allowed: at most {allowed:,.0f}")
