"""Points in file order -> the points of each leaf: every task deals out a part of the file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.cells import Grid
from pipeline.stages.points.grid_counts import leaves_of, n_before_part
from pipeline.stages.points.kept import finite_pieces, n_parts, part_range, record_of
from pipeline.summaries import Counted, LeavesGrown
from storage.work import arrays, work

PART, BEGIN, COUNT = range(3)  # columns of `run`


@dataclass(frozen=True)
class DealtLeaves:
    """A task a part of the points: it writes them as records, leaf by leaf, into a file of its own.

    Arrays: run (m, 3) int64, which part has records of a leaf, from which on, and how many, leaf by leaf and part by
    part; first (n_leaves + 1,) int64, the first run of each leaf. Files: records/<part>.npy (n,) of `record_of`.
    """

    ingest: Path
    counts: Path
    thinned: Path | None = None  # which points are kept, where not all are
    name = "leaves"

    def init(self, folder: Path) -> int:
        return n_parts(self.ingest)

    def run(self, folder: Path, index: int) -> Counted:
        start, stop = part_range(self.ingest, index)
        leaves, grid = leaves_of(self.counts), Grid(arrays.read(self.counts, "edges"))
        records, cell, n = np.empty(stop - start, record_of(self.ingest)), np.empty(stop - start, np.int32), 0
        for piece in finite_pieces(self.ingest, start, stop, thinned=self.thinned):
            rows = slice(n, n + len(piece["point"]))
            cell[rows] = grid.cells_of(piece["position"])
            for name, column in piece.items():
                records[name][rows] = column
            n = rows.stop
        leaf = leaves.of_points(cell[:n], n_before_part(self.counts, leaves, index))
        order = np.argsort(
            leaf.astype(np.min_scalar_type(leaves.n_leaves)), kind="stable"
        )  # 16 bits are sorted by radix
        work.write_part(_records_of(folder, index), records[order])
        count = np.bincount(leaf, minlength=leaves.n_leaves)
        here = np.flatnonzero(count)
        begin = np.cumsum(count[here]) - count[here]
        work.write_parts(_runs_of(folder, index), leaf=here, begin=begin, count=count[here])
        return Counted(n)

    def finalise(self, folder: Path, results: list[Counted]) -> Counted:
        found = []
        for index in range(len(results)):
            with work.open_parts(_runs_of(folder, index)) as part:
                rows = (part["leaf"], np.full(len(part["leaf"]), index), part["begin"], part["count"])
                found.append(np.stack(rows, axis=1).astype(np.int64))
        runs = np.concatenate(found)
        runs = runs[np.argsort(runs[:, 0], kind="stable")]
        n_leaves = work.summary(self.counts, LeavesGrown).n_leaves
        first = np.searchsorted(runs[:, 0], np.arange(n_leaves + 1))
        arrays.store(folder, "run", np.ascontiguousarray(runs[:, 1:]))
        arrays.store(folder, "first", first, first.shape)
        return Counted(sum(r.n_splats for r in results))


def records_of_leaf(dealt: Path, leaf: int, most: int) -> Iterator[np.ndarray]:
    """The records of a leaf in file order, at most so many at a time, not to be written to."""
    first, end = arrays.read(dealt, "first", leaf, leaf + 2)
    for run in arrays.read(dealt, "run", int(first), int(end)):
        there = work.map_part(_records_of(dealt, run[PART]))
        for at in range(run[BEGIN], run[BEGIN] + run[COUNT], most):
            yield np.asarray(there[at : min(at + most, run[BEGIN] + run[COUNT])])


def _records_of(folder: Path, part: int) -> Path:
    return folder / "records" / f"{part:06d}.npy"


def _runs_of(folder: Path, part: int) -> Path:
    return work.parts(folder) / f"{part:06d}.npz"
