"""Points in file order -> leaves that fit into memory, from counts per cell of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.cells import CellCounts, Grid, bits_for, count_cells, grid_of, merge_counts
from pipeline.geometry.leaves import Leaves, grow_leaves
from pipeline.stages.points.kept import finite_pieces, n_kept, n_parts, origin_of, part_range
from pipeline.summaries import Counted, LeavesGrown, ScanRead
from storage.work import arrays, work

IN_MEMORY = 1 << 20  # points: 60 MB of records, and as much again twice while they are put in order
MERGED = 64  # parts whose counts are held at once


@dataclass(frozen=True)
class GridCounts:
    """A task a part of the points. Arrays: edges (3, n) float64 of the grid, against the origin; cell (m,) int32, begin
    and leaf (m,) and start (n_leaves + 1,) int64 as in `Leaves`; n_before (n_parts, k) int64, of divided cells, the
    points before each part."""

    ingest: Path
    thinned: Path | None = None  # which points are kept, where not all are
    name = "grid-counts"

    def init(self, folder: Path) -> int:
        sample = arrays.read(self.ingest, "sample")
        sample = sample[np.isfinite(sample).all(axis=1)] - origin_of(work.summary(self.ingest, ScanRead))
        arrays.store(folder, "edges", grid_of(sample, bits_for(n_kept(self.ingest, self.thinned) / IN_MEMORY)).edges)
        return n_parts(self.ingest)

    def run(self, folder: Path, index: int) -> Counted:
        grid, rows = Grid(arrays.read(folder, "edges")), part_range(self.ingest, index)
        pieces = finite_pieces(self.ingest, *rows, ("position",), self.thinned)
        cell = np.concatenate([grid.cells_of(piece["position"]) for piece in pieces])
        counts = count_cells(cell)
        work.write_parts(_counts_of(folder, index), cell=counts.cell, count=counts.count)
        return Counted(len(cell))

    def finalise(self, folder: Path, results: list[Counted]) -> LeavesGrown:
        n = sum(r.n_splats for r in results)
        points, grid = work.summary(self.ingest, ScanRead), Grid(arrays.read(folder, "edges"))
        parts = [_counts_of(folder, i) for i in range(len(results))]
        low, high = np.array(points.low) - origin_of(points), np.array(points.high) - origin_of(points)
        leaves = grow_leaves(_merged(parts), grid, low, high, IN_MEMORY)
        for name in ("cell", "begin", "leaf", "start"):
            arrays.store(folder, name, rows := getattr(leaves, name), rows.shape)
        if len(leaves.divided):
            before = before_parts(parts, leaves.divided)
            arrays.store(folder, "n_before", before, (1, before.shape[1]))
        return LeavesGrown(n, leaves.n_leaves)


def leaves_of(counts: Path) -> Leaves:
    """The leaves that a finished stage grew."""
    return Leaves(*(arrays.read(counts, name) for name in ("cell", "begin", "leaf", "start")))


def n_before_part(counts: Path, leaves: Leaves, index: int) -> np.ndarray:
    """Of each divided cell the points before a part, (k,) int64."""
    return arrays.read(counts, "n_before", index, index + 1)[0] if len(leaves.divided) else np.empty(0, np.int64)


def before_parts(parts: list[Path], cells: np.ndarray) -> np.ndarray:
    """Of `cells` (k,) the points before each part, (n_parts, k) int64."""
    before = np.zeros((len(parts), len(cells)), np.int64)
    for i, counts in enumerate(map(_read, parts[:-1])):
        before[i + 1] = before[i] + _counts_in(counts, cells)
    return before


def _counts_of(folder: Path, index: int) -> Path:
    return work.parts(folder) / f"{index:06d}.npz"


def _read(path: Path) -> CellCounts:
    with work.open_parts(path) as part:
        return CellCounts(part["cell"], part["count"])


def _merged(parts: list[Path]) -> CellCounts:
    """The counts of all parts, MERGED of them at a time."""
    found = CellCounts(np.empty(0, np.int32), np.empty(0, np.int64))
    for at in range(0, len(parts), MERGED):
        found = merge_counts([found, *map(_read, parts[at : at + MERGED])])
    return found


def _counts_in(counts: CellCounts, cells: np.ndarray) -> np.ndarray:
    """The counts of `cells` (k,), 0 where there are none."""
    at = np.minimum(np.searchsorted(counts.cell, cells), max(0, len(counts.cell) - 1))
    return (
        np.where(counts.cell[at] == cells, counts.count[at], 0) if len(counts.cell) else np.zeros(len(cells), np.int64)
    )
