"""Groups of splats as pages: which groups of a file with levels are in a pool of fixed size, and what is drawn
meanwhile.

A group is a page of another kind: it has a level, a parent (that stands for it where it is missing), and takes one
place of the pool. So states, order and eviction are those of photographs' pages (`manager.py`); the coarsest level is
the mip tail. This file knows neither files nor graphics: who draws loads what `ask` says, says what has come, and draws
the shares of `drawn`.

    pool = GroupPool(tree.parent, n_pool=200, n_frame=8)
    load(pool.always)
    while True:
        orders = pool.ask(shares_of(tree, view, header, detail), in_view(tree, view, eye), came)
        came = load(orders.load); drop(orders.evict); put(orders.map)
        draw(pool.drawn(shares, seen))
"""

from __future__ import annotations

import numpy as np

from renderer.residency.feedback import REQUIRED, Feedback, with_ancestors
from renderer.residency.manager import MAPPED, Manager, Orders

NOTHING = np.empty(0, np.int64)


class GroupPool:
    """At most `n_pool` groups beside those of the coarsest level, which are `always` there; at most `n_frame` asked for
    a frame.

    `parent` (g,) is that of each group, -1 of the coarsest level, and stands before it (renderer/splats/detail.py).

    Guarantees: those of `Manager`; `drawn` names resident groups alone; along the path from each leaf in view to the
    coarsest level its shares add up to what those that were asked for add up to.
    """

    def __init__(self, parent: np.ndarray, n_pool: int, n_frame: int) -> None:
        self.parent = parent
        depth = np.zeros(len(parent), np.int64)
        for group in np.flatnonzero(parent >= 0):  # parents come first
            depth[group] = depth[parent[group]] + 1
        self._levels = [np.flatnonzero(depth == d) for d in range(int(depth.max(initial=0)) + 1)]
        self.manager = Manager(depth.max(initial=0) - depth, parent, n_pool, n_frame)
        self._frame = 0

    @property
    def always(self) -> np.ndarray:
        """The groups (k,) of the coarsest level: to be loaded before the first frame, and kept."""
        return np.flatnonzero(self.parent < 0)

    @property
    def resident(self) -> np.ndarray:
        """(g,) bool."""
        return self.manager.state == MAPPED

    def ask(
        self, shares: np.ndarray, seen: np.ndarray, came: np.ndarray = NOTHING, pixels: np.ndarray | None = None
    ) -> Orders:
        """What to load, to put into the pool and to drop, groups (k,) each, the most important first. `shares` (g,) are
        those that a view asks for, `seen` (g,) bool what of them it shows, `came` (k,) what has been loaded since, and
        `pixels` (g,) how much each shows; alike unless told."""
        wanted = np.flatnonzero((shares > 0) & seen)
        n = len(wanted)
        shown = np.ones(n) if pixels is None else pixels[wanted].astype(np.float64)
        found = Feedback(wanted, np.full(n, REQUIRED, np.int8), shown, np.zeros(n, np.uint8))
        self._frame += 1
        return self.manager.step(self._frame, with_ancestors(found, self.parent), came)

    def drawn(self, shares: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """The share (g,) float32 with which each resident group is drawn: a group gives way to its children only where
        all of them that the view shows are there; else it stands for them."""
        needed = (shares > 0) & seen
        for groups in self._levels[:0:-1]:  # a group is needed where what is below it is
            np.logical_or.at(needed, self.parent[groups], needed[groups])
        missing = needed & ~self.resident
        blocked = np.zeros(len(shares), bool)
        np.logical_or.at(blocked, self.parent[missing & (self.parent >= 0)], True)
        reach, result = np.ones(len(shares)), np.zeros(len(shares))
        for groups in self._levels:
            above = self.parent[groups]
            inner = above >= 0
            reach[groups[inner]] = (reach - result)[above[inner]]
            left = reach[groups]
            result[groups] = np.where(blocked[groups], left, np.minimum(left, shares[groups]))
        result[~self.resident] = 0
        return result.astype(np.float32)
