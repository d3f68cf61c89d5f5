"""Bricks of the hexagonal close packed grid: boxes of cells that hold about as many points each, which tasks work on alone.

DuoDecim (2006), section 4.3, would brick slices too large for memory. A brick is cut across its slices while it has two boxes of starts of
them, then across rows or columns; runs end where bricks do.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.hcp import MOST, ROW, SLICE
from storage.packed.schema import COLUMN_BITS, ROW_BITS, SLICE_BITS

BRICK = 1 << 20  # points of one
END = MOST + 1  # beyond all indices
_GRAIN = np.array(
    [1 << COLUMN_BITS, 1 << ROW_BITS, 1 << SLICE_BITS]
)  # cells that cuts are multiples of: boxes of starts
_FINE = np.array([64, 64, 1 << SLICE_BITS])  # where that cuts nothing


def split(middle: np.ndarray, count: np.ndarray, size: float, most: int = BRICK) -> np.ndarray:
    """Bricks (m, 6) int64, first column, row, slice, then their ends, that hold all cells; `middle` (b, 3) are those of blocks of `count` (b,)
    points in the grid's axes.

    Guarantees: each cell is in one brick; deterministic.
    """
    index = np.floor(middle / (size * np.array([1.0, ROW, SLICE]))).astype(np.int64)
    done, waiting = [], [(np.array([-END] * 3 + [END] * 3), np.arange(len(index)))]
    while waiting:
        brick, own = waiting.pop()
        cut = _cut(brick, index[own], count[own]) if count[own].sum() > most else None
        if cut is None:
            done.append(brick)
            continue
        axis, at = cut
        lower, upper = brick.copy(), brick.copy()
        lower[3 + axis] = upper[axis] = at
        below = index[own, axis] < at
        waiting += [(upper, own[~below]), (lower, own[below])]
    return np.array(done, np.int64)


def _cut(brick: np.ndarray, index: np.ndarray, count: np.ndarray) -> tuple[int, int] | None:
    """Axis and place of a cut that leaves blocks on both sides, the one nearest the median; slices first."""
    for grain in (_GRAIN, _FINE):
        extent = index.max(axis=0) - index.min(axis=0)
        for axis in (2, *np.argsort(-extent[:2], kind="stable").tolist()):
            values = index[:, axis]
            order = np.argsort(values, kind="stable")
            middle = values[order][np.searchsorted(np.cumsum(count[order]), count.sum() / 2)]
            at = int(round(middle / grain[axis])) * int(grain[axis])
            if values.min() < at <= values.max() and brick[axis] < at < brick[3 + axis]:
                return axis, at
    return None


def inside(index: np.ndarray, brick: np.ndarray) -> np.ndarray:
    """Which cells, by column, row and slice (n, 3), are in a brick: (n,) bool."""
    return np.all((index >= brick[:3]) & (index < brick[3:]), axis=1)


def reaches(low: np.ndarray, high: np.ndarray, brick: np.ndarray, size: float) -> np.ndarray:
    """Which boxes (b, 3) of points, in the grid's axes, may have points whose cells are in the brick."""
    pitch = size * np.array([1.0, ROW, SLICE])
    return np.all((high >= (brick[:3] - 2) * pitch) & (low <= (brick[3:] + 1) * pitch), axis=1)
