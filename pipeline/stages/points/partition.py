"""Points in file order -> points in chunk order: the recursive median split, a leaf a task."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.chunks import bounds, median_split
from pipeline.splats.boxes import store_boxes
from pipeline.stages.points.grid_counts import IN_MEMORY
from pipeline.stages.points.kept import (
    columns_made_of,
    finite_pieces,
    n_kept,
    n_rows,
    origin_of,
    record_of,
)
from pipeline.stages.points.leaves import records_of_leaf
from pipeline.stages.points.split_on_disk import PIECE, split_on_disk
from pipeline.summaries import Points, ScanRead
from storage import place
from storage.work import arrays, work


@dataclass(frozen=True)
class OrderedPart:
    """What a task tells of its points: the box of each of their blocks."""

    n_splats: int
    block_low: list[list[float]]
    block_high: list[list[float]]


@dataclass(frozen=True)
class Partition:
    """A task a leaf; without leaves the whole scan is one. Arrays as the ingest's, in chunk order, position against
    `origin`; and point (n,) int64, each one's place in the ingest, which unlike its place here does not turn with the
    scan."""

    ingest: Path
    thinned: Path | None = None  # which points are kept, where not all are; the leaves are of as many
    counts: Path | None = None  # of the grid, which say where each leaf begins
    dealt: Path | None = None  # the records of each leaf
    name = "partition"

    def init(self, folder: Path) -> int:
        starts = self._starts()
        for name, dtype in columns_made_of(self.ingest).items():
            arrays.create(folder, name, (starts[-1], *dtype.shape), str(dtype.base))
        return len(starts) - 1

    def run(self, folder: Path, index: int) -> OrderedPart:
        start, stop = self._starts()[index : index + 2]
        boxes: list[np.ndarray] = []

        def write(first: int, rows: np.ndarray) -> None:
            columns = {name: np.ascontiguousarray(rows[name]) for name in rows.dtype.names}
            boxes.append(_write_in_order(folder, start + first, columns))

        n, record = stop - start, record_of(self.ingest)
        if n <= IN_MEMORY:
            rows, at = np.empty(n, record), 0
            for piece in self._records(index, record):
                rows[at : at + len(piece)] = piece
                at += len(piece)
            write(0, rows)
        else:
            split_on_disk(self._records(index, record), record, n, IN_MEMORY, place.scratch(work.parts(folder)), write)
        low, high = np.concatenate(boxes, axis=1)
        return OrderedPart(n_splats=n, block_low=low.tolist(), block_high=high.tolist())

    def finalise(self, folder: Path, results: list[OrderedPart]) -> Points:
        store_boxes(
            folder, *(np.concatenate([getattr(r, name) for r in results]) for name in ("block_low", "block_high"))
        )
        n = sum(r.n_splats for r in results)
        return Points(n, origin_of(work.summary(self.ingest, ScanRead)), (n,))

    def _starts(self) -> list[int]:
        """The first row of each leaf, and the end."""
        if self.counts is None:
            return [0, n_kept(self.ingest, self.thinned)]
        return arrays.read(self.counts, "start").tolist()

    def _records(self, index: int, record: np.dtype) -> Iterator[np.ndarray]:
        """The points of a leaf in file order."""
        if self.dealt is not None:
            yield from records_of_leaf(self.dealt, index, PIECE)
            return
        for columns in finite_pieces(self.ingest, 0, n_rows(self.ingest), thinned=self.thinned):
            rows = np.empty(len(columns["point"]), record)
            for name, column in columns.items():
                rows[name] = column
            yield rows


def _write_in_order(folder: Path, start: int, columns: dict[str, np.ndarray]) -> np.ndarray:
    """Put the points of a node in order and write them; the corners of their blocks, (2, n_blocks, 3)."""
    order = median_split(columns["position"])
    for name, column in columns.items():
        columns[name] = column[order]
        arrays.write(folder, name, start, columns[name])
    position = columns["position"]
    assert start % arrays.BLOCK == 0
    return np.stack([bounds(position[at : at + arrays.BLOCK]) for at in range(0, len(position), arrays.BLOCK)], axis=1)
