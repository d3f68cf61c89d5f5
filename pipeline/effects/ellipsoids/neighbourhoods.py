"""Neighbourhoods by radius, else the k nearest, with the outlier rule of the 2020 paper, section 3.1.

The points that answer are thinned to one a cell first, so that a neighbourhood has the same reach where a scanner
stood close as where it stood far, and a bounded number of members.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.geometry.chunks import bounds

LEAST = 6  # the paper's N_min: fewer than these within the reach, and the nearest so many are taken
LEAST_AFTER_OUTLIERS = 3  # the paper's N_outlier
OUTLIER_REACHES = 3.0  # the paper's delta / epsilon: a neighbour further away than so many reaches is an outlier
CELL_RADII = 0.5
# One point a cell of half a radius leaves about 4 to 6 a square radius of a surface; so many of them reach at least
# 1.8 radii from the point, and 2.5 (every one that can be asked for) where the scan is not denser than its median.
MOST = 64
MOST_STEPS = 6  # cells a reach


@dataclass(frozen=True)
class Neighbourhood:
    """Members of each point's neighbourhood as offsets from the point, nearest first, itself among them."""

    offset: np.ndarray  # (n, MOST, 3) float64; zeros beyond `count`; the nearest where it is MOST
    count: np.ndarray  # (n,) int64; 0 where the paper discards the point: too few neighbours that are no outliers


def distinct(position: np.ndarray) -> np.ndarray:
    """Each position (n, 3) once, in the order of their coordinates."""
    ordered = position[np.lexsort(position.T[::-1])]
    is_first = np.ones(len(ordered), bool)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    return ordered[is_first]


def thinned(position: np.ndarray, cell: float) -> np.ndarray:
    """One point of each cell of a grid that is there whatever the points: that of the lowest coordinates."""
    return thinned_of_distinct(distinct(position), cell)


def thinned_of_distinct(ordered: np.ndarray, cell: float) -> np.ndarray:
    """`thinned` of what `distinct` gives, or of a part of it in its order."""
    if not len(ordered):
        return ordered
    key = _keys(ordered, cell)
    if key is None:
        _, first = np.unique(np.floor(ordered / cell), axis=0, return_index=True)
        return ordered[np.sort(first)]
    order = np.argsort(key, kind="stable")
    is_first = np.ones(len(order), bool)
    is_first[1:] = key[order[1:]] != key[order[:-1]]
    return ordered[np.sort(order[is_first])]


def _keys(position: np.ndarray, cell: float) -> np.ndarray | None:
    """A number (n,) int64 of the cell of each position (n, 3); None where 63 bits do not number all cells."""
    low, high = (np.floor(corner / cell) for corner in bounds(position))
    size = high - low + 1
    if float(np.prod(size)) >= 2.0**62:
        return None
    cells = [(np.floor(position[:, axis] / cell) - low[axis]).astype(np.int64) for axis in range(3)]
    return (cells[0] * int(size[1]) + cells[1]) * int(size[2]) + cells[2]


class Around:
    """Distinct points in the order of the cells of a grid, to be asked for neighbours within several reaches.

    `position` (m, 3) float64, in the order of their coordinates: of two equally far away the first is the nearer one.
    """

    def __init__(self, position: np.ndarray, edge: float) -> None:
        self.given, self.edge = position, edge
        low, high = bounds(position) if len(position) else np.zeros((2, 3))
        self.low = low - (MOST_STEPS + 1) * edge
        extent = high - self.low
        self.size = (extent / edge).astype(np.int64) + MOST_STEPS + 2  # the outer MOST_STEPS cells are empty
        # Where 63 bits do not number all cells, nothing is near anything.
        self.is_grid = len(position) > 0 and float(self.size[0]) * float(self.size[1]) * float(self.size[2]) < 2.0**62
        cell = self.cells(position) if self.is_grid else np.zeros(0, np.int64)
        self.rank = np.argsort(cell, kind="stable")
        self.cell, self.position = cell[self.rank], position[self.rank]

    def cells(self, position: np.ndarray) -> np.ndarray:
        """The cells (n,) int64 of positions (n, 3); of those outside, the nearest."""
        return _cells_of(position, self.low, self.edge, self.size)


@kernel()
def _cells_of(position, low, edge, size):
    cells = np.empty(len(position), np.int64)
    for i in range(len(position)):
        cell = 0
        for axis in range(3):
            slab = np.int64(math.floor((position[i, axis] - low[axis]) / edge))
            cell = cell * size[axis] + min(max(slab, MOST_STEPS), size[axis] - MOST_STEPS - 1)
        cells[i] = cell
    return cells


def gather(point: np.ndarray, around: Around, reach: float) -> Neighbourhood:
    """The neighbourhoods of `point` (n, 3) among `around`, which holds all within OUTLIER_REACHES reaches; a reach is at most
    MOST_STEPS of its cells.

    Members are those within `reach`, the nearest MOST of them; where they are fewer than LEAST, the nearest LEAST that are no
    outliers, nor more than MOST_STEPS cells away; where those are fewer than LEAST_AFTER_OUTLIERS, none. A point that thinning took out of `around` is put back.
    """
    offset, count = _nearest(point, around, reach, MOST)
    few = np.flatnonzero(count < LEAST)
    if len(few):
        found = _nearest(point[few], around, min(OUTLIER_REACHES * reach, MOST_STEPS * around.edge), LEAST)
        offset[few], count[few] = found[0], np.where(found[1] >= LEAST_AFTER_OUTLIERS, found[1], 0)
    return Neighbourhood(offset, count)


def _nearest(point: np.ndarray, around: Around, reach: float, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (n, MOST, 3) and count (n,) of the nearest within `reach`, the point itself and at most `most` with it."""
    offset, count = np.zeros((len(point), MOST, 3)), np.zeros(len(point), np.int64)
    if around.is_grid and len(point):
        cell = around.cells(point)
        order = np.argsort(cell, kind="stable")
        steps = math.ceil(reach / around.edge * (1 - 1e-9))
        known = (around.position, around.cell, around.rank, around.size)
        _nearest_within(point, cell, order, *known, reach, around.edge, steps, most, offset, count)
    return offset, count


@kernel()
def rows_of_cells(cell, of_around, size, steps, first, last):
    """Where in `around` the cells within `steps` of `cell` begin and end: a run of 2 steps + 1 cells each.

    `first` and `last` hold the answers for a cell before it, or zeros: from there they lie a few steps on.
    """
    row = 0
    for a in range(-steps, steps + 1):
        for b in range(-steps, steps + 1):
            middle = cell + (a * size[1] + b) * size[2]
            first[row] = _from(of_around, middle - steps, first[row])
            last[row] = _from(of_around, middle + steps + 1, max(first[row], last[row]))
            row += 1


@kernel()
def _from(ascending, value, at):
    """The first place from `at` on whose value is `value` or more; all before `at` are less."""
    step, end = 1, len(ascending)
    while at + step <= end and ascending[at + step - 1] < value:
        at += step
        step *= 2
    while step > 1:
        step //= 2
        if at + step <= end and ascending[at + step - 1] < value:
            at += step
    return at


@kernel()
def _nearest_within(point, of_point, order, around, of_around, rank, size, reach, edge, steps, most, offset, count):
    """Points by `order`, so that those of a cell come together; `around` in the order of its cells. Of members equally far away
    that of the lower `rank` comes first, so that no neighbourhood depends on where cells begin."""
    n_rows = (2 * steps + 1) ** 2
    first, last = np.zeros(n_rows, np.int64), np.zeros(n_rows, np.int64)
    away, member = np.empty(most), np.empty(most, np.int64)
    nearest_first, least = _from_the_middle(steps, edge)
    known = np.int64(-1)
    for i in order:
        if of_point[i] != known:
            known = of_point[i]
            rows_of_cells(known, of_around, size, steps, first, last)
        n, furthest = 0, reach * reach * (1 + 1e-12)
        for r in nearest_first:
            if least[r] > furthest:
                continue
            for j in range(first[r], last[r]):
                dx, dy, dz = around[j, 0] - point[i, 0], around[j, 1] - point[i, 1], around[j, 2] - point[i, 2]
                d = dx * dx + dy * dy + dz * dz
                if d > furthest or math.sqrt(d) > reach:
                    continue
                if n == most and d == furthest and rank[j] > rank[member[most - 1]]:
                    continue
                k = n if n < most else most - 1
                while k > 0 and (away[k - 1] > d or (away[k - 1] == d and rank[member[k - 1]] > rank[j])):
                    away[k], member[k] = away[k - 1], member[k - 1]
                    k -= 1
                away[k], member[k] = d, j
                n = min(n + 1, most)
                if n == most:
                    furthest = away[most - 1]
        itself = 1 if n == 0 or away[0] > 0 else 0  # thinned out: put back
        n = min(n, most - itself)
        for k in range(n):
            for axis in range(3):
                offset[i, k + itself, axis] = around[member[k], axis] - point[i, axis]
        count[i] = n + itself


def is_full(point: np.ndarray, around: Around, reach: float) -> np.ndarray:
    """Where MOST of `around` or more lie within `reach` of `point` (n, 3), (n,) bool; a reach is at most MOST_STEPS cells."""
    full = np.zeros(len(point), bool)
    if around.is_grid and len(point):
        cell = around.cells(point)
        order = np.argsort(cell, kind="stable")
        steps = math.ceil(reach / around.edge * (1 - 1e-9))
        _fill(point, cell, order, around.position, around.cell, around.size, reach, around.edge, steps, full)
    return full


@kernel()
def _fill(point, of_point, order, around, of_around, size, reach, edge, steps, full):
    n_rows = (2 * steps + 1) ** 2
    first, last = np.zeros(n_rows, np.int64), np.zeros(n_rows, np.int64)
    nearest_first = _from_the_middle(steps, edge)[0]
    known = np.int64(-1)
    for i in order:
        if of_point[i] != known:
            known = of_point[i]
            rows_of_cells(known, of_around, size, steps, first, last)
        n = 0
        for r in nearest_first:
            for j in range(first[r], last[r]):
                dx, dy, dz = around[j, 0] - point[i, 0], around[j, 1] - point[i, 1], around[j, 2] - point[i, 2]
                n += dx * dx + dy * dy + dz * dz <= reach * reach
            if n >= MOST:
                full[i] = True
                break


@kernel()
def _from_the_middle(steps, edge):
    """Rows as `rows_of_cells` numbers them, nearest first, and the square of how far away their members are at least."""
    side = 2 * steps + 1
    least = np.empty(side * side)
    for a in range(-steps, steps + 1):
        for b in range(-steps, steps + 1):
            gap = max(abs(a) - 1, 0) ** 2 + max(abs(b) - 1, 0) ** 2
            least[(a + steps) * side + b + steps] = gap * edge * edge * (1 - 1e-9)
    return np.argsort(least, kind="mergesort"), least
