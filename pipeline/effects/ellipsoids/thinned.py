"""Points thinned to one a cell, so that a neighbourhood has the same reach where a scanner stood close as where it
stood far, and a bounded number of members."""

from __future__ import annotations

import math

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.geometry.chunks import bounds

CELL_RADII = 0.5
MOST_ALIKE = 16  # points of one x that are put in order one by one


def distinct(position: np.ndarray) -> np.ndarray:
    """Each position (n, 3) once, in the order of their coordinates."""
    order = np.argsort(position[:, 0])
    if not _by_all_coordinates(position, order):
        order = np.lexsort(position.T[::-1])
    ordered = position[order]
    return ordered[_differ(ordered)]


@kernel()
def _by_all_coordinates(position, order):
    """Put those of one x in the order of y and z, unless more than MOST_ALIKE are of one x."""
    at = 0
    for i in range(1, len(order)):
        if position[order[i], 0] != position[order[i - 1], 0]:
            at = i
        if i - at >= MOST_ALIKE:
            return False
        k, one = i, order[i]
        while k > at and _is_before(position, one, order[k - 1]):
            order[k] = order[k - 1]
            k -= 1
        order[k] = one
    return True


@kernel()
def _is_before(position, a, b):
    """By y, then z."""
    y, other = position[a, 1], position[b, 1]
    return y < other or (y == other and position[a, 2] < position[b, 2])


@kernel()
def _differ(ordered):  # (n,) bool: from the one before
    found = np.ones(len(ordered), np.bool_)
    for i in range(1, len(ordered)):
        found[i] = False
        for axis in range(3):
            found[i] |= ordered[i, axis] != ordered[i - 1, axis]
    return found


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
    return ordered[_firsts(key, np.argsort(key))]


@kernel()
def _firsts(key, order):
    """Which of the keys (n,), in ascending order by `order` (n,), has none like it before, (n,) bool."""
    found = np.zeros(len(key), np.bool_)
    first = order[0]
    for i in range(len(order)):
        if key[order[i]] != key[first]:
            found[first] = True
            first = order[i]
        first = min(first, order[i])
    found[first] = True
    return found


def _keys(position: np.ndarray, cell: float) -> np.ndarray | None:
    """A number (n,) int64 of the cell of each position (n, 3); None where 63 bits do not number all cells."""
    low, high = (np.floor(corner / cell) for corner in bounds(position))
    size = high - low + 1
    if float(np.prod(size)) >= 2.0**62:
        return None
    return _numbered(position, cell, low, size.astype(np.int64))


@kernel(error_model="numpy")
def _numbered(position, cell, low, size):
    key = np.empty(len(position), np.int64)
    for i in range(len(position)):
        a = np.int64(math.floor(position[i, 0] / cell) - low[0])
        b = np.int64(math.floor(position[i, 1] / cell) - low[1])
        key[i] = (a * size[1] + b) * size[2] + np.int64(math.floor(position[i, 2] / cell) - low[2])
    return key
