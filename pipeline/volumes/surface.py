"""The points of an iso-surface: a cell of each pair of neighbours that the value passes between, moved onto the surface.

DuoDecim (2006), section 2.1. Of the two cells of a pair the one whose value is nearer is taken. What is thinner than a cell may
lie between all centres: so each edge of voxels that the value passes is looked at too, and where no cell about it was taken, its own is.
Then each point goes down the slope until it is on the surface, and its normal is the slope there, towards lower values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.geometry.hcp import N_NEIGHBOURS, cell_of, centre_of, key_of, neighbour
from pipeline.volumes.field import METHODS, WEIGHTS, value_at
from pipeline.volumes.lattice import HALO, Lattice
from pipeline.volumes.settle import settle


@dataclass(frozen=True)
class Surface:
    """Points of one iso value in some slices, by their keys ascending."""

    key: np.ndarray  # (n,) int64
    position: np.ndarray  # (n, 3) float64, local
    gradient: np.ndarray  # (n, 3) float64, local; 0 where the volume tells none
    off: np.ndarray  # (n,) float64: distance left to the surface, to first order, unit; NaN where the slope is 0
    n_added: int  # cells that only an edge of voxels told


@kernel()
def _sample(voxels, k0, first, values, low, size, to_voxels, method, weights):
    """Values (n_slices, n_rows, n_columns) at the centres of cells, of slices from `first` on."""
    for s in range(values.shape[0]):
        for r in range(values.shape[1]):
            for c in range(values.shape[2]):
                x, y, z = centre_of(c + low[0], r + low[1], s + first, size)
                i = to_voxels[0, 0] * x + to_voxels[0, 1] * y + to_voxels[0, 2] * z
                j = to_voxels[1, 1] * y + to_voxels[1, 2] * z
                values[s, r, c] = value_at(voxels, k0, i, j, to_voxels[2, 2] * z, method, weights)


@part()
def _place(column, row, slice_, first, low):
    return slice_ - first, row - low[1], column - low[0]


@part()
def _inside(s, r, c, shape):
    return 0 <= s < shape[0] and 0 <= r < shape[1] and 0 <= c < shape[2]


@kernel()
def _mark(values, first, low, iso, marks):
    """Of each pair of neighbours that the value passes between, the nearer; of equals the one with the lower key."""
    shape = values.shape
    for s in range(shape[0]):
        for r in range(shape[1]):
            for c in range(shape[2]):
                own = values[s, r, c]
                if math.isnan(own):
                    continue
                column, row, slice_ = c + low[0], r + low[1], s + first
                for k in range(N_NEIGHBOURS):
                    n_column, n_row, n_slice = neighbour(column, row, slice_, k)
                    ns, nr, nc = _place(n_column, n_row, n_slice, first, low)
                    if not _inside(ns, nr, nc, shape):
                        continue
                    other = values[ns, nr, nc]
                    if math.isnan(other) or (own >= iso) == (other >= iso):
                        continue
                    mine, its = abs(own - iso), abs(other - iso)
                    if mine < its or (mine == its and key_of(column, row, slice_) < key_of(n_column, n_row, n_slice)):
                        marks[s, r, c] = True
                        break


@part()
def _is_near(marks, column, row, slice_, first, low):
    s, r, c = _place(column, row, slice_, first, low)
    if _inside(s, r, c, marks.shape) and marks[s, r, c]:
        return True
    for k in range(N_NEIGHBOURS):
        n_column, n_row, n_slice = neighbour(column, row, slice_, k)
        s, r, c = _place(n_column, n_row, n_slice, first, low)
        if _inside(s, r, c, marks.shape) and marks[s, r, c]:
            return True
    return False


@kernel()
def _missed(voxels, k0, marks, first, begin, end, low, iso, size, stretch, keys, position):
    """Crossings of edges of voxels whose cell lies in slices begin..end and has no mark about it, written to `keys` and `position` as far
    as they go; returns their number."""
    n_k, n_j, n_i = voxels.shape
    n = 0
    for k in range(n_k):
        for j in range(n_j):
            for i in range(n_i):
                own = voxels[k, j, i]
                if math.isnan(own):
                    continue
                for axis in range(3):
                    di, dj, dk = int(axis == 0), int(axis == 1), int(axis == 2)
                    if i + di >= n_i or j + dj >= n_j or k + dk >= n_k:
                        continue
                    other = voxels[k + dk, j + dj, i + di]
                    if math.isnan(other) or (own >= iso) == (other >= iso):
                        continue
                    t = (iso - own) / (float(other) - own)
                    a, b, d = i + di * t, j + dj * t, k0 + k + dk * t
                    x, y, z = (
                        stretch[0, 0] * a + stretch[0, 1] * b + stretch[0, 2] * d,
                        stretch[1, 1] * b + stretch[1, 2] * d,
                        stretch[2, 2] * d,
                    )
                    column, row, slice_ = cell_of(x, y, z, size)
                    if slice_ < begin or slice_ >= end or _is_near(marks, column, row, slice_, first, low):
                        continue
                    if n < len(keys):
                        keys[n] = key_of(column, row, slice_)
                        position[n, 0], position[n, 1], position[n, 2] = x, y, z
                    n += 1
    return n


@kernel()
def _cells(marks, first, low, begin, end, size, keys, position):
    n = 0
    for s in range(begin - first, end - first):
        for r in range(marks.shape[1]):
            for c in range(marks.shape[2]):
                if marks[s, r, c]:
                    keys[n] = key_of(c + low[0], r + low[1], s + first)
                    position[n, 0], position[n, 1], position[n, 2] = centre_of(c + low[0], r + low[1], s + first, size)
                    n += 1


def sampled(voxels: np.ndarray, k0: int, lattice: Lattice, begin: int, end: int, method: str) -> tuple[np.ndarray, int]:
    """Values at the cells of slices begin..end and of HALO more either side, and the first of these slices.

    `voxels` (n_k, n_j, n_i) float32 from slice k0 on, as many as `lattice.voxel_slices` says.
    """
    first, last = max(0, begin - HALO), min(lattice.counts[2], end + HALO)
    values = np.empty((last - first, lattice.counts[1], lattice.counts[0]), np.float32)
    _sample(voxels, k0, first, values, lattice.low, lattice.size, lattice.to_voxels, METHODS[method], WEIGHTS)
    return values, first


def surface_in(
    voxels: np.ndarray,
    k0: int,
    values: np.ndarray,
    first: int,
    lattice: Lattice,
    begin: int,
    end: int,
    iso: float,
    method: str,
) -> Surface:
    """The points of an iso value whose cells lie in slices begin..end.

    Guarantees: the same points whatever the slices are cut into; every crossing of an edge of voxels has a point within two cells.
    """
    marks = np.zeros(values.shape, np.bool_)
    _mark(values, first, lattice.low, iso, marks)
    n = int(marks[begin - first : end - first].sum())
    key, position = np.empty(n, np.int64), np.empty((n, 3))
    _cells(marks, first, lattice.low, begin, end, lattice.size, key, position)
    added_key, added = _added(voxels, k0, marks, first, lattice, begin, end, iso)
    key, position = np.concatenate([key, added_key]), np.concatenate([position, added])
    order = np.argsort(key, kind="stable")
    key, position = key[order], position[order]
    gradient, off = np.empty((len(key), 3)), np.empty(len(key))
    settle(
        voxels,
        k0,
        key,
        position,
        iso,
        lattice.size,
        lattice.stretch,
        lattice.to_voxels,
        METHODS[method],
        WEIGHTS,
        gradient,
        off,
    )
    return Surface(key, position, gradient, off, len(added_key))


def _added(voxels, k0, marks, first, lattice: Lattice, begin, end, iso) -> tuple[np.ndarray, np.ndarray]:
    """Keys and first crossings of the cells that only edges of voxels tell."""
    n = 1024
    while True:
        keys, position = np.empty(n, np.int64), np.empty((n, 3))
        found = _missed(
            voxels, k0, marks, first, begin, end, lattice.low, iso, lattice.size, lattice.stretch, keys, position
        )
        if found <= n:
            break
        n = found
    keys, where = np.unique(keys[:found], return_index=True)
    return keys, position[where]
