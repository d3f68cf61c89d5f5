"""Points counted per cell of a grid, whose slabs hold equal shares of a sample of the points on each axis.

Equal shares, not equal widths: neither one far stray nor a spacing that varies a thousandfold leaves all points in one
cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel

MOST_BITS = 10  # of a slab's number: 1,024 slabs an axis; three of them fit into 32 bits
CELLS_A_LEAF = (
    1 << 10
)  # at least, of a surface, while there are slabs enough: 2^b slabs an axis cut it into about 4^b cells


@dataclass(frozen=True)
class Grid:
    """`edges` (3, 2^bits - 1) ascending float64: slab s of an axis holds edges[s - 1] <= x < edges[s]."""

    edges: np.ndarray

    @property
    def bits(self) -> int:
        return self.edges.shape[1].bit_length()

    def cells_of(self, position: np.ndarray) -> np.ndarray:
        """The cell of each point (n, 3), finite: its slabs' numbers, x above y above z, as one int32."""
        return _cells_of(np.asarray(position, np.float64), self.edges, self.bits)

    def slab_of(self, cell: np.ndarray, axis: int) -> np.ndarray:
        """The slab of each cell on an axis."""
        return cell >> self.bits * (2 - axis) & (1 << self.bits) - 1


@dataclass(frozen=True)
class CellCounts:
    """How many points lie in each cell that has any."""

    cell: np.ndarray  # (m,) int32 ascending
    count: np.ndarray  # (m,) int64


def bits_for(n_leaves: float) -> int:
    """Bits of a slab's number that make CELLS_A_LEAF cells a leaf.

    >>> [bits_for(n) for n in (1, 20, 64, 10_000)]
    [5, 8, 8, 10]
    """
    return min(MOST_BITS, math.ceil(math.log2(max(1.0, n_leaves) * CELLS_A_LEAF) / 2))


def grid_of(sample: np.ndarray, bits: int) -> Grid:
    """The grid of 2^bits slabs an axis of a sample (n, 3) of the points; n at least 1."""
    ordered = np.sort(np.asarray(sample, np.float64), axis=0)
    rank = np.arange(1, 1 << bits) * len(ordered) >> bits
    return Grid(np.ascontiguousarray(ordered[rank].T))


def count_cells(cell: np.ndarray) -> CellCounts:
    """The counts of points, of which `cell` (n,) names the cells."""
    return CellCounts(*np.unique(cell, return_counts=True))


def merge_counts(parts: list[CellCounts]) -> CellCounts:
    """The counts of all parts together."""
    cell, place = np.unique(np.concatenate([p.cell for p in parts]), return_inverse=True)
    count = np.zeros(len(cell), np.int64)
    np.add.at(count, place, np.concatenate([p.count for p in parts]))
    return CellCounts(cell, count)


@kernel()
def _cells_of(position, edges, bits):
    n_edges = edges.shape[1]
    cells = np.empty(len(position), np.int32)
    for i in range(len(position)):
        cell = 0
        for axis in range(3):
            x, low, high = position[i, axis], 0, n_edges
            while low < high:  # edges up to `low` are at most x
                middle = (low + high) // 2
                if edges[axis, middle] <= x:
                    low = middle + 1
                else:
                    high = middle
            cell = cell << bits | low
        cells[i] = cell
    return cells
