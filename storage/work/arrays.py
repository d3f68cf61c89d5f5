"""Arrays of a stage's folder: zarr v3, one chunk a block of splats, written whole by one task.

Uncompressed: they are read back within minutes, mostly from the disk cache. A chunk is then a file of plain numbers,
and is written and read as one; so is what describes an array. A job makes 200 arrays and looks at 4,000: through zarr
that took a second and a half of its 20, and chunks of 50 MB were copied twice on their way. Whatever else there is to
do with an array, zarr does (`opened`).
"""

from __future__ import annotations

import errno
import functools
import json
import math
import mmap
import os
import shutil
import uuid
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import zarr

from storage import (
    place,
    zarr_config,  # noqa: F401 (for its effect)
)
from storage.whole import whole
from storage.work.layout import BLOCK, METADATA, Layout, layout_for


def create(folder: Path, name: str, shape: tuple[int, ...], dtype: str, chunks: tuple[int, ...] | None = None) -> None:
    """A new array of a stage, zeros until written; a chunk, by default BLOCK rows, is what one task owns."""
    if not place.is_remote(folder):  # there nothing is written before all of a stage's arrays are described
        shutil.rmtree(folder / f"{name}.zarr", ignore_errors=True)
    _describe(folder, name, layout_for(shape, dtype, chunks))


def _describe(folder: Path, name: str, layout: Layout) -> None:
    place.make_folder(folder / f"{name}.zarr")
    with whole(folder / f"{name}.zarr" / METADATA) as partial:
        partial.write_text(json.dumps(layout.to_json()))


def store(folder: Path, name: str, rows: np.ndarray, chunks: tuple[int, ...] | None = None) -> None:
    """A whole array in one call, of chunks of whole rows, there under its name whole or not at all. For tasks, which
    may run more than once, also side by side: where it is there already it stays, for equal tasks make equal bytes."""
    aside, layout = _aside(folder, name), layout_for(rows.shape, str(rows.dtype), chunks)
    assert layout.of_whole_rows, layout
    place.make_folder(folder / f"{aside}.zarr")
    _write_chunks(folder, aside, layout, 0, rows)
    _describe(folder, aside, layout)
    _give_name(folder, aside, name)


def _aside(folder: Path, name: str) -> str:
    """What an array is called until it is whole. A bucket renames nothing: there an array is no array until its last
    object, the one that describes it."""
    return name if place.is_remote(folder) else f"{name}.{uuid.uuid4().hex}.partial"


def _give_name(folder: Path, aside: str, name: str) -> None:
    if aside == name:
        return
    made = folder / f"{aside}.zarr"
    try:
        os.rename(made, folder / f"{name}.zarr")
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        shutil.rmtree(made, ignore_errors=True)


def exists(folder: Path, name: str) -> bool:
    """Whether a stage's folder has an array of that name."""
    return place.is_file(folder / f"{name}.zarr" / METADATA)


def names(folder: Path) -> list[str]:
    """Of the arrays in a folder, in order."""
    return [name.removesuffix(".zarr") for name in place.names(folder) if name.endswith(".zarr")]


def opened(folder: Path, name: str, mode: str = "r") -> zarr.Array:
    """For what is done to part of a chunk, or to more than rows."""
    return zarr.open_array(store=place.zarr_store(folder / f"{name}.zarr"), mode=mode)


@functools.lru_cache(maxsize=1024)
def layout_of(folder: Path, name: str) -> Layout:
    """Of an array whose shape changes no more."""
    told = json.loads(place.here(folder / f"{name}.zarr" / METADATA).read_text())
    layout = Layout(
        tuple(told["shape"]), tuple(told["chunk_grid"]["configuration"]["chunk_shape"]), np.dtype(told["data_type"])
    )
    assert told == layout.to_json(), f"{name}: not an array that is made here"
    return layout


def read(folder: Path, name: str, start: int = 0, stop: int | None = None) -> np.ndarray:
    """Rows start..stop."""
    layout = layout_of(folder, name)
    stop = min(layout.shape[0], layout.shape[0] if stop is None else stop)
    if layout.of_whole_rows and 0 <= start < stop:
        return _piece(folder, name, start, stop)
    return np.asarray(opened(folder, name)[start:stop])


def mapped(folder: Path, name: str) -> np.ndarray:
    """An array of one chunk, read from disk where it is looked at."""
    layout = layout_of(folder, name)
    assert layout.chunks == layout.shape, layout
    return _chunk(folder, name, layout, 0)


def read_window(folder: Path, name: str, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    """Rows top..bottom and columns left..right of a picture (h, w, channels) in tiles, which must lie in it; only what
    is in the window is read from disk."""
    layout = layout_of(folder, name)
    height, width, _ = layout.chunks
    assert 0 <= top < bottom <= layout.shape[0] and 0 <= left < right <= layout.shape[1]
    result = np.empty((bottom - top, right - left, layout.shape[2]), layout.dtype)
    for i in range(top // height, -(-bottom // height)):
        for j in range(left // width, -(-right // width)):
            y, x = (
                slice(max(top, i * height), min(bottom, (i + 1) * height)),
                slice(max(left, j * width), min(right, (j + 1) * width)),
            )
            tile = _chunk(folder, name, layout, i, j)[
                y.start - i * height : y.stop - i * height, x.start - j * width : x.stop - j * width
            ]
            result[y.start - top : y.stop - top, x.start - left : x.stop - left] = tile
    return result


def write_picture(folder: Path, name: str, pixels: np.ndarray) -> None:
    """All of a picture (h, w, channels) in tiles, which the caller owns. Raises ValueError where it does not fit."""
    layout = layout_of(folder, name)
    if pixels.shape != layout.shape:
        raise ValueError(f"{name}: {pixels.shape}; allowed: {layout.shape}")
    height, width, _ = layout.chunks
    for top in range(0, pixels.shape[0], height):
        for left in range(0, pixels.shape[1], width):
            tile = np.zeros(layout.chunks, layout.dtype)
            part = pixels[top : top + height, left : left + width]
            tile[: part.shape[0], : part.shape[1]] = part
            _write_chunk(_path_of(folder, name, layout, top // height, left // width), tile, layout)


def _chunk(folder: Path, name: str, layout: Layout, *index: int) -> np.memmap:
    file = place.here(_path_of(folder, name, layout, *index))
    return np.memmap(file, layout.dtype, "r", shape=layout.chunks)


def _path_of(folder: Path, name: str, layout: Layout, *index: int) -> Path:
    """The file of a chunk by its first indices; the others are 0."""
    return folder / f"{name}.zarr" / ".".join(["c", *map(str, index), *"0" * (len(layout.shape) - len(index))])


def read_rows(folder: Path, name: str, rows: np.ndarray) -> np.ndarray:
    """The rows with these numbers, ascending, of an array whose chunks are whole rows; only they are read from disk."""
    layout = layout_of(folder, name)
    n_rows, *rest = layout.chunks
    assert layout.of_whole_rows, layout
    result = np.empty((len(rows), *rest), layout.dtype)
    ends = np.searchsorted(rows, np.arange(0, layout.shape[0] + n_rows, n_rows))
    for chunk, (first, end) in enumerate(zip(ends, ends[1:])):
        if first < end:
            result[first:end] = _chunk(folder, name, layout, chunk)[rows[first:end] - chunk * n_rows]
    return result


def pieces(folder: Path, name: str, start: int, stop: int, rows: int) -> Iterator[tuple[int, np.ndarray]]:
    """Rows start..stop of an array of whole rows, `rows` at a time and less at the end of a chunk, each with its first
    row, not to be written to: they are not copied out of the disk cache, and while one is worked on the disk is told to
    read the next."""
    layout = layout_of(folder, name)
    assert layout.of_whole_rows, layout
    n_rows = layout.chunks[0]
    for chunk in range(start // n_rows, -(-stop // n_rows)):
        first, end = max(start, chunk * n_rows), min(stop, (chunk + 1) * n_rows)
        there = _chunk(folder, name, layout, chunk)
        for at in range(first, end, rows):
            _read_ahead(there, at + rows - chunk * n_rows, rows)
            yield at, np.asarray(there[at - chunk * n_rows : min(at + rows, end) - chunk * n_rows])


def _read_ahead(there: np.memmap, start: int, n: int) -> None:
    begin, end = (min(i, len(there)) * there[0].nbytes for i in (start, start + n))
    begin -= begin % mmap.PAGESIZE
    if begin < end and hasattr(mmap, "MADV_WILLNEED"):
        there.base.madvise(mmap.MADV_WILLNEED, begin, end - begin)  # type: ignore[attr-defined]


def _piece(folder: Path, name: str, start: int, stop: int) -> np.ndarray:
    layout = layout_of(folder, name)
    n_rows, *rest = layout.chunks
    assert layout.of_whole_rows, layout
    result = np.empty((stop - start, *rest), layout.dtype)
    for chunk in range(start // n_rows, -(-stop // n_rows)):
        first, end = max(start, chunk * n_rows), min(stop, (chunk + 1) * n_rows)
        try:
            result[first - start : end - start] = _chunk(folder, name, layout, chunk)[
                first - chunk * n_rows : end - chunk * n_rows
            ]
        except FileNotFoundError:  # it was never written
            result[first - start : end - start] = 0
    return result


def write(folder: Path, name: str, start: int, rows: np.ndarray) -> None:
    """Rows from `start` on. The caller owns every chunk that they touch. Raises ValueError where they do not fit."""
    layout = layout_of(folder, name)
    n_rows, stop = layout.chunks[0], start + len(rows)
    if rows.shape[1:] != layout.shape[1:] or stop > layout.shape[0]:
        raise ValueError(f"{name} from row {start} on: {rows.shape}; allowed: rows of {layout.shape}")
    if layout.of_whole_rows and not start % n_rows and (not stop % n_rows or stop == layout.shape[0]):
        _write_chunks(folder, name, layout, start, rows)
    else:
        opened(folder, name, "r+")[start:stop] = rows


def _write_chunks(folder: Path, name: str, layout: Layout, start: int, rows: np.ndarray) -> None:
    n_rows, rows = layout.chunks[0], np.ascontiguousarray(rows, layout.dtype)
    for at in range(0, len(rows), n_rows):
        _write_chunk(_path_of(folder, name, layout, (start + at) // n_rows), rows[at : at + n_rows], layout)


def _write_chunk(path: Path, rows: np.ndarray, layout: Layout) -> None:
    """A chunk's file, there whole or not at all; what it has beyond `rows` is zeros."""
    with whole(path) as partial, open(partial, "wb") as file:
        file.write(rows.data)
        file.truncate(layout.dtype.itemsize * math.prod(layout.chunks))


def block_range(index: int, n: int, rows: int = BLOCK) -> tuple[int, int]:
    """First row and end of block `index` of `n` rows."""
    return index * rows, min((index + 1) * rows, n)


def n_blocks(n: int, rows: int = BLOCK) -> int:
    """How many blocks of `rows` rows `n` rows are; the last may be shorter."""
    return -(-n // rows)


class Appender:
    """Rows of unknown number, appended in order by one process, in whole chunks; there under their name once closed."""

    def __init__(self, folder: Path, name: str, row_shape: tuple[int, ...], dtype: str, rows: int = BLOCK) -> None:
        self._folder, self._name, self._made_as = folder, name, _aside(folder, name)
        self._layout = Layout((0, *row_shape), (rows, *row_shape), np.dtype(dtype))
        self._waiting: list = []
        self._n_waiting = 0
        place.make_folder(folder / f"{self._made_as}.zarr")

    def append(self, rows: np.ndarray) -> None:
        self._waiting.append(rows)
        self._n_waiting += len(rows)
        if self._n_waiting >= self._layout.chunks[0]:
            self._write(self._n_waiting - self._n_waiting % self._layout.chunks[0])

    def close(self) -> int:
        """Write what waits; returns the number of rows."""
        if self._n_waiting:
            self._write(self._n_waiting)
        _describe(self._folder, self._made_as, self._layout)
        _give_name(self._folder, self._made_as, self._name)
        return self._layout.shape[0]

    def _write(self, n: int) -> None:
        rows, n_written = np.concatenate(self._waiting), self._layout.shape[0]
        _write_chunks(self._folder, self._made_as, self._layout, n_written, rows[:n])
        self._layout = replace(self._layout, shape=(n_written + n, *self._layout.shape[1:]))
        self._waiting, self._n_waiting = [rows[n:]], len(rows) - n
