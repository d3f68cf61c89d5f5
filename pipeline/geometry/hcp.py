"""The hexagonal close packed grid: the cell of a point, the centre of a cell, keys of 64 bits, neighbours.

DuoDecim (Krueger et al., Computing 2006), section 2.2. Spheres of diameter `d` touch 12 others each. Slices lie d
sqrt(2/3) apart along z (the paper's y), rows d sqrt(3)/2 along y, columns d along x. In a slice odd rows stand half a
column further; odd slices half a column and a third of a row. With q = (row + slice) mod 2:

    x = d (column + q / 2)      y = d sqrt(3)/2 (row + (slice mod 2) / 3)      z = d sqrt(2/3) slice

Cells of equal parity of slice and row form a grid of boxes. So the nearest centre is the nearest of four, one a parity.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.execution.compiled import kernel, part
from storage.errors import InvalidScan

ROW = math.sqrt(3) / 2  # row to row, in cells
SLICE = math.sqrt(2 / 3)  # slice to slice, in cells
REACH = math.sqrt(0.5)  # furthest that a point lies from the nearest centre, in cells
INDEX_BITS = 21
MOST = (1 << INDEX_BITS - 1) - 2  # of an index, either way: neighbours have keys too
N_NEIGHBOURS = 12
IN_SLICE = 6  # of the 12, the first


@part()
def parity(row, slice_):
    """0 or 1: whether a row of a slice is shifted by half a cell."""
    return (row ^ slice_) & 1


@part()
def centre_of(column, row, slice_, size):
    """x, y, z of a cell's centre."""
    x = size * (column + 0.5 * parity(row, slice_))
    y = size * ROW * (row + (slice_ & 1) / 3.0)
    return x, y, size * SLICE * slice_


@part()
def neighbour(column, row, slice_, k):
    """Column, row and slice of neighbour k: 0 and 3 along the row, 1, 2, 4, 5 in the rows beside, then 3 above and 3
    below.

    Neighbour (k + 3) mod 6 of neighbour k < 6 is the cell itself.
    """
    q = parity(row, slice_)
    if k < 6:
        if k == 0:
            return column + 1, row, slice_
        if k == 1:
            return column + q, row + 1, slice_
        if k == 2:
            return column + q - 1, row + 1, slice_
        if k == 3:
            return column - 1, row, slice_
        if k == 4:
            return column + q - 1, row - 1, slice_
        return column + q, row - 1, slice_
    to = slice_ + 1 if k < 9 else slice_ - 1
    m = (k - 6) % 3
    if m < 2:
        return column + q - 1 + m, row, to
    return column, row + (1 if slice_ & 1 else -1), to


@part()
def cell_of(x, y, z, size):
    """Column, row and slice of the cell whose centre is nearest; of centres as near the lowest slice, row and
    column."""
    best, best_column, best_row, best_slice = np.inf, 0, 0, 0
    for odd_slice in range(2):
        s = 2 * int(math.ceil((z / (size * SLICE) - odd_slice) / 2 - 0.5)) + odd_slice
        for odd_row in range(2):
            r = 2 * int(math.ceil((y / (size * ROW) - odd_slice / 3.0 - odd_row) / 2 - 0.5)) + odd_row
            c = int(math.ceil(x / size - 0.5 * parity(r, s) - 0.5))
            cx, cy, cz = centre_of(c, r, s, size)
            far = (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2
            if far < best or (far == best and (s, r, c) < (best_slice, best_row, best_column)):
                best, best_column, best_row, best_slice = far, c, r, s
    return best_column, best_row, best_slice


@part()
def key_of(column, row, slice_):
    """One int64 for a cell, ascending by slice, row and column; each from -2^20 to 2^20 - 1."""
    return ((slice_ + (1 << 20)) << 42) | ((row + (1 << 20)) << 21) | (column + (1 << 20))


@part()
def index_of(key):
    """Column, row and slice of a key."""
    mask = (1 << 21) - 1
    return (key & mask) - (1 << 20), ((key >> 21) & mask) - (1 << 20), (key >> 42) - (1 << 20)


@kernel()
def _keys(position, size):
    result = np.empty(len(position), np.int64)
    for i in range(len(position)):
        column, row, slice_ = cell_of(position[i, 0], position[i, 1], position[i, 2], size)
        result[i] = key_of(column, row, slice_)
    return result


@kernel()
def _centres(key, size):
    result = np.empty((len(key), 3))
    for i in range(len(key)):
        column, row, slice_ = index_of(key[i])
        result[i] = centre_of(column, row, slice_, size)
    return result


def keys_of(position: np.ndarray, size: float) -> np.ndarray:
    """The keys (n,) int64 of the cells that points (n, 3) float64 lie in; `size` is the distance of neighbouring
    centres.

    Guarantees: keys ascend by slice, row, column; the centre lies at most REACH * size from the point.
    Raises: InvalidScan where an index leaves its 21 bits.
    """
    check_extent(float(np.abs(position).max(initial=0.0)), size)
    return _keys(np.ascontiguousarray(position, np.float64), float(size))


def centres_of(key: np.ndarray, size: float) -> np.ndarray:
    """The centres (n, 3) float64 of cells by their keys."""
    return _centres(np.ascontiguousarray(key, np.int64), float(size))


def check_extent(furthest: float, size: float) -> None:
    """Raises InvalidScan where cells of that size cannot be numbered as far out as `furthest` along any axis."""
    n_cells = furthest / (SLICE * size)
    if not n_cells <= MOST:
        raise InvalidScan(
            "cell",
            f"a size of {size:g} makes {2 * n_cells:,.0f} cells along an axis",
            f"at most {2 * MOST:,}",
            f"choose a cell of {furthest / (SLICE * MOST):.3g} or more",
        )
