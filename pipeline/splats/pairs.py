"""Which splats lie about some of a block's, each looked about in as many of its own radii."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def pairs_within(position: np.ndarray, rows: np.ndarray, reach: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and others (p,) int64, flat: of `rows` (m,) of `position` (n, 3) each with all that lie within its `reach`,
    (m,) or one for all, itself among them; ascending."""
    tree = cKDTree(position)
    found = tree.query_ball_point(position[rows], reach, return_sorted=True)
    counts = np.fromiter(map(len, found), np.int64, len(rows))
    return np.repeat(rows, counts), np.fromiter((j for near in found for j in near), np.int64, int(counts.sum()))
