"""The median split of points that do not fit into memory, streamed through two files.

A node that fits is split there (`pipeline/geometry/chunks.py`); a larger one takes its bounds, the exact median by
histograms, and one pass that writes its halves behind each other. Ties go by the order of the input in both, so the
order of the points does not depend on what fits.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pipeline.geometry.chunks import bounds, longest_axis, split_rank
from storage.errors import ResourceExhausted

PIECE = 1 << 16
BINS = 1 << 12


def split_on_disk(
    records: Iterator[np.ndarray],
    record: np.dtype,
    n: int,
    in_memory: int,
    scratch: Path,
    write: Callable[[int, np.ndarray], None],
) -> None:
    """Split `n` records, whose field `position` is (3,) float64; `write(first, rows)` gets each node of at most
    `in_memory`, with the place of its first among the n, from the first to the last.

    The folder `scratch` holds both files meanwhile. Raises ResourceExhausted where they do not fit.
    """
    scratch.mkdir(exist_ok=True)
    paths = [scratch / f"{uuid.uuid4().hex}.partial" for _ in range(2)]
    try:
        with open(paths[0], "wb") as file:
            for rows in records:
                rows.tofile(file)
        _split(paths, record, 0, n, in_memory, write)
    except OSError as error:
        allowed = f"room for {2 * n * record.itemsize} bytes"
        raise ResourceExhausted("stage partition", f"{error.strerror or error}", allowed) from error
    finally:
        for path in paths:
            path.unlink(missing_ok=True)


def _split(scratch: list[Path], record: np.dtype, start: int, stop: int, in_memory: int, write: Callable) -> None:
    """Split rows start..stop of scratch[0]; scratch[1] is free to use in the same rows."""
    if stop - start <= in_memory:
        write(start, _read(scratch[0], record, start, stop))
        return
    low, high = _extent(scratch[0], record, start, stop)
    axis = longest_axis(low, high)
    n_left = split_rank(stop - start)
    value, n_ties = _order_statistic(scratch[0], record, start, stop, axis, n_left, low[axis], high[axis], in_memory)
    _distribute(scratch, record, start, stop, axis, n_left, value, n_ties)
    _split(scratch[::-1], record, start, start + n_left, in_memory, write)
    _split(scratch[::-1], record, start + n_left, stop, in_memory, write)


def _read(path: Path, record: np.dtype, start: int, stop: int) -> np.ndarray:
    return np.fromfile(path, record, stop - start, offset=start * record.itemsize)


def _pieces(path: Path, record: np.dtype, start: int, stop: int):
    for at in range(start, stop, PIECE):
        yield _read(path, record, at, min(at + PIECE, stop))


def _extent(path: Path, record: np.dtype, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in _pieces(path, record, start, stop):
        of_piece = bounds(rows["position"])
        low, high = np.minimum(low, of_piece[0]), np.maximum(high, of_piece[1])
    return low, high


def _order_statistic(path, record, start, stop, axis, rank, low, high, in_memory) -> tuple[float, int]:
    """The value that the `rank` lowest coordinates end below or at, and how many of its ties belong to them.

    Narrowed by histograms until what is left fits into memory or is one value.
    """
    n_below = 0
    while low < high:
        edges = np.linspace(low, high, BINS + 1)
        counts = np.zeros(BINS, np.int64)
        for rows in _pieces(path, record, start, stop):
            counts += np.histogram(rows["position"][:, axis], edges)[0]
        running = n_below + np.cumsum(counts)
        bin_ = int(np.searchsorted(running, rank))
        bin_low, bin_high = edges[bin_], edges[bin_ + 1]
        if counts[bin_] <= in_memory or (bin_low, bin_high) == (low, high):
            inside = np.concatenate(
                [
                    x[(x >= bin_low) & (x <= bin_high)]
                    for x in (rows["position"][:, axis] for rows in _pieces(path, record, start, stop))
                ]
            )
            n_below = _count_below(path, record, start, stop, axis, bin_low)
            value = float(np.partition(inside, rank - 1 - n_below)[rank - 1 - n_below])
            return value, rank - _count_below(path, record, start, stop, axis, value)
        n_below = _count_below(path, record, start, stop, axis, bin_low)
        low, high = bin_low, bin_high
    return float(low), rank - n_below


def _count_below(path, record, start, stop, axis, value) -> int:
    return sum(int((rows["position"][:, axis] < value).sum()) for rows in _pieces(path, record, start, stop))


def _distribute(scratch, record, start, stop, axis, n_left, value, n_ties) -> None:
    """Write the two halves behind each other into scratch[1], each in the order it is read, `n_ties` ties left."""
    mode = "r+b" if scratch[1].is_file() else "w+b"
    with open(scratch[1], mode) as left, open(scratch[1], "r+b") as right:
        left.seek(start * record.itemsize)
        right.seek((start + n_left) * record.itemsize)
        for rows in _pieces(scratch[0], record, start, stop):
            x = rows["position"][:, axis]
            tie = x == value
            goes_left = (x < value) | (tie & (np.cumsum(tie) <= n_ties))
            n_ties -= min(n_ties, int(tie.sum()))
            rows[goes_left].tofile(left)
            rows[~goes_left].tofile(right)
