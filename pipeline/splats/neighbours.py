"""Nearest neighbours over blocks of a scan too large for one tree: exact, one block's tree at a time.

A block's points find their neighbours at home first; whoever's farthest lies beyond the box of another block asks
there too, nearest box first. Equal positions count once: a scanned twin is no neighbour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.execution.compiled import kernel
from pipeline.splats.boxes import RUN, around_runs


@dataclass(frozen=True)
class Blocks:
    """The points of a scan in blocks, each in its box."""

    load: Callable[[int], np.ndarray]  # positions (m, 3) float64 of a block
    low: np.ndarray  # (n_blocks, 3) lowest corners of the blocks' boxes
    high: np.ndarray  # (n_blocks, 3)
    runs: tuple[np.ndarray, np.ndarray] | None = None  # (n_runs, 3) those around runs of blocks, where they are known

    def within(self, block: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """The blocks (m,) whose boxes lie no farther than `reach` from that of `block`, ascending, and how far (m,)."""
        low, high = self.low[block], self.high[block]
        of_runs = self.runs or around_runs(self.low, self.high)
        runs = np.flatnonzero(_box_distance(low, high, *of_runs) <= reach)
        near = (runs[:, None] * RUN + np.arange(RUN)).ravel()
        near = near[near < len(self.low)]
        apart = _box_distance(low, high, self.low[near], self.high[near])
        return near[apart <= reach], apart[apart <= reach]


@dataclass(frozen=True)
class Neighbours:
    """The k nearest other positions of each point, nearest first; where there are fewer, distance is inf."""

    distance: np.ndarray  # (n, k) float64
    position: np.ndarray  # (n, k, 3) float64; the point itself where distance is inf


def find_neighbours(
    block: int,
    k: int,
    blocks: Blocks,
) -> Neighbours:
    """The k nearest of every point of `block` among all blocks' distinct positions, the point's own left out."""
    low, high = blocks.low, blocks.high
    points, inverse = _distinct(blocks.load(block))
    distance = np.full((len(points), k), np.inf)
    position = np.repeat(points[:, None], k, axis=1)
    _ask(points, np.arange(len(points)), points, distance, position)
    near, apart = blocks.within(block, distance[:, -1].max())
    for place in np.argsort(apart, kind="stable"):
        other = int(near[place])
        if other == block:
            continue
        if apart[place] > distance[:, -1].max():
            break
        away = _box_distance(points, points, low[other], high[other])
        needy = np.flatnonzero(away < distance[:, -1])
        if len(needy):
            reach = distance[needy, -1].max() * (1 + 1e-9)  # beyond it none of them can be served
            there = blocks.load(other)
            there = there[_box_distance(there, there, points[needy].min(axis=0), points[needy].max(axis=0)) <= reach]
            if len(there):
                _ask(_distinct(there)[0], needy, points, distance, position)
    return Neighbours(distance[inverse], position[inverse])


def points_around(
    block: int,
    reach: float,
    blocks: Blocks,
) -> np.ndarray:
    """The positions (m, 3) float64 of other blocks that lie within `reach` of the block's box, in order of blocks."""
    low, high = blocks.low[block], blocks.high[block]
    near, _ = blocks.within(block, reach)
    there = [blocks.load(int(other)) for other in near if other != block]
    return np.concatenate([np.empty((0, 3)), *(p[_box_distance(p, p, low, high) <= reach] for p in there)])


def _ask(there: np.ndarray, needy: np.ndarray, points: np.ndarray, distance: np.ndarray, position: np.ndarray) -> None:
    """Merge the neighbours that the `needy` points have among `there` into `distance` and `position`."""
    n_asked = min(distance.shape[1] + 1, len(there))
    found_distance, found = cKDTree(there, balanced_tree=False).query(points[needy], k=n_asked)
    _merge(there, needy, found_distance.reshape(len(needy), -1), found.reshape(len(needy), -1), distance, position)


@kernel()
def _merge(there, needy, found_distance, found, distance, position):
    """Put what was found, (m, a) nearest first, between what rows `needy` (m,) of `distance` (n, k) and `position` (n,
    k, 3) have; of equally near ones what they have comes first. One at no distance is the point itself."""
    k, n_found = distance.shape[1], found.shape[1]
    old_distance, old_position = np.empty(k), np.empty((k, 3))
    for row, i in enumerate(needy):
        old_distance[:], old_position[:] = distance[i], position[i]
        old, new = 0, 0
        for j in range(k):
            while new < n_found and found_distance[row, new] <= 0:
                new += 1
            if new < n_found and found_distance[row, new] < old_distance[old]:
                distance[i, j], position[i, j] = found_distance[row, new], there[found[row, new]]
                new += 1
            else:
                distance[i, j], position[i, j] = old_distance[old], old_position[old]
                old += 1


def _distinct(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`np.unique` of rows (n, 3) with its inverse, in half of its time."""
    order = np.lexsort(points.T[::-1])
    ordered = points[order]
    is_first = np.ones(len(points), bool)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    inverse = np.empty(len(points), np.int64)
    inverse[order] = np.cumsum(is_first) - 1
    return ordered[is_first], inverse


def _box_distance(low: np.ndarray, high: np.ndarray, other_low: np.ndarray, other_high: np.ndarray) -> np.ndarray:
    """Distances of axis-aligned boxes (a point is a box too); the shapes broadcast to (..., 3)."""
    gap = np.maximum(np.maximum(other_low - high, low - other_high), 0)
    return np.linalg.norm(gap, axis=-1)
