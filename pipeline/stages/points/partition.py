"""Points in file order -> points in chunk order: the recursive median split, out of core.

Nodes that fit into memory are split there (pipeline/geometry/chunks.py); larger ones are streamed: bounds, the exact
median by two histograms, then two runs. Ties go by file order in both, so the order does not depend on the limit.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.chunks import bounds, longest_axis, median_split, split_rank
from pipeline.numerics.hashing import uniform_hash
from storage.errors import InvalidScan, ResourceExhausted
from storage.work import arrays, work

IN_MEMORY = 1 << 20  # points: 60 MB of records, and as much again twice while they are put in order
PIECE = 1 << 16
BINS = 1 << 12
DENSITY_SEED = 1 << 63  # beyond every job's seed: which points are kept tells nothing of which are learned from


@dataclass(frozen=True)
class Partition:
    """One task: it rewrites the whole scan. Arrays as the ingest's, in chunk order, position against `origin`; and
    point (n,) uint32, each one's place in the ingest, which unlike its place here does not turn with the scan.

    A `density` below 1 keeps that share of the points, by hash of their place in the ingest.

    Raises: InvalidScan where none is left.
    """

    ingest: Path
    density: float = 1.0
    name = "partition"

    def init(self, folder: Path) -> int:
        n = self._n_kept()
        if not n:
            n_points = work.summary(self.ingest)["n_points"]
            raise InvalidScan(
                "density", f"{self.density:g} keeps none of {n_points:,} points", f"{1 / n_points:.2g} and more"
            )
        for name, dtype in _columns(self.ingest).items():
            arrays.create(folder, name, (n, *dtype.shape), str(dtype.base))
        return 1

    def run(self, folder: Path, index: int) -> dict:
        points = work.summary(self.ingest)
        n, origin = self._n_kept(), np.array(_origin(points))
        if n <= IN_MEMORY:
            pieces = list(_pieces_of(self.ingest, self.density, origin))
            _write_in_order(folder, 0, {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]})
            return {"n_splats": n}
        work.parts(folder).mkdir(exist_ok=True)
        scratch = [work.parts(folder) / f"{uuid.uuid4().hex}.bin" for _ in range(2)]
        record = np.dtype([(name, dtype.base, dtype.shape) for name, dtype in _columns(self.ingest).items()])
        try:
            _copy_records(self.ingest, scratch[0], record, self.density, origin)
            _split(scratch, record, 0, n, folder)
        except OSError as error:
            raise ResourceExhausted(
                f"stage {self.name}", f"{error.strerror or error}", f"room for {2 * n * record.itemsize} bytes"
            ) from error
        finally:
            for path in scratch:
                path.unlink(missing_ok=True)
        return {"n_splats": n}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        points = work.summary(self.ingest)
        n = self._n_kept()
        of_blocks = [
            bounds(arrays.read(folder, "position", *arrays.block_range(i, n))) for i in range(arrays.n_blocks(n))
        ]
        low, high = np.array(of_blocks).transpose(1, 0, 2)
        return {"n_splats": n, "origin": _origin(points), "block_low": low.tolist(), "block_high": high.tolist()}

    def _n_kept(self) -> int:
        n = work.summary(self.ingest)["n_points"]
        return sum(len(rows) for rows in _kept_rows(n, self.density)) if self.density < 1 else n


def _origin(points: dict) -> list[float]:
    """The middle of the scan's bounds."""
    return [(a + b) / 2 for a, b in zip(points["low"], points["high"])]


def columns_of(points: Path) -> dict[str, np.dtype]:
    names = ("position", "normal", "color", "intensity", "station", "candidate", "point")
    found = {name: arrays.layout_of(points, name) for name in names if arrays.exists(points, name)}
    return {name: np.dtype((layout.dtype, layout.shape[1:])) for name, layout in found.items()}


def _columns(ingest: Path) -> dict[str, np.dtype]:
    return columns_of(ingest) | {"point": np.dtype(np.uint32)}


def _kept_rows(n: int, density: float) -> Iterator[np.ndarray]:
    """Places in the ingest of the points that are kept, a block of it at a time."""
    for start in range(0, n, arrays.BLOCK):
        rows = np.arange(start, min(n, start + arrays.BLOCK))
        yield rows if density >= 1 else rows[uniform_hash(rows, DENSITY_SEED) < density]


def _pieces_of(ingest: Path, density: float, origin: np.ndarray) -> Iterator[dict[str, np.ndarray]]:
    """The points that are kept, by column, a block of the ingest at a time."""
    names = columns_of(ingest)
    for kept in _kept_rows(work.summary(ingest)["n_points"], density):
        if not len(kept):
            continue
        start, stop = kept[0], kept[-1] + 1
        every = stop - start == len(kept)
        rows = {name: arrays.read(ingest, name, start, stop) for name in names}
        rows = {name: column if every else column[kept - start] for name, column in rows.items()}
        yield rows | {"point": kept.astype(np.uint32), "position": rows["position"] - origin}


def _copy_records(ingest: Path, scratch: Path, record: np.dtype, density: float, origin: np.ndarray) -> None:
    with open(scratch, "wb") as file:
        for columns in _pieces_of(ingest, density, origin):
            rows = np.empty(len(columns["point"]), record)
            for name, column in columns.items():
                rows[name] = column
            rows.tofile(file)


def _write_in_order(folder: Path, start: int, columns: dict[str, np.ndarray]) -> None:
    order = median_split(columns["position"])
    for name, column in columns.items():
        arrays.write(folder, name, start, column[order])


def _split(scratch: list[Path], record: np.dtype, start: int, stop: int, folder: Path) -> None:
    """Split rows start..stop of scratch[0]; scratch[1] is free to use in the same rows."""
    if stop - start <= IN_MEMORY:
        rows = _read(scratch[0], record, start, stop)
        _write_in_order(folder, start, {name: np.ascontiguousarray(rows[name]) for name in record.names})
        return
    low, high = _extent(scratch[0], record, start, stop)
    axis = longest_axis(low, high)
    n_left = split_rank(stop - start)
    value, n_ties = _order_statistic(scratch[0], record, start, stop, axis, n_left, low[axis], high[axis])
    _distribute(scratch, record, start, stop, axis, n_left, value, n_ties)
    _split(scratch[::-1], record, start, start + n_left, folder)
    _split(scratch[::-1], record, start + n_left, stop, folder)


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


def _order_statistic(path, record, start, stop, axis, rank, low, high) -> tuple[float, int]:
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
        if counts[bin_] <= IN_MEMORY or (bin_low, bin_high) == (low, high):
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
