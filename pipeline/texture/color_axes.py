"""The axes along which the colours of a chunk are told: those of their spread (principal components).

A chunk is of few materials, each lit in many ways, so its colours lie near a line that is seldom that of greys: along
their own axes boxes of `fountain_p11` take 1.2 bits a splat less than along luma and chroma, for 24 bits a chunk.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from pipeline.geometry.quadrics.quaternions import axes_of
from storage.packed.schema import CHUNK, COLOR_TURN_W


def fit_turns(on_axes: np.ndarray) -> np.ndarray:
    """Quaternions x, y, z (c, 3) int8 with w COLOR_TURN_W, for each run of CHUNK rows of `on_axes` (n, 3).

    Of the 24 ways to name and direct three axes that nearest to none is taken: a rotation of at most 63 degrees, whose
    x, y and z are at most tan(22.5) of w.
    """
    starts, chunk = np.arange(0, len(on_axes), CHUNK), np.arange(len(on_axes)) // CHUNK
    count = np.diff(np.append(starts, len(on_axes)))
    off = on_axes - (np.add.reduceat(on_axes, starts, axis=0) / count[:, None])[chunk]
    spread = np.empty((len(starts), 3, 3))
    for i in range(3):
        for j in range(3):
            spread[:, i, j] = np.add.reduceat(off[:, i] * off[:, j], starts)
    rows = _nearest_to_none(np.linalg.eigh(spread)[1].transpose(0, 2, 1))
    w = np.sqrt(1 + np.trace(rows, axis1=1, axis2=2)) / 2
    q = np.stack([rows[:, i, j] - rows[:, j, i] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1) / (4 * w * w)[:, None]
    return np.rint(COLOR_TURN_W * q).clip(-127, 127).astype(np.int8)


def turned(on_axes: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Colours (n, 3) along the axes of their chunk, float64."""
    return _products(on_axes, axes_of(turn, COLOR_TURN_W))


def turned_back(on_axes: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """The inverse of `turned`."""
    return _products(on_axes, axes_of(turn, COLOR_TURN_W).transpose(0, 2, 1))


def _products(point: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Of each point (n, 3) with the rows (c, 3, 3) of its chunk, one by one: a matrix product may round otherwise on
    other machines."""
    of = rows[np.arange(len(point)) // CHUNK]
    x, y, z = point.T
    return np.stack([x * of[:, i, 0] + y * of[:, i, 1] + z * of[:, i, 2] for i in range(3)], axis=1)


def _nearest_to_none(rows: np.ndarray) -> np.ndarray:
    """Rotations (c, 3, 3) of the least angle that have these orthonormal rows, in any order and either way round."""
    best, most = rows, np.full(len(rows), -np.inf)
    for order in permutations(range(3)):
        found = rows[:, order]
        found = found * np.where(np.diagonal(found, axis1=1, axis2=2) < 0, -1.0, 1.0)[:, :, None]
        weakest = np.abs(np.diagonal(found, axis1=1, axis2=2)).argmin(axis=1)
        mirrored = np.linalg.det(found) < 0
        found[mirrored, weakest[mirrored]] *= -1
        trace = np.trace(found, axis1=1, axis2=2)
        best, most = np.where((trace > most)[:, None, None], found, best), np.maximum(trace, most)
    return best
