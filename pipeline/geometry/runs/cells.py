"""Points -> the cells that hold one, and the size of cells at which that loses as few as asked.

DuoDecim (2006), sections 2.2.1 and 2.4. The hit rate is the mean number of points of a cell that has one. On a surface it goes as the
square of the size, so that the next size is the root of what is missing; the paper takes the ratio itself, which overshoots.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.geometry.hcp import keys_of

MOST_HIT_RATE = 1.6
FIRST_SPACINGS = 1.5  # the first size, in mean distances of neighbours
CLOSE = 0.995  # of the hit rate asked for: near enough
ROUNDS = 24
SAMPLE = 4096  # points whose nearest neighbour is looked for
CANCELLED = 0.1  # mean length of summed unit normals below which they cancel


@dataclass(frozen=True)
class Cells:
    """Cells in the order of their keys: by slice, row, column."""

    key: np.ndarray  # (n,) int64, ascending, no two alike
    size: float
    n_points: int
    axis: int = 2  # 0, 1 or 2: slices lie across it

    @property
    def hit_rate(self) -> float:
        return self.n_points / len(self.key)


def in_grid(position: np.ndarray, axis: int) -> np.ndarray:
    """Positions (n, 3) turned so that the grid's z is the axis that slices lie across; handedness stays."""
    return np.roll(position, 2 - axis, axis=1)


def from_grid(position: np.ndarray, axis: int) -> np.ndarray:
    """The way back of `in_grid`."""
    return np.roll(position, axis - 2, axis=1)


def fill(position: np.ndarray, size: float, axis: int = 2) -> Cells:
    """The cells of points (n, 3), n at least 1."""
    return Cells(np.unique(keys_of(in_grid(position, axis), size)), size, len(position), axis)


def mean_spacing(position: np.ndarray) -> float:
    """Mean distance of points (n, 3) to the nearest that lies elsewhere, from SAMPLE of them; 0 where all are one."""
    chosen = position[:: max(1, len(position) // SAMPLE)]
    different = np.unique(position, axis=0)
    if len(different) < 2:
        return 0.0
    return float(cKDTree(different).query(chosen, 2)[0][:, 1].mean())


def search_size(position: np.ndarray, most: float = MOST_HIT_RATE, axis: int = 2) -> Cells:
    """The largest cells found whose hit rate is at most `most`; where copies of points keep it above that, cells that part all others.

    Guarantees: deterministic; of points that are all one, a cell of size 1.
    """
    spacing = mean_spacing(position)
    if not spacing:
        return fill(position, 1.0, axis)
    most = max(most, len(position) / len(np.unique(position, axis=0)) / CLOSE)
    size, best = FIRST_SPACINGS * spacing, None
    low, high = 0.0, np.inf  # sizes known to be small enough, and too large
    for _ in range(ROUNDS):
        cells = fill(position, size, axis)
        if cells.hit_rate <= most:
            best, low = cells if best is None or size > best.size else best, size
            if cells.hit_rate >= CLOSE * most:
                break
        else:
            high = size
        size *= np.sqrt(CLOSE**0.5 * most / cells.hit_rate)
        if not low < size < high:
            size = (low + high) / 2 if high < np.inf else 2 * low
    return best if best is not None else fill(position, size, axis)


def average_normals(position: np.ndarray, normal: np.ndarray, cells: Cells) -> np.ndarray:
    """The mean normal (n_cells, 3) float64 of the points of each cell, in the points' frame. `normal` (n, 3) of any length, zero or NaN for none.

    Guarantees: unit length; where those of a cell cancel (two sides of a sheet) that of its first point; +z where no point has one.
    """
    of_point = np.searchsorted(cells.key, keys_of(in_grid(position, cells.axis), cells.size))
    length = np.linalg.norm(normal, axis=1)
    known = np.isfinite(length) & (length > 0)
    unit = np.where(known[:, None], normal / np.where(known, length, 1)[:, None], 0.0)
    total = np.stack([np.bincount(of_point, unit[:, a], len(cells.key)) for a in range(3)], axis=1)
    count = np.bincount(of_point, known, len(cells.key))
    first = np.full(len(cells.key), len(position))
    np.minimum.at(first, of_point[known], np.flatnonzero(known))
    alone = np.where((first < len(position))[:, None], unit[np.minimum(first, len(position) - 1)], [0.0, 0.0, 1.0])
    sums = np.linalg.norm(total, axis=1)
    usable = sums > CANCELLED * count
    return np.where(usable[:, None], total / np.where(usable, sums, 1)[:, None], alone)
