"""One file of what tasks wrote side by side: what stands around the groups is laid out, then all of it is put together
and sealed in one pass.

Of a scan of any size no more than the rows of TABLE_ROWS_PER_ZARR_CHUNK groups are in memory, and 16 bytes a group.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from storage import place
from storage.errors import InternalError
from storage.packed.groups import PREFIX, TABLE
from storage.packed.layout import (
    LOCAL_HEADER_BYTES,
    TABLE_ROWS_PER_ZARR_CHUNK,
    chunk_bytes,
    chunk_member,
    chunk_shape,
    group_members,
    members_before_groups,
    members_of_all,
    n_first_groups,
    shape_of,
)
from storage.packed.schema import Array, Header, arrays_of
from storage.packed.seal import SEAL_BYTES, digest_of, end_with_seal
from storage.packed.writing.writer import groups_a_piece, piece_of, told_file, told_of
from storage.packed.writing.zipped import end_of, entries, entries_in_rows, local_header
from storage.whole import whole

BEFORE, OF_ALL, DIRECTORY, PLACES = "before", "of-all", "directory", "places.json"  # parts beside the pieces
START = PREFIX + "start"
BLOCK = 1 << 22  # bytes at a time


def lay_out(folder: Path, header: Header) -> None:
    """The table of groups, and what stands before, between and behind the groups, once all else is written. May run
    more than once, also side by side.

    Raises: InternalError where something never was.
    """
    n, n_first = header.n_groups, n_first_groups(header)
    table = [array for array in arrays_of(header) if array.name in TABLE]
    before, of_all = list(members_before_groups(header)), list(members_of_all(header))
    n_before, n_of_all = _bytes_of(folder, header, before), _bytes_of(folder, header, of_all)
    n_bytes = np.concatenate([_told(folder, header, *rows)["bytes"] for rows in _runs(0, n)]).astype(np.int64)
    start = n_before + np.cumsum(n_bytes) - n_bytes
    start[n_first:] += n_of_all
    for index, (begin, end) in enumerate(_runs(0, n)):
        told = _told(folder, header, begin, end)
        for array in table:
            rows = start[begin:end] if array.name == START else told[array.name.removeprefix(PREFIX)]
            _write_rows(folder, header, array, index, rows)
    with whole(folder / DIRECTORY) as partial, open(partial, "wb") as file:
        file.write(_lay_out_members(folder, BEFORE, before, 0))
        for begin, end in _runs(0, n_first):
            file.write(_entries_of(folder, header, start, begin, end))
        at = n_before + int(n_bytes[:n_first].sum())
        file.write(_lay_out_members(folder, OF_ALL, of_all, at))
        for begin, end in _runs(n_first, n):
            file.write(_entries_of(folder, header, start, begin, end))
        n_members = len(before) + len(of_all) + n * len(group_members(header, 0))
        end_of_groups = n_before + n_of_all + int(n_bytes.sum())
        file.write(end_of(n_members, end_of_groups, file.tell(), SEAL_BYTES))
    pieces = np.add.reduceat(n_bytes, np.arange(0, n, groups_a_piece(header)))
    known = {"pieces": pieces.tolist(), "first": int(n_bytes[:n_first].sum())}
    with whole(folder / PLACES) as partial:
        partial.write_text(json.dumps(known))


@dataclass(frozen=True)
class Part:
    """Bytes of the file that lie in a file beside it."""

    path: Path
    skip: int  # bytes that come before them there
    n_bytes: int


def parts_of(folder: Path) -> list[Part]:
    """What the file is put together of, in order.

    Raises: InternalError where a part was never written.
    """
    if not place.is_file(folder / PLACES):
        raise InternalError(str(folder), "what stands around the groups was never laid out")
    known = json.loads(place.here(folder / PLACES).read_bytes())
    of_all, left, parts = [_whole(folder / OF_ALL)], known["first"], [_whole(folder / BEFORE)]
    for piece, n_bytes in enumerate(known["pieces"]):
        n_first = min(left, n_bytes)
        parts.append(Part(piece_of(folder, piece), 0, n_first))
        left -= n_first
        parts += of_all if not left else []
        of_all = of_all if left else []
        parts.append(Part(piece_of(folder, piece), n_first, n_bytes - n_first))
    return [part for part in (*parts, _whole(folder / DIRECTORY)) if part.n_bytes]


def begin_file(folder: Path, path: Path) -> int:
    """A file with room for what was laid out, and its seal; how long it is without the seal."""
    n_bytes = sum(part.n_bytes for part in parts_of(folder))
    with open(path, "ab") as file:
        os.truncate(file.fileno(), n_bytes + SEAL_BYTES)
    return n_bytes


def write_range(folder: Path, path: Path, start: int, stop: int) -> None:
    """Bytes start..stop of the file. For tasks, side by side: none writes what is another's."""
    at = 0
    with open(path, "r+b") as file:
        for part in parts_of(folder):
            first, end = max(start, at), min(stop, at + part.n_bytes)
            if first < end:
                file.seek(first)
                for block in blocks_of(Part(part.path, part.skip + first - at, end - first)):
                    file.write(block)
            at += part.n_bytes
        file.flush()
        os.fsync(file.fileno())  # all workers at once, not the one that seals


def end_file(path: Path) -> str:
    """Seal a file that is written; its SHA-256."""
    with open(path, "r+b") as file:
        digest = digest_of(file, os.fstat(file.fileno()).st_size - SEAL_BYTES)
        end_with_seal(file, digest)
    return digest


def seal_packed(folder: Path, path: Path) -> None:
    """Put what was laid out together at `path`: same contents, same bytes. Appears under its name only when it is
    whole.

    Raises: InternalError where a part was never written. What does not belong to the file, such as the leavings of a
    killed task, stays out.
    """
    digest = sha256()
    with whole(path) as partial, open(partial, "wb") as file:
        for part in parts_of(folder):
            for block in blocks_of(part):
                digest.update(block)
                file.write(block)
        end_with_seal(file, digest.hexdigest())


def blocks_of(part: Part) -> Iterator[bytes]:
    """Its bytes, BLOCK of them at a time."""
    if not place.is_file(part.path):
        raise InternalError(str(part.path), "was never written")
    with open(place.here(part.path), "rb") as file:
        file.seek(part.skip)
        for at in range(0, part.n_bytes, BLOCK):
            n = min(BLOCK, part.n_bytes - at)
            if len(block := file.read(n)) != n:
                raise InternalError(str(part.path), f"{n - len(block)} bytes short")
            yield block


def _bytes_of(folder: Path, header: Header, members: list[str]) -> int:
    """What members take in the file; those of the table, which are not there yet, what their shape says."""
    table = {
        array.name: chunk_bytes(array, shape_of(header, array)) for array in arrays_of(header) if array.name in TABLE
    }
    total = 0
    for member in members:
        name, _, chunk = member.partition("/c/")
        if chunk and name in table:
            size = table[name]
        elif place.is_file(folder / member):
            size = place.here(folder / member).stat().st_size
        else:
            raise InternalError(str(folder), f"{member} was never written")
        total += LOCAL_HEADER_BYTES + len(member) + size
    return total


def _whole(path: Path) -> Part:
    if not place.is_file(path):
        raise InternalError(str(path), "was never written")
    return Part(path, 0, place.here(path).stat().st_size)


def _runs(first: int, stop: int) -> list[tuple[int, int]]:
    """Groups that are looked at together: first and end."""
    return [(at, min(at + TABLE_ROWS_PER_ZARR_CHUNK, stop)) for at in range(first, stop, TABLE_ROWS_PER_ZARR_CHUNK)]


def _told(folder: Path, header: Header, first: int, stop: int) -> np.ndarray:
    """What tasks told of groups first..stop, rows of `told_of`."""
    step, row = groups_a_piece(header), told_of(header)
    pieces = range(first // step, -(-stop // step))
    try:
        files = place.all_here(told_file(folder, piece) for piece in pieces)
        rows = np.concatenate([np.frombuffer(file.read_bytes(), row) for file in files])
    except FileNotFoundError as error:
        raise InternalError(str(folder), f"a piece was never written: {error}") from error
    return rows[first - pieces.start * step : stop - pieces.start * step]


def _write_rows(folder: Path, header: Header, array: Array, index: int, rows: np.ndarray) -> None:
    """Zarr chunk `index` of the table, which is plain bytes."""
    shape = shape_of(header, array)
    chunk = np.zeros(chunk_shape(array, shape), np.dtype(array.dtype).newbyteorder("<"))
    chunk[: len(rows)] = rows
    path = folder / chunk_member(array, index)
    place.make_folder(path.parent)
    with whole(path) as partial:
        partial.write_bytes(chunk.tobytes())


def _lay_out_members(folder: Path, name: str, members: list[str], at: int) -> bytes:
    """Write members behind each other into a file as they stand in the zip from `at` on; what the directory says of
    them."""
    crc, size, start = [], [], []
    with whole(folder / name) as partial, open(partial, "wb") as file:
        for member in members:
            content = place.here(folder / member).read_bytes()
            crc.append(zlib.crc32(content))
            size.append(len(content))
            start.append(at + file.tell())
            file.write(local_header(member, crc[-1], size[-1]) + content)
    return entries(members, np.array(crc, np.int64), np.array(size, np.int64), np.array(start, np.int64))


def _entries_of(folder: Path, header: Header, start: np.ndarray, first: int, stop: int) -> bytes:
    """What the directory says of groups first..stop."""
    told = _told(folder, header, first, stop)
    names = [_about(member) for _, member in group_members(header, 0)]
    digits = np.array([len(str(group)) for group in range(first, stop)])
    length = LOCAL_HEADER_BYTES + digits[:, None] + [len(a) + len(b) for a, b in names] + told["size"]
    at = start[first:stop, None] + np.cumsum(length, axis=1) - length
    return entries_in_rows(names, first, told["crc"], told["size"], at)


def _about(member: str) -> tuple[str, str]:
    """What stands before and behind the number of a group in the name of one of its members."""
    array, _, chunk = member.partition("/c/0")
    return f"{array}/c/", chunk
