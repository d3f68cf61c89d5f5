"""Recursive median split along the longest axis: chunks of splats that share a box.

Paper: HPG 2021, section 3.5.1. Splits fall on the multiple of the unit nearest to the median, so every chunk but the
last holds exactly CHUNK splats and the chunk of splat i is i // CHUNK. While a node is larger than a group (the
splats of one culling test and one draw, 8192 in the paper's section 3.6) the unit is 4^k groups, k as large as the node
allows: so groups 4^k j to 4^k (j + 1) - 1 are one node for every j and k, and lie together.
"""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel
from storage.packed.schema import CHUNK, GROUP


def split_rank(n: int) -> int:
    """How many of a node's `n` points, more than CHUNK, go left: the multiple of the unit nearest to n / 2.

    >>> [split_rank(n * GROUP) // GROUP for n in (2, 4, 5, 8, 9, 147)]
    [1, 2, 4, 4, 4, 64]
    """
    unit = GROUP if n > GROUP else CHUNK
    while unit >= GROUP and 4 * unit < n:
        unit *= 4
    return round(n / 2 / unit) * unit


def bounds(position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of points (n, 3), n at least 1: axis by axis, which takes a tenth of extremes of three
    columns."""
    axes = np.ascontiguousarray(position.T)
    return axes.min(axis=1), axes.max(axis=1)


def longest_axis(low: np.ndarray, high: np.ndarray) -> int:
    """The axis of the largest extent; the first of equals."""
    return int(np.argmax(high - low))


def median_split(position: np.ndarray) -> np.ndarray:
    """The order that lists the points chunk by chunk. `position` (n, 3) finite; returns (n,) int64.

    Guarantees: a permutation; chunks of CHUNK consecutive points, the last may be shorter; ties and the
    points of a chunk keep the order of the input, so equal inputs give equal orders; any number of points from 0 on,
    duplicates included.
    """
    order, axes = np.arange(len(position)), np.ascontiguousarray(np.asarray(position, np.float64).T)
    pending = [(0, len(position))]
    while pending:
        start, stop = pending.pop()
        if stop - start <= CHUNK:
            continue
        low, high = extent(axes, order, start, stop)
        n_left = split_rank(stop - start)
        move_lowest(axes[longest_axis(low, high)], order[start:stop], n_left)
        pending += [(start, start + n_left), (start + n_left, stop)]
    return order


@kernel()
def extent(axes, order, start, stop):
    """Lowest and highest corner (3,) of the points order[start:stop], indices into axes (3, n)."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(start, stop):
        for axis in range(3):
            x = axes[axis, order[i]]
            low[axis], high[axis] = min(low[axis], x), max(high[axis], x)
    return low, high


@kernel()
def move_lowest(x, order, n):
    """Put the n of `order` (m,), indices into x, whose values a stable sort would have first, before the others; both
    as they were."""
    values = x[order]
    highest = np.partition(values, n - 1)[n - 1]
    n_ties = n
    for value in values:
        n_ties -= value < highest
    before, left, right = order.copy(), 0, n
    for i in range(len(values)):
        goes_left = values[i] < highest
        if values[i] == highest and n_ties > 0:
            goes_left, n_ties = True, n_ties - 1
        if goes_left:
            order[left] = before[i]
            left += 1
        else:
            order[right] = before[i]
            right += 1
