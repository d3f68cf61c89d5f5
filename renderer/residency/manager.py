"""Which pages are resident: states, a fixed pool, and two policies that choose what is loaded, mapped and evicted.

A page is unknown, seen, loading, loaded or mapped (2020, section 4.4). The manager knows no graphics: each frame it
is told what was wanted and what has been loaded, and answers with what to load, what to map and what to evict. The same
rules are meant for the renderer and for the viewer in a browser.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from renderer.residency.feedback import REQUIRED, Feedback
from renderer.residency.keys import evict_key, load_and_map_key

UNKNOWN, SEEN, LOADING, LOADED, MAPPED = range(5)
NEVER = -(1 << 40)  # frame in which what was never seen was last seen
FRESH_FRAMES = 45  # a page seen within these is not evicted for one that is only predicted
DROPPED_FRAMES = 30  # unmapped pages unseen for longer are forgotten
RECENT_FEEDBACKS = 2  # pages of older ones are not asked for
MOST_WANTED = 0.8  # of the pool


@dataclass(frozen=True)
class Orders:
    """What is to happen in a frame; page numbers, the most important first."""

    load: np.ndarray
    map: np.ndarray
    evict: np.ndarray


class Manager:
    """`n_pool` pages at most are mapped beside the tails, `n_frame` at most are asked for, and mapped, a frame.

    Guarantees: never more than `n_pool` mapped; no page is mapped that was not loaded; by the default policy no page
    that is required now is evicted for another, and none seen within FRESH_FRAMES for one that is only predicted.
    """

    def __init__(
        self, level: np.ndarray, parents: np.ndarray, n_pool: int, n_frame: int, published: bool = False
    ) -> None:
        self.level, self.parents, self.n_pool, self.n_frame, self.published = level, parents, n_pool, n_frame, published
        n = len(level)
        self.state = np.where(parents < 0, MAPPED, UNKNOWN).astype(np.int8)
        self.is_tail = parents < 0
        self.last_seen = np.full(n, NEVER, np.int64)  # in a feedback
        self.last_required = np.full(n, NEVER, np.int64)
        self.tier = np.zeros(n, np.int8)
        self.gain = np.zeros(n)
        self.distance = np.zeros(n, np.uint8)
        self._heard = NEVER  # the frame of the last feedback

    @property
    def n_mapped(self) -> int:
        return int((self.state == MAPPED).sum() - self.is_tail.sum())

    def shown_level(self, pages: np.ndarray) -> np.ndarray:
        """(n,) the mip level that is shown where `pages` (n,) are wanted: their own where they are mapped, else that of
        the nearest ancestor that is; a tail always is."""
        at = pages.copy()
        while (missing := np.flatnonzero(self.state[at] != MAPPED)).size:
            at[missing] = self.parents[at[missing]]
        return self.level[at]

    def step(self, frame: int, found: Feedback | None, loaded: np.ndarray) -> Orders:
        """One frame: hear what was wanted (None where no feedback has come), and what has been loaded since."""
        self.state[loaded[self.state[loaded] == LOADING]] = LOADED
        if found is not None:
            self._hear(frame, found if self.published else self._trimmed(found))
        if not self.published:
            self._forget(frame)
        mapped, evicted = self._map(frame)
        return Orders(self._load(frame), mapped, evicted)

    def failed(self, pages: np.ndarray) -> None:
        """Pages that could not be loaded: they may be asked for again when they are seen again."""
        self.state[pages[self.state[pages] == LOADING]] = UNKNOWN

    def _hear(self, frame: int, found: Feedback) -> None:
        page = found.page
        self._heard = frame
        self.last_seen[page] = frame
        self.last_required[page[found.tier == REQUIRED]] = frame
        self.tier[page], self.distance[page] = found.tier, found.distance
        finer = np.maximum(self.shown_level(page) - self.level[page], 0)
        self.gain[page] = np.log2(1 + found.pixels * (1 + finer))
        self.state[page[self.state[page] == UNKNOWN]] = SEEN

    def _trimmed(self, found: Feedback) -> Feedback:
        """At most MOST_WANTED of the pool: the lowest tiers go first, of the same tier those with fewest pixels."""
        room = int(MOST_WANTED * self.n_pool)
        keep = np.lexsort((-found.pixels, found.tier))[:room]
        keep = np.union1d(keep, np.flatnonzero(found.tier == REQUIRED))
        return Feedback(found.page[keep], found.tier[keep], found.pixels[keep], found.distance[keep])

    def _forget(self, frame: int) -> None:
        stale = (frame - self.last_seen > DROPPED_FRAMES) & ((self.state == SEEN) | (self.state == LOADED))
        self.state[stale] = UNKNOWN

    def _load(self, frame: int) -> np.ndarray:
        """Never ahead of what is mapped: what waits to be mapped counts."""
        waiting = np.flatnonzero(self.state == SEEN)
        if not self.published:
            waiting = waiting[self.last_seen[waiting] > self._heard - RECENT_FEEDBACKS]
        chosen = self._by_importance(waiting)[: self.n_frame]
        self.state[chosen] = LOADING
        return chosen

    def _map(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        wanted = self._by_importance(np.flatnonzero(self.state == LOADED))[: self.n_frame]
        free = self.n_pool - self.n_mapped
        takes, gives = [wanted[: max(0, free)]], []
        rest = wanted[max(0, free) :]
        if len(rest):
            candidates = self._by_unimportance(frame)
            if self.published:
                n = min(len(rest), len(candidates))
                takes.append(rest[:n])
                gives.append(candidates[:n])
            else:
                taken, given = self._guarded(frame, rest, candidates)
                takes.append(taken)
                gives.append(given)
        mapped = np.concatenate(takes)
        evicted = np.concatenate(gives) if gives else np.empty(0, np.int64)
        self.state[evicted], self.state[mapped] = UNKNOWN, MAPPED
        return mapped, evicted

    def _guarded(self, frame: int, rest: np.ndarray, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A page that is required now goes for none, one seen within FRESH_FRAMES for none that is only predicted."""
        taken, given = [], []
        free_for_any = candidates[frame - self.last_seen[candidates] > FRESH_FRAMES]
        not_now = candidates[self.last_required[candidates] <= self._heard - RECENT_FEEDBACKS]
        used: set[int] = set()
        pools = {True: iter(not_now.tolist()), False: iter(free_for_any.tolist())}
        for page in rest.tolist():
            required = self.last_required[page] > self._heard - RECENT_FEEDBACKS
            victim = next((v for v in pools[bool(required)] if v not in used), None)
            if victim is not None:
                used.add(victim)
                taken.append(page)
                given.append(victim)
        return np.array(taken, np.int64), np.array(given, np.int64)

    def _by_importance(self, pages: np.ndarray) -> np.ndarray:
        """The most important first."""
        if self.published:
            level, parent = self.level[pages], self.level[self.parents[pages]]
            difference = np.maximum(self.shown_level(pages) - level, 0)
            key = load_and_map_key(
                self.last_seen[pages], self.tier[pages] != REQUIRED, level, difference, parent, self.distance[pages]
            )
            return pages[np.argsort(key, kind="stable")[::-1]]
        order = np.lexsort((pages, -self.level[pages], -self.gain[pages], self.tier[pages], -self.last_seen[pages]))
        return pages[order]

    def _by_unimportance(self, frame: int) -> np.ndarray:
        """Mapped pages, the first to go first: the oldest, of those what was only predicted, then the finest."""
        pages = np.flatnonzero((self.state == MAPPED) & ~self.is_tail)
        if self.published:
            return pages[np.argsort(evict_key(self.last_seen[pages], self.level[pages]), kind="stable")]
        order = np.lexsort((pages, self.level[pages], -self.tier[pages], self.last_seen[pages]))
        return pages[order]
