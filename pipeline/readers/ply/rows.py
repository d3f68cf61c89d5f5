"""The vertices of a PLY as rows of numbers: ASCII, binary records of one size, and binary records that hold lists.

Lists are skipped. Where a record's length depends on its lists, a kernel walks the bytes and notes where each run of
scalars begins.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import BinaryIO

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.readers.ply.header import MAX_LINE_BYTES, Element, PlyHeader
from storage.errors import InvalidScan

BLOCK_BYTES = 1 << 20
DIGITS = frozenset("0123456789-+.")  # that nearly every row begins with: it is no comment
MAX_ROW_BYTES = 1 << 24  # a record with lists of 4 million items

Rows = dict[int, np.ndarray]  # by the place of a property in its element


# --- binary ---


def binary_rows(
    stream: BinaryIO,
    header: PlyHeader,
    where: str,
    max_rows: int,
    first: int = 0,
    n: int | None = None,
    in_place: bool = False,
) -> Iterator[Rows]:
    """Rows first .. first + n of the vertices, all by default, at most `max_rows` at once; `in_place`: where the next
    ones will be.

    Raises: InvalidScan where the data ends early, naming the byte.
    """
    vertex = header.vertex
    n = vertex.count - first if n is None else n
    stream.seek(header.n_bytes)
    for element in header.before_vertices:
        _skip(stream, element, header, where)
    if vertex.has_lists:
        yield from _walked_rows(stream, vertex, header, where, max_rows, n)
        return
    dtype = vertex.row_dtype(header.encoding)
    stream.seek(first * dtype.itemsize, io.SEEK_CUR)
    room = np.empty(min(max_rows, n) if in_place else 0, dtype)  # new memory of megabytes costs more than reading
    for at in range(0, n, max_rows):
        wanted = min(max_rows, n - at)
        rows = room[:wanted] if in_place else np.empty(wanted, dtype)
        if not _read_whole(stream, rows):
            raise InvalidScan(f"{where}:vertex", f"the data ends at byte {stream.tell()}", f"{vertex.count} vertices")
        yield {int(name): rows[name] for name in dtype.names}


def _read_whole(stream: BinaryIO, rows: np.ndarray) -> bool:
    left = memoryview(rows.view(np.uint8))  # type: ignore[arg-type]
    while len(left) and (n := stream.readinto(left)):  # type: ignore[attr-defined]
        left = left[n:]
    return not len(left)


def _skip(stream: BinaryIO, element: Element, header: PlyHeader, where: str) -> None:
    if not element.has_lists:
        stream.seek(element.count * element.row_dtype(header.encoding).itemsize, io.SEEK_CUR)
        return
    for _ in _walk(stream, element, header, where, 1 << 16, element.count):
        pass


def _walked_rows(
    stream: BinaryIO, element: Element, header: PlyHeader, where: str, max_rows: int, n: int
) -> Iterator[Rows]:
    for block, starts in _walk(stream, element, header, where, max_rows, n):
        yield {
            i: _gathered(block, starts[:, i], np.dtype(header.byte_order + p.dtype))
            for i, p in enumerate(element.properties)
            if not p.is_list
        }


def _gathered(block: np.ndarray, starts: np.ndarray, dtype: np.dtype) -> np.ndarray:  # (n,)
    return np.ascontiguousarray(block[starts[:, None] + np.arange(dtype.itemsize)]).view(dtype)[:, 0]


def _walk(
    stream: BinaryIO, element: Element, header: PlyHeader, where: str, max_rows: int, n: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Blocks of bytes, and where in them each property of each row begins, (rows, properties); leaves the stream behind the rows."""
    item = np.array([int(p.dtype[1:]) for p in element.properties])
    count = np.array([int(p.count_dtype[1:]) if p.is_list else 0 for p in element.properties])
    signed = np.array([p.count_dtype.startswith("i") for p in element.properties])
    origin, left, done = stream.tell(), np.zeros(0, np.uint8), 0
    while done < n:
        block = np.concatenate([left, np.frombuffer(stream.read(BLOCK_BYTES), np.uint8)])
        is_end = len(block) == len(left)
        at = 0
        while done < n:
            starts, end = _starts(block, at, min(max_rows, n - done), item, count, signed, header.byte_order == ">")
            if end < 0:
                raise InvalidScan(
                    f"{where}:{element.name} {done + len(starts)}", "a list of negative length", "0 or more"
                )
            if not len(starts):
                break
            yield block, starts
            done, at = done + len(starts), end
        origin, left = origin + at, block[at:]
        if done < n and (is_end or len(left) > MAX_ROW_BYTES):
            what = "the data ends" if is_end else f"a record longer than {MAX_ROW_BYTES} bytes"
            raise InvalidScan(f"{where}:{element.name} {done}", f"{what} at byte {origin + len(left)}", f"{n} of them")
    stream.seek(origin)


@kernel()
def _starts(block, at, most, item, count, signed, big):
    """Where each property of up to `most` whole rows from `at` on begins, and where the next row does; -1 for a negative length."""
    starts = np.empty((most, len(item)), np.int64)
    for row in range(most):
        here = at
        for p in range(len(item)):
            starts[row, p] = here
            if count[p] == 0:
                here += item[p]
                continue
            if here + count[p] > len(block):
                return starts[:row], at
            n = np.int64(0)
            for b in range(count[p]):
                n = n << 8 | np.int64(block[here + (b if big else count[p] - 1 - b)])
            if signed[p] and count[p] < 8 and n >> (8 * count[p] - 1):
                n = np.int64(-1)
            if n < 0:
                return starts[:row], np.int64(-1)
            here += count[p] + min(n, np.int64(1) << 40) * item[p]
        if here > len(block):
            return starts[:row], at
        at = here
    return starts, at


# --- ASCII ---


def ascii_rows(stream: BinaryIO, header: PlyHeader, where: str, max_rows: int, n: int | None = None) -> Iterator[Rows]:
    """The first `n` vertices, all by default. Empty lines and comments between them are passed over.

    Raises: InvalidScan naming the line of the file and what is wrong with it.
    """
    vertex = header.vertex
    n = vertex.count if n is None else n
    stream.seek(header.n_bytes)
    lines = _numbered_lines(stream, header.n_lines + 1)
    for element in header.before_vertices:
        for _ in islice(lines, element.count):
            pass
    for first in range(0, n, max_rows):
        wanted = min(max_rows, n - first)
        block = list(islice(lines, wanted))
        if len(block) < wanted:
            raise InvalidScan(
                f"{where}:vertex", f"the data ends after {first + len(block)} vertices", f"{vertex.count} vertices"
            )
        if vertex.has_lists:
            block = [(number, _without_lists(line, vertex, f"{where}:line {number}")) for number, line in block]
        scalars = [i for i, p in enumerate(vertex.properties) if not p.is_list]
        values = parse_rows(block, len(scalars), where)
        yield dict(zip(scalars, values.T, strict=True))


def _numbered_lines(stream: BinaryIO, first: int) -> Iterator[tuple[int, str]]:
    """Lines that are neither empty nor comments, with their number in the file, whatever they end with."""
    text = io.TextIOWrapper(stream, "ascii", errors="replace")
    try:
        number = first
        while line := text.readline(MAX_LINE_BYTES):
            if line[0] in DIGITS or ((words := line.strip()) and not words.startswith(("comment", "#"))):
                yield number, line
            number += 1
    finally:
        with suppress(ValueError):  # the stream is closed already
            text.detach()


def _without_lists(line: str, vertex: Element, where: str) -> str:
    """The scalars of a row."""
    words, at, kept = line.split(), 0, []
    for p in vertex.properties:
        if p.is_list:
            length = words[at] if at < len(words) else "nothing"
            if not length.isdigit():
                raise InvalidScan(where, f"{length[:40]!r} for the length of {p.name}", "a whole number")
            at += 1 + int(length)
        else:
            kept += words[at : at + 1]
            at += 1
    if at != len(words):
        raise InvalidScan(where, f"{len(words)} values", f"{at}, with its lists")
    return " ".join(kept)


def _plain_numbers(line: str) -> str:
    """The line with what Microsoft's C libraries print for NaN and infinity as others print it."""
    if "#" not in line and "(" not in line:
        return line
    return re.sub(r"(-?)(?:1\.#INF|inf\(?)\S*", r"\1inf", re.sub(r"-?(?:1\.#(?:QNAN|SNAN|IND)|nan\()\S*", "nan", line))


def parse_rows(lines: list[tuple[int, str]], n_columns: int, where: str, delimiter: str | None = None) -> np.ndarray:
    """Numbers (n, n_columns) of numbered lines. Raises: InvalidScan naming the first line that has others."""
    rows = [line for _, line in lines]
    if any(mark in "".join(rows) for mark in "#("):
        rows = [_plain_numbers(line) for line in rows]
    try:
        values = np.loadtxt(rows, np.float64, comments=None, ndmin=2, delimiter=delimiter)
    except ValueError:
        values = None
    if values is not None and values.shape == (len(lines), n_columns):
        return values
    for number, line in lines:
        words = _plain_numbers(line).split(delimiter)
        wrong = next((w for w in words if not _is_number(w)), None)
        if wrong is not None or len(words) != n_columns:
            hint = "decimals are written with a point" if wrong and "," in wrong and delimiter is None else ""
            found = f"{wrong.strip()[:40]!r}" if wrong is not None else f"{len(words)} values in {line.strip()[:80]!r}"
            column = f", column {line.index(wrong) + 1}" if wrong else ""
            raise InvalidScan(f"{where}:line {number}{column}", found, f"{n_columns} numbers", hint)
    raise InvalidScan(where, f"lines {lines[0][0]} to {lines[-1][0]} are not numbers", f"{n_columns} numbers a line")


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word
