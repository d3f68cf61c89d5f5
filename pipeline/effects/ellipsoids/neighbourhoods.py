"""Neighbourhoods by radius, else the k nearest, with the outlier rule of the 2020 paper, section 3.1.

The points that answer are thinned to one a cell first, so that a neighbourhood has the same reach where a scanner
stood close as where it stood far, and a bounded number of members.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

LEAST = 6  # the paper's N_min: fewer than these within the reach, and the nearest so many are taken
LEAST_AFTER_OUTLIERS = 3  # the paper's N_outlier
OUTLIER_REACHES = 3.0  # the paper's delta / epsilon: a neighbour further away than so many reaches is an outlier
CELL_RADII = 0.5
# One point a cell of half a radius leaves about 4 to 6 a square radius of a surface; so many of them reach at least
# 1.8 radii from the point, and 2.5 (every one that can be asked for) where the scan is not denser than its median.
MOST = 64


@dataclass(frozen=True)
class Neighbourhood:
    """Members of each point's neighbourhood as offsets from the point, nearest first, itself among them."""

    offset: np.ndarray  # (n, MOST, 3) float64; zeros beyond `count`
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


def gather(point: np.ndarray, around: np.ndarray, reach: float, tree: cKDTree | None = None) -> Neighbourhood:
    """The neighbourhoods of `point` (n, 3) among `around` (m, 3), which are distinct and hold all within
    OUTLIER_REACHES reaches.

    Members are those within `reach`; where they are fewer than LEAST, the nearest LEAST that are no outliers; where
    those are fewer than LEAST_AFTER_OUTLIERS, none. A point that thinning took out of `around` is put back. `tree` is that of
    `around`, where it is known.
    """
    if not len(around):
        return Neighbourhood(np.zeros((len(point), MOST, 3)), np.zeros(len(point), np.int64))
    k = min(MOST, len(around))
    distance, index = (tree or cKDTree(around)).query(point, k=k, distance_upper_bound=OUTLIER_REACHES * reach)
    distance, index = distance.reshape(len(point), k), index.reshape(len(point), k)
    offset = np.zeros((len(point), MOST, 3))
    offset[:, :k] = np.where(
        np.isfinite(distance)[..., None], around[np.minimum(index, len(around) - 1)] - point[:, None], 0
    )
    absent = ~(distance[:, 0] == 0)
    offset[absent, 1:], offset[absent, 0] = offset[absent, :-1], 0
    near = (distance <= reach).sum(axis=1) + absent
    known = np.isfinite(distance).sum(axis=1) + absent
    count = np.where(near >= LEAST, near, np.minimum(known, LEAST))
    return Neighbourhood(offset, np.where(count >= LEAST_AFTER_OUTLIERS, np.minimum(count, MOST), 0))
