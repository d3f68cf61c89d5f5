"""Neighbourhoods by radius, else the k nearest, with the outlier rule of the 2020 paper, section 3.1.

The points that answer are thinned to one a cell first, so that a neighbourhood has the same reach where a scanner
stood close as where it stood far, and a bounded number of members.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from pipeline.execution.compiled import kernel

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
    cells = np.floor(ordered / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    size = cells.max(axis=0) + 1
    if float(size[0]) * float(size[1]) * float(size[2]) < 2.0**62:
        key = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
        _, first = np.unique(key, return_index=True)
    else:
        _, first = np.unique(cells, axis=0, return_index=True)
    return ordered[np.sort(first)]


class Around:
    """Distinct points in the order of the cells of a grid, to be asked for neighbours within several reaches.

    `position` (m, 3) float64, in the order of their coordinates: of two equally far away the first is the nearer one.
    """

    def __init__(self, position: np.ndarray, edge: float) -> None:
        self.given, self.edge = position, edge
        self.low = position.min(axis=0) - (MOST_STEPS + 1) * edge if len(position) else np.zeros(3)
        extent = position.max(axis=0) - self.low if len(position) else np.zeros(3)
        self.size = (extent / edge).astype(np.int64) + MOST_STEPS + 2  # the outer MOST_STEPS cells are empty
        # Where 63 bits do not number all cells, nothing is near anything.
        self.is_grid = len(position) > 0 and float(self.size[0]) * float(self.size[1]) * float(self.size[2]) < 2.0**62
        cell = self.cells(position) if self.is_grid else np.zeros(0, np.int64)
        self.rank = np.argsort(cell, kind="stable")
        self.cell, self.position = cell[self.rank], position[self.rank]

    def cells(self, position: np.ndarray) -> np.ndarray:
        """The cells (n,) int64 of positions (n, 3); of those outside, the nearest."""
        cell = np.floor((position - self.low) / self.edge).astype(np.int64)
        cell = np.clip(cell, MOST_STEPS, self.size - MOST_STEPS - 1)
        return (cell[:, 0] * self.size[1] + cell[:, 1]) * self.size[2] + cell[:, 2]

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.given)


def gather(point: np.ndarray, around: Around, reach: float) -> Neighbourhood:
    """The neighbourhoods of `point` (n, 3) among `around`, which holds all within OUTLIER_REACHES reaches; a reach is at most
    MOST_STEPS of its cells.

    Members are those within `reach`, the nearest MOST of them; where they are fewer than LEAST, the nearest LEAST that are no
    outliers; where those are fewer than LEAST_AFTER_OUTLIERS, none. A point that thinning took out of `around` is put back.
    """
    offset, count = np.zeros((len(point), MOST, 3)), np.zeros(len(point), np.int64)
    if not len(around.given) or not len(point):
        return Neighbourhood(offset, count)
    if around.is_grid:
        cell = around.cells(point)
        order = np.argsort(cell, kind="stable")
        steps = math.ceil(reach / around.edge * (1 - 1e-9))
        known = (around.position, around.cell, around.rank, around.size)
        _nearest_within(point, cell, order, *known, reach, around.edge, steps, offset, count)
    few = np.flatnonzero(count < LEAST)
    if len(few):
        offset[few], count[few] = _nearest_few(point[few], around, OUTLIER_REACHES * reach)
    return Neighbourhood(offset, count)


def _nearest_few(point: np.ndarray, around: Around, outlier: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (n, MOST, 3) and count (n,) of the nearest LEAST that are nearer than `outlier`."""
    k = min(LEAST, len(around.given))
    distance, index = around.tree.query(point, k=k, distance_upper_bound=outlier)
    distance, index = distance.reshape(len(point), k), index.reshape(len(point), k)
    offset, known = np.zeros((len(point), MOST, 3)), np.isfinite(distance)
    nearest = around.given[np.minimum(index, len(around.given) - 1)]
    offset[:, :k] = np.where(known[..., None], nearest - point[:, None], 0)
    absent = ~(distance[:, 0] == 0)
    offset[absent, 1:], offset[absent, 0] = offset[absent, :-1], 0
    count = np.minimum(known.sum(axis=1) + absent, LEAST)
    offset[np.arange(MOST) >= count[:, None]] = 0
    return offset, np.where(count >= LEAST_AFTER_OUTLIERS, count, 0)


@kernel()
def rows_of_cells(cell, of_around, size, steps, first, last):
    """Where in `around` the cells within `steps` of `cell` begin and end: a run of 2 steps + 1 cells each."""
    row = 0
    for a in range(-steps, steps + 1):
        for b in range(-steps, steps + 1):
            middle = cell + (a * size[1] + b) * size[2]
            first[row] = np.searchsorted(of_around, middle - steps)
            last[row] = np.searchsorted(of_around, middle + steps, "right")
            row += 1


@kernel()
def _nearest_within(point, of_point, order, around, of_around, rank, size, reach, edge, steps, offset, count):
    """Points by `order`, so that those of a cell come together; `around` in the order of its cells. Of members equally far away
    that of the lower `rank` comes first, so that no neighbourhood depends on where cells begin."""
    n_rows = (2 * steps + 1) ** 2
    first, last = np.empty(n_rows, np.int64), np.empty(n_rows, np.int64)
    away, member = np.empty(MOST), np.empty(MOST, np.int64)
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
                if n == MOST and d == furthest and rank[j] > rank[member[MOST - 1]]:
                    continue
                k = n if n < MOST else MOST - 1
                while k > 0 and (away[k - 1] > d or (away[k - 1] == d and rank[member[k - 1]] > rank[j])):
                    away[k], member[k] = away[k - 1], member[k - 1]
                    k -= 1
                away[k], member[k] = d, j
                n = min(n + 1, MOST)
                if n == MOST:
                    furthest = away[MOST - 1]
        itself = 1 if n == 0 or away[0] > 0 else 0  # thinned out: put back
        n = min(n, MOST - itself)
        for k in range(n):
            for axis in range(3):
                offset[i, k + itself, axis] = around[member[k], axis] - point[i, axis]
        count[i] = n + itself


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
