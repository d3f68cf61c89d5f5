"""A scan too large for one process, cut into leaves that fit: the median split, told by counts per cell alone.

The splits are those of `pipeline/geometry/chunks.py`: the same ranks, on the longest axis of a node. A plane between
two slabs of the grid seldom has that rank, so the slab that crosses it is divided cell by cell, and of one cell the
points that come first in the file go left. Ranks are exact; the boundary of two leaves has a step of one cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.geometry.cells import CellCounts, Grid
from pipeline.geometry.chunks import longest_axis, split_rank

HEAVIEST = 1 / 8  # share of a node's points; a cell of more is not divided by the order of the file


@dataclass(frozen=True)
class Leaves:
    """Which points belong to which leaf. Portion p is the points of `cell[p]` from the `begin[p]`-th in the file on."""

    cell: np.ndarray  # (m,) int32 ascending; a cell that is divided occurs more than once
    begin: np.ndarray  # (m,) int64, ascending within a cell
    leaf: np.ndarray  # (m,) int64
    start: np.ndarray  # (n_leaves + 1,) int64: the first row of each leaf in the order of the splats

    @property
    def n_leaves(self) -> int:
        return len(self.start) - 1

    @property
    def divided(self) -> np.ndarray:
        """Cells of more than one portion, (k,) int32 ascending."""
        return np.unique(self.cell[1:][self.cell[1:] == self.cell[:-1]])

    def of_points(self, cell: np.ndarray, n_before: np.ndarray) -> np.ndarray:
        """The leaves (n,) of points in file order, by their cells (n,); `n_before` (k,) points of each divided cell
        stand before them in the file. Every cell must have been counted."""
        return _leaves_of(cell, self.cell, self.begin, self.leaf, self.divided, n_before.astype(np.int64))


def grow_leaves(counts: CellCounts, grid: Grid, low: np.ndarray, high: np.ndarray, most: int) -> Leaves:
    """Leaves of at most `most` points, more only where one cell has HEAVIEST of a larger node's points and would be
    cut.

    `low`, `high` (3,) are the bounds of all points.
    Guarantees: leaves partition the points; but the last of all, each starts at a rank of `split_rank` of its
    ancestors.
    """
    slab_low = np.column_stack([low, np.clip(grid.edges, low[:, None], high[:, None])])
    slab_high = np.column_stack([np.clip(grid.edges, low[:, None], high[:, None]), high])
    portion = np.arange(len(counts.cell))
    pending = [(portion, np.zeros(len(portion), np.int64), counts.count.copy())]
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    while pending:
        node = pending.pop()
        halves = _halves(counts.cell, grid, node, slab_low, slab_high) if node[2].sum() > most else None
        if halves is None:
            found.append(node)
        else:
            pending += halves[::-1]
    index, begin = (np.concatenate([node[i] for node in found]) for i in (0, 1))
    leaf = np.repeat(np.arange(len(found)), [len(node[0]) for node in found])
    order = np.lexsort((begin, index))
    start = np.concatenate([[0], np.cumsum([node[2].sum() for node in found])])
    return Leaves(counts.cell[index[order]], begin[order], leaf[order], start)


def _halves(
    cell: np.ndarray, grid: Grid, node: tuple, slab_low: np.ndarray, slab_high: np.ndarray
) -> list[tuple] | None:
    """The two children of a node (portions as index, begin, size); None where a heavy cell would be cut."""
    index, begin, size = node
    slabs = np.stack([grid.slab_of(cell[index], axis) for axis in range(3)])
    axes = np.arange(3)
    axis = longest_axis(slab_low[axes, slabs.min(axis=1)], slab_high[axes, slabs.max(axis=1)])
    order = np.argsort(slabs[axis].astype(np.uint16), kind="stable")  # cells of a slab as the node has them
    running, rank = np.cumsum(size[order]), split_rank(int(size.sum()))
    at = int(np.searchsorted(running, rank))
    n_left = rank - (int(running[at - 1]) if at else 0)  # of the portion that crosses the rank
    cut = order[at]
    if n_left == size[cut]:
        return [tuple(column[order[: at + 1]] for column in node), tuple(column[order[at + 1 :]] for column in node)]
    if size[cut] > HEAVIEST * running[-1]:
        return None
    left, right = (tuple(column[rows].copy() for column in node) for rows in (order[: at + 1], order[at:]))
    left[2][-1] = n_left
    right[1][0] += n_left
    right[2][0] -= n_left
    return [left, right]


@kernel()
def _leaves_of(cell, portion_cell, portion_begin, portion_leaf, divided, n_before):
    seen, leaves = n_before.copy(), np.empty(len(cell), np.int64)
    for i in range(len(cell)):
        at = np.searchsorted(portion_cell, cell[i])
        if at + 1 < len(portion_cell) and portion_cell[at + 1] == cell[i]:
            k = np.searchsorted(divided, cell[i])
            while at + 1 < len(portion_cell) and portion_cell[at + 1] == cell[i] and portion_begin[at + 1] <= seen[k]:
                at += 1
            seen[k] += 1
        leaves[i] = portion_leaf[at]
    return leaves
