"""Recursive median split along the longest axis: chunks of splats that share a box.

Paper: HPG 2021, section 3.5.1. Splits fall on the multiple of the unit nearest to the median, so every chunk but the
last holds exactly CHUNK splats and the chunk of splat i is i // CHUNK. While a node is larger than a group (the
splats of one culling test and one draw, 8192 in the paper's section 3.6) the unit is a whole group, so that groups
are compact too.
"""

from __future__ import annotations

import numpy as np

from storage.schema import CHUNK, GROUP


def split_rank(n: int) -> int:
    """How many of a node's `n` points, more than CHUNK, go left: the multiple of the unit nearest to n / 2."""
    unit = GROUP if n > GROUP else CHUNK
    return round(n / 2 / unit) * unit


def longest_axis(low: np.ndarray, high: np.ndarray) -> int:
    """The axis of the largest extent; the first of equals."""
    return int(np.argmax(high - low))


def median_split(position: np.ndarray) -> np.ndarray:
    """The order that lists the points chunk by chunk. `position` (n, 3) finite; returns (n,) int64.

    Guarantees: a permutation; chunks of CHUNK consecutive points, the last may be shorter; ties and the
    points of a chunk keep the order of the input, so equal inputs give equal orders; any number of points from 0 on, duplicates included.
    """
    order = np.arange(len(position))
    axes = np.ascontiguousarray(np.asarray(position).T)  # whole axes, so that extents are found by rows in vectors
    pending = [(0, len(position))]
    while pending:
        start, stop = pending.pop()
        if stop - start <= CHUNK:
            continue
        members = order[start:stop]
        points = axes[:, members]
        n_left = split_rank(stop - start)
        goes_left = _lowest(points[longest_axis(points.min(axis=1), points.max(axis=1))], n_left)
        order[start : start + n_left], order[start + n_left : stop] = members[goes_left], members[~goes_left]
        pending += [(start, start + n_left), (start + n_left, stop)]
    return order


def _lowest(x: np.ndarray, n: int) -> np.ndarray:
    """Which of the values (m,) are the n lowest, as a stable sort has them: (m,) bool."""
    highest = np.partition(x, n - 1)[n - 1]
    lowest, ties = x < highest, np.flatnonzero(x == highest)
    lowest[ties[: n - np.count_nonzero(lowest)]] = True
    return lowest
