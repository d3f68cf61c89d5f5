"""Arrays of a stage's folder: zarr v3, one chunk a block of splats, written whole by one task.

Uncompressed: they are read back within minutes, mostly from the disk cache.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import math
import os
import shutil
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import zarr

from storage import zarr_config  # noqa: F401 (for its effect)
from storage.whole import whole

BLOCK = 16384  # splats a task: two groups
# Chunks are files c.0.0 of the array's folder: zarr's usual c/0/0 is a new folder a chunk, which takes longer than most chunks' bytes.
CHUNK_KEYS = {"name": "default", "separator": "."}


def create(
    folder: Path, name: str, shape: tuple[int, ...], dtype: str, chunks: tuple[int, ...] | None = None
) -> zarr.Array:
    """A new array of a stage, zeros until written; a chunk, by default BLOCK rows, is what one task owns."""
    chunks = tuple(max(1, min(c, s)) for c, s in zip(chunks or (BLOCK, *shape[1:]), shape))
    return zarr.create_array(
        store=str(folder / f"{name}.zarr"), shape=shape, chunks=chunks, dtype=dtype, compressors=None, overwrite=True,
        fill_value=0, chunk_key_encoding=CHUNK_KEYS,
    )


def store(folder: Path, name: str, rows: np.ndarray, chunks: tuple[int, ...] | None = None) -> None:
    """A whole array in one call, there under its name whole or not at all. For tasks, which may run more than once, also
    side by side: where it is there already it stays, for equal tasks make equal bytes."""
    aside = _aside(name)
    create(folder, aside, rows.shape, str(rows.dtype), chunks)[:] = rows
    _give_name(folder, aside, name)


def _aside(name: str) -> str:
    return f"{name}.{uuid.uuid4().hex}.partial"


def _give_name(folder: Path, aside: str, name: str) -> None:
    made = folder / f"{aside}.zarr"
    try:
        os.rename(made, folder / f"{name}.zarr")
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        shutil.rmtree(made, ignore_errors=True)


def exists(folder: Path, name: str) -> bool:
    return (folder / f"{name}.zarr" / "zarr.json").is_file()


def opened(folder: Path, name: str, mode: str = "r") -> zarr.Array:
    return zarr.open_array(store=str(folder / f"{name}.zarr"), mode=mode)


def read(folder: Path, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
    """Rows start..stop. Chunks of whole rows are read as the files they are: zarr takes ten times as long for a small one, and a
    task reads ten of them."""
    array = _opened_once(folder, name)
    stop = min(array.shape[0], array.shape[0] if stop is None else stop)
    if array.chunks[1:] == array.shape[1:] and 0 <= start < stop:
        with contextlib.suppress(FileNotFoundError):  # a chunk that was never written: zarr makes zeros of it
            return _piece(folder, name, start, stop)
    return np.asarray(array[start:stop])


def mapped(folder: Path, name: str) -> np.ndarray:
    """An array of one chunk, read from disk where it is looked at."""
    array = opened(folder, name)
    assert array.chunks == array.shape and not array.compressors, (array.shape, array.chunks)
    return _chunk(folder, name, array, 0)


def read_window(folder: Path, name: str, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    """Rows top..bottom and columns left..right of a picture (h, w, channels) in tiles, which must lie in it; only what is
    in the window is read from disk."""
    array = _opened_once(folder, name)
    height, width, _ = array.chunks
    assert not array.compressors and 0 <= top < bottom <= array.shape[0] and 0 <= left < right <= array.shape[1]
    result = np.empty((bottom - top, right - left, array.shape[2]), array.dtype)
    for i in range(top // height, -(-bottom // height)):
        for j in range(left // width, -(-right // width)):
            y, x = slice(max(top, i * height), min(bottom, (i + 1) * height)), slice(max(left, j * width), min(right, (j + 1) * width))
            tile = _chunk(folder, name, array, i, j)[y.start - i * height : y.stop - i * height, x.start - j * width : x.stop - j * width]
            result[y.start - top : y.stop - top, x.start - left : x.stop - left] = tile
    return result


@functools.lru_cache(maxsize=1024)
def _opened_once(folder: Path, name: str, mode: str = "r") -> zarr.Array:
    """An array that is read part by part, whose shape changes no more; opening it takes longer than reading a part."""
    return opened(folder, name, mode)


def _chunk(folder: Path, name: str, array: zarr.Array, *index: int) -> np.memmap:
    return np.memmap(_path_of(folder, name, array, *index), array.dtype, "r", shape=tuple(array.chunks))


def _path_of(folder: Path, name: str, array: zarr.Array, *index: int) -> Path:
    """The file of a chunk by its first indices; the others are 0."""
    return folder / f"{name}.zarr" / ".".join(["c", *map(str, index), *"0" * (len(array.shape) - len(index))])


def read_rows(folder: Path, name: str, rows: np.ndarray) -> np.ndarray:
    """The rows with these numbers, ascending, of an array whose chunks are whole rows; only they are read from disk."""
    array = opened(folder, name)
    n_rows, *rest = array.chunks
    assert array.shape[1:] == tuple(rest) and not array.compressors, (array.shape, array.chunks)
    result = np.empty((len(rows), *rest), array.dtype)
    ends = np.searchsorted(rows, np.arange(0, array.shape[0] + n_rows, n_rows))
    for chunk, (first, end) in enumerate(zip(ends, ends[1:])):
        if first < end:
            result[first:end] = _chunk(folder, name, array, chunk)[rows[first:end] - chunk * n_rows]
    return result


def pieces(folder: Path, name: str, start: int, stop: int, rows: int) -> Iterator[tuple[int, np.ndarray]]:
    """Rows start..stop of an array of whole rows, `rows` at a time, each with its first row; while one is worked on the next
    is read."""
    with ThreadPoolExecutor(1) as reader:
        begins = range(start, stop, rows)
        ahead = [reader.submit(_piece, folder, name, at, min(at + rows, stop)) for at in begins[:1]]
        for at, following in zip(begins, [*begins[1:], stop]):
            piece = ahead.pop().result()
            if following < stop:
                ahead.append(reader.submit(_piece, folder, name, following, min(following + rows, stop)))
            yield at, piece


def _piece(folder: Path, name: str, start: int, stop: int) -> np.ndarray:
    array = _opened_once(folder, name)
    n_rows, *rest = array.chunks
    assert array.shape[1:] == tuple(rest) and not array.compressors, (array.shape, array.chunks)
    result = np.empty((stop - start, *rest), array.dtype)
    for chunk in range(start // n_rows, -(-stop // n_rows)):
        first, end = max(start, chunk * n_rows), min(stop, (chunk + 1) * n_rows)
        result[first - start : end - start] = _chunk(folder, name, array, chunk)[first - chunk * n_rows : end - chunk * n_rows]
    return result


def write(folder: Path, name: str, start: int, rows: np.ndarray) -> None:
    """Rows from `start` on. The caller owns every chunk that they touch. Raises ValueError where they do not fit.

    Whole chunks of whole rows are written as the files they are: on their way through zarr 50 MB are copied twice into memory that is
    new to the process, which took three quarters of the time.
    """
    array = _opened_once(folder, name, "r+")
    n_rows, stop = array.chunks[0], start + len(rows)
    if rows.shape[1:] != array.shape[1:] or stop > array.shape[0]:
        raise ValueError(f"{name} from row {start} on: {rows.shape}; allowed: rows of {array.shape}")
    if array.chunks[1:] != array.shape[1:] or start % n_rows or (stop % n_rows and stop != array.shape[0]):
        array[start:stop] = rows
        return
    _write_chunks(folder, name, array, start, np.ascontiguousarray(rows, array.dtype))


def _write_chunks(folder: Path, name: str, array: zarr.Array, start: int, rows: np.ndarray) -> None:
    n_rows = array.chunks[0]
    for at in range(0, len(rows), n_rows):
        _write_chunk(_path_of(folder, name, array, (start + at) // n_rows), rows[at : at + n_rows], array.chunks)


def _write_chunk(path: Path, rows: np.ndarray, shape: tuple[int, ...]) -> None:
    """A chunk's file, there whole or not at all; what it has beyond `rows` is zeros."""
    with whole(path) as partial, open(partial, "wb") as file:
        file.write(rows.data)
        file.truncate(rows.itemsize * math.prod(shape))


def block_range(index: int, n: int, rows: int = BLOCK) -> tuple[int, int]:
    """First row and end of block `index` of `n` rows."""
    return index * rows, min((index + 1) * rows, n)


def n_blocks(n: int, rows: int = BLOCK) -> int:
    return -(-n // rows)


class Appender:
    """Rows of unknown number, appended in order by one process, in whole chunks; there under their name once closed."""

    def __init__(self, folder: Path, name: str, row_shape: tuple[int, ...], dtype: str, rows: int = BLOCK) -> None:
        self._folder, self._name, self._made_as = folder, name, _aside(name)
        self._array = zarr.create_array(
            store=str(folder / f"{self._made_as}.zarr"), shape=(0, *row_shape), chunks=(rows, *row_shape), dtype=dtype,
            compressors=None, overwrite=True, fill_value=0, chunk_key_encoding=CHUNK_KEYS,
        )
        self._rows, self._waiting, self._n_waiting, self._n_written = rows, [], 0, 0

    def append(self, rows: np.ndarray) -> None:
        self._waiting.append(rows)
        self._n_waiting += len(rows)
        if self._n_waiting >= self._rows:
            self._write(self._n_waiting - self._n_waiting % self._rows)

    def close(self) -> int:
        """Write what waits; returns the number of rows."""
        self._write(self._n_waiting)
        self._array.resize((self._n_written, *self._array.shape[1:]))
        _give_name(self._folder, self._made_as, self._name)
        return self._n_written

    def _write(self, n: int) -> None:
        if not n:
            return
        rows = np.concatenate(self._waiting)
        _write_chunks(self._folder, self._made_as, self._array, self._n_written, np.ascontiguousarray(rows[:n], self._array.dtype))
        self._waiting, self._n_waiting, self._n_written = [rows[n:]], len(rows) - n, self._n_written + n
