"""Voxels as they stand in a file: one after the other, perhaps compressed, read a slice at a time and never whole."""

from __future__ import annotations

import bz2
import gzip
import os
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from pipeline.volumes.volume import LARGEST_EXACT
from storage.errors import InvalidScan

MOST_FILES = 1 << 16  # of a volume
_PATTERN = re.compile(r"[^%]*%0?\d{0,2}d[^%]*")
PIECE = 1 << 20  # bytes skipped, or of text, at a time


@dataclass(frozen=True)
class Stream:
    """Where voxels stand: in each of `paths` an equal share of the slices, after `skip_lines` of the file and `skip_bytes` of what is
    decompressed; -1 lets the voxels be the last bytes of the file. `sizes` fastest first; `space` are the three axes of space among
    them, ascending; `chosen` the entry of each other one."""

    paths: tuple[str, ...]
    dtype: np.dtype  # with its byte order
    sizes: tuple[int, ...]
    space: tuple[int, int, int]
    chosen: tuple[tuple[int, int], ...] = ()  # axis, entry
    encoding: str = "raw"  # "raw" | "gzip" | "bzip2" | "zlib" | "text"
    skip_lines: int = 0
    skip_bytes: int = 0
    slope: float = 1.0
    intercept: float = 0.0

    @property
    def n_bytes(self) -> int:
        """Of all voxels in all files."""
        return int(np.prod(self.sizes, dtype=object)) * self.dtype.itemsize


def numbered_files(told: str, pattern: str, first: str, last: str, step: str) -> list[str]:
    """The names that a pattern such as `slice%03d.raw` makes of numbers from `first` to `last`; `told` is where it stands.

    Raises: InvalidScan for any other pattern, and for more names than a volume has slices.
    """
    try:
        if not _PATTERN.fullmatch(pattern):
            raise ValueError
        numbers = range(int(first), int(last) + (1 if int(step) > 0 else -1), int(step))
        if not 1 <= len(numbers) <= MOST_FILES:
            raise ValueError
    except (ValueError, OverflowError) as error:
        found, allowed = (
            f"{pattern} {first} {last} {step}",
            f"NAME%03dNAME FIRST LAST STEP, at most {MOST_FILES:,} files",
        )
        raise InvalidScan(told, found[:200], allowed) from error
    return [pattern % i for i in numbers]


def check_length(stream: Stream) -> tuple[str, ...]:
    """Warnings where uncompressed files are longer than their voxels. Raises InvalidScan where one is shorter."""
    if stream.encoding != "raw" or stream.skip_lines:
        return ()
    needed, warnings = stream.n_bytes // len(stream.paths), []
    for path in stream.paths:
        there = os.path.getsize(path) - max(0, stream.skip_bytes)
        if there < needed:
            raise InvalidScan(
                path,
                f"{max(0, there):,} bytes of voxels, where the header promises {needed:,}",
                "a whole file",
                "it may be truncated",
            )
        if there > needed and stream.skip_bytes >= 0:
            warnings.append(_too_long(path, f"{there - needed:,} bytes"))
    return tuple(warnings)


def slices_of(stream: Stream, kept: np.dtype, warn: Callable[[str], None]) -> Iterator[np.ndarray]:
    """The voxels (n_j, n_i) of each k in turn, as `kept`.

    Raises: InvalidScan where a file ends early or does not decompress.
    """
    k = stream.space[2]
    inner = stream.sizes[:k]
    n_items = int(np.prod(inner, dtype=np.int64))
    n_k, chosen = stream.sizes[k], dict(stream.chosen)
    first, stride = 0, 1  # slices that come before the chosen ones, of axes slower than k
    for axis in range(k + 1, len(stream.sizes)):
        stride *= stream.sizes[axis - 1]
        first += chosen.get(axis, 0) * stride
    n_all = int(np.prod(stream.sizes[k:], dtype=np.int64))
    a_file = n_all // len(stream.paths)
    index = tuple(chosen.get(axis, slice(None)) for axis in reversed(range(k)))
    wanted = range(first, first + n_k)
    lost = 0
    for number, path in enumerate(stream.paths):
        begin = max(number * a_file, wanted.start)
        end = min((number + 1) * a_file, wanted.stop)
        if begin >= end:
            continue
        with open(path, "rb") as file:
            read = _reader(stream, path, file, n_items)
            read.skip(begin - number * a_file)
            for _ in range(begin, end):
                slice_, n_lost = _kept(read.items().reshape(inner[::-1])[index], stream, kept)
                lost += n_lost
                yield slice_
            if end == n_all and read.has_more():
                warn(_too_long(path, "some bytes"))
    if lost:
        warn(f"{lost:,} voxels are whole numbers beyond {LARGEST_EXACT:,} and were rounded to 24 bits")


class Slices:
    """What `Volume.slices` calls; a class, so that a volume can be pickled."""

    def __init__(self, stream: Stream, kept: np.dtype) -> None:
        self._stream, self._kept = stream, kept

    def __call__(self, warn: Callable[[str], None]) -> Iterator[np.ndarray]:
        return slices_of(self._stream, self._kept, warn)


def _too_long(path: str, what: str) -> str:
    return f"{path}: {what} after the last voxel are ignored"


def _kept(items: np.ndarray, stream: Stream, kept: np.dtype) -> tuple[np.ndarray, int]:
    lost = 0
    if kept.kind == "f" and items.dtype.kind in "ui" and items.dtype.itemsize > 2:
        lost = int((np.abs(items.astype(np.float64)) > LARGEST_EXACT).sum())
    if (stream.slope, stream.intercept) != (1.0, 0.0):
        items = items.astype(np.float64) * stream.slope + stream.intercept
    with np.errstate(over="ignore"):  # to infinity, which is counted as no value
        return np.ascontiguousarray(items, kept), lost


class _Bytes:
    """Slices of binary voxels from an open file."""

    def __init__(self, stream: Stream, path: str, file: BinaryIO, n_items: int) -> None:
        self._path, self._dtype, self._n_bytes = path, stream.dtype, n_items * stream.dtype.itemsize
        for _ in range(stream.skip_lines):
            file.readline()
        self._file = {
            "raw": lambda: file,
            "gzip": lambda: gzip.GzipFile(fileobj=file),
            "bzip2": lambda: bz2.BZ2File(file),
            "zlib": lambda: _Inflated(file),
        }[stream.encoding]()
        if stream.skip_bytes < 0:
            file.seek(-(stream.n_bytes // len(stream.paths)), os.SEEK_END)
        else:
            self._pass(stream.skip_bytes)

    def skip(self, n_slices: int) -> None:
        self._pass(n_slices * self._n_bytes)

    def _pass(self, n_bytes: int) -> None:
        while n_bytes > 0:
            n_bytes -= len(self._exactly(min(n_bytes, PIECE)))

    def items(self) -> np.ndarray:
        return np.frombuffer(self._exactly(self._n_bytes), self._dtype)

    def has_more(self) -> bool:
        try:
            return bool(self._guarded(1))
        except InvalidScan as error:
            if not isinstance(error.__cause__, gzip.BadGzipFile) or "Not a gzipped" not in str(error.__cause__):
                raise  # a checksum that is wrong, or missing
            return True

    def _exactly(self, n_bytes: int) -> bytes:
        found = self._guarded(n_bytes)
        if len(found) < n_bytes:
            raise InvalidScan(
                self._path,
                f"the voxels end {n_bytes - len(found):,} bytes early",
                "a whole file",
                "it may be truncated",
            )
        return found

    def _guarded(self, n_bytes: int) -> bytes:
        try:
            return self._file.read(n_bytes)  # type: ignore[attr-defined]
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            found = "its checksum is wrong" if "CRC" in str(error) else "does not decompress"
            raise InvalidScan(self._path, found, "a whole file", "it may be truncated") from error
        except OSError as error:
            if error.errno is not None:
                raise
            raise InvalidScan(self._path, "does not decompress", "a whole file") from error


class _Inflated:
    """What a zlib stream holds, some bytes at a time."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._inflate, self._waiting = file, zlib.decompressobj(), bytearray()

    def read(self, n_bytes: int) -> bytes:
        while len(self._waiting) < n_bytes and not self._inflate.eof:
            packed = self._inflate.unconsumed_tail or self._file.read(PIECE)
            if not packed:
                break
            self._waiting += self._inflate.decompress(packed, PIECE)
        found = bytes(self._waiting[:n_bytes])
        del self._waiting[:n_bytes]
        return found


class _Text:
    """Slices of voxels written as numbers with blanks between them."""

    def __init__(self, stream: Stream, path: str, file: BinaryIO, n_items: int) -> None:
        self._path, self._file, self._dtype, self._n_items = path, file, stream.dtype, n_items
        for _ in range(stream.skip_lines):
            file.readline()
        file.seek(max(0, stream.skip_bytes), os.SEEK_CUR)
        self._waiting: list[bytes] = []
        self._rest = b""

    def skip(self, n_slices: int) -> None:
        for _ in range(n_slices):
            self._take(self._n_items)

    def items(self) -> np.ndarray:
        words = self._take(self._n_items)
        try:
            return np.array(words).astype(np.float64).astype(self._dtype)
        except ValueError as error:
            raise InvalidScan(
                self._path, f"{_odd(words)!r} among its numbers", "numbers with blanks between them"
            ) from error

    def has_more(self) -> bool:
        self._fill(1)
        return bool(self._waiting)

    def _take(self, n: int) -> list[bytes]:
        self._fill(n)
        if len(self._waiting) < n:
            raise InvalidScan(self._path, f"the voxels end {n - len(self._waiting):,} numbers early", "a whole file")
        taken, self._waiting = self._waiting[:n], self._waiting[n:]
        return taken

    def _fill(self, n: int) -> None:
        while len(self._waiting) < n:
            read = self._file.read(PIECE)
            words = (self._rest + read).split()
            cut = bool(read) and not read[-1:].isspace() and bool(words)
            self._rest = words.pop() if cut else b""
            self._waiting += words
            if not read:
                return


def _reader(stream: Stream, path: str, file: BinaryIO, n_items: int) -> _Bytes | _Text:
    return (_Text if stream.encoding == "text" else _Bytes)(stream, path, file, n_items)


def _odd(words: list[bytes]) -> str:
    """The first of `words` that is no number."""
    for word in words:
        try:
            float(word)
        except ValueError:
            return word.decode("utf-8", "replace")[:40]
    return ""
