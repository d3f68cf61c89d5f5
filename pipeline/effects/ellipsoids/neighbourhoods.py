"""Neighbourhoods, and the points in cells that answer for them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.effects.ellipsoids import hypotheses
from pipeline.execution.compiled import kernel
from pipeline.geometry.chunks import bounds

LEAST = 6  # the paper's N_min: fewer than these within the reach, and the nearest so many are taken
LEAST_AFTER_OUTLIERS = 3  # the paper's N_outlier
OUTLIER_REACHES = 3.0  # the paper's delta / epsilon: a neighbour further away than so many reaches is an outlier
# One point a cell of half a radius leaves about 4 to 6 a square radius of a surface; so many of them reach at least
# 1.8 radii from the point, and 2.5 (every one that can be asked for) where the scan is not denser than its median.
MOST = hypotheses.MOST
MOST_STEPS = 6  # cells a reach, unless a grid of larger cells has fewer


@dataclass(frozen=True)
class Neighbourhood:
    """Members of each point's neighbourhood as offsets from the point, nearest first, itself among them."""

    offset: np.ndarray  # (n, MOST, 3) float64; zeros beyond `count`; the nearest where it is MOST
    count: np.ndarray  # (n,) int64; 0 where the paper discards the point: too few neighbours that are no outliers


class Around:
    """Distinct points in the order of the cells of a grid, to be asked for neighbours within several reaches.

    `position` (m, 3) float64, in the order of their coordinates: of two equally far away the first is the nearer one.
    """

    def __init__(self, position: np.ndarray, edge: float, most_steps: int = MOST_STEPS) -> None:
        self.given, self.edge, self.most_steps = position, edge, most_steps
        low, high = bounds(position) if len(position) else np.zeros((2, 3))
        self.low = low - (most_steps + 1) * edge
        extent = high - self.low
        self.size = (extent / edge).astype(np.int64) + most_steps + 2  # the outer most_steps cells are empty
        # Where 63 bits do not number all cells, nothing is near anything.
        self.is_grid = len(position) > 0 and float(self.size[0]) * float(self.size[1]) * float(self.size[2]) < 2.0**62
        cell = self.cells(position) if self.is_grid else np.zeros(0, np.int64)
        self.rank = np.argsort(cell)
        self.cell, self.position = cell[self.rank], position[self.rank]

    def cells(self, position: np.ndarray) -> np.ndarray:
        """The cells (n,) int64 of positions (n, 3); of those outside, the nearest."""
        return _cells_of(position, self.low, self.edge, self.size, self.most_steps)


@kernel(error_model="numpy")
def _cells_of(position, low, edge, size, steps):
    cells = np.empty(len(position), np.int64)
    for i in range(len(position)):
        cell = 0
        for axis in range(3):
            slab = np.int64(math.floor((position[i, axis] - low[axis]) / edge))
            cell = cell * size[axis] + min(max(slab, steps), size[axis] - steps - 1)
        cells[i] = cell
    return cells


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
def rows_within(steps, edge, reach):
    """Of which rows of cells some member can be within `reach` of the middle cell, ((2 steps + 1)^2,) bool."""
    side = 2 * steps + 1
    near = np.empty(side * side, np.bool_)
    for a in range(-steps, steps + 1):
        for b in range(-steps, steps + 1):
            gap = max(abs(a) - 1, 0) ** 2 + max(abs(b) - 1, 0) ** 2
            near[(a + steps) * side + b + steps] = gap * edge * edge * (1 - 1e-9) <= reach * reach
    return near


@kernel()
def list_rows(around, first, last, is_near, xs, ys, zs, number):
    """The members of rows that are near enough, one after the other: where they lie, and their numbers."""
    n = 0
    for r in range(len(first)):
        for j in range(first[r], last[r] if is_near[r] else 0):
            xs[n], ys[n], zs[n], number[n] = around[j, 0], around[j, 1], around[j, 2], j
            n += 1
