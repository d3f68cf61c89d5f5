"""A random path through a made set of pages, and what holds of the manager in each of its frames.

A window of pages slides over photographs and their levels, as a viewer who turns, walks and jumps would want them; a
second one runs ahead of it as predictions do. Some feedbacks are late or lost, loads take their time or fail.
"""

from __future__ import annotations

import numpy as np

from renderer.residency.feedback import BIAS, EMPTY, POSE, REQUIRED, Feedback, merged, with_ancestors
from renderer.residency.keys import evict_key, load_and_map_key
from renderer.residency.manager import FRESH_FRAMES, LOADED, LOADING, MAPPED, RECENT_FEEDBACKS, Manager, Orders
from storage.pages.layout import PageLayout

LAYOUT = PageLayout(((1400, 1000), (600, 1800), (900, 900)), 64)
FRAMES = 60
MOST_FRAMES = 2000  # of standing still, until nothing changes


def walk(seed: int, published: bool = False) -> None:
    """One path. Raises AssertionError naming what did not hold."""
    rng = np.random.default_rng(seed)
    n_pool, n_frame = int(rng.integers(4, 120)), int(rng.integers(1, 17))
    manager = Manager(LAYOUT.level_of, LAYOUT.parents, n_pool, n_frame, published)
    state = _State(manager, rng, published)
    viewer = _Viewer(rng)
    for frame in range(FRAMES):
        viewer.move()
        state.frame(frame, viewer.wants() if rng.random() < 0.9 else None)
    _settles(state, viewer, FRAMES)


def _settles(state: _State, viewer: _Viewer, frame: int) -> None:
    """Nobody starves: who stands still has what is required, or a pool full of it; and nothing comes and goes."""
    found = viewer.wants()
    required = found.page[found.tier == REQUIRED]
    manager, quiet = state.manager, 0
    for now in range(frame, frame + MOST_FRAMES):
        orders = state.frame(now, found, reliable=True)
        quiet = 0 if len(orders.load) + len(orders.map) + len(orders.evict) + len(state.loading) else quiet + 1
        mapped = int((manager.state[required] == MAPPED).sum())
        if mapped == len(required) or (mapped == manager.n_pool and quiet > RECENT_FEEDBACKS):
            return
        if state.published and len(found.page) > manager.n_pool:
            return  # the published rules have no guard there
    raise AssertionError(
        f"{mapped} of {len(required)} required pages in a pool of {manager.n_pool} after {MOST_FRAMES} frames"
    )


class _State:
    def __init__(self, manager: Manager, rng: np.random.Generator, published: bool) -> None:
        self.manager, self.rng, self.published = manager, rng, published
        self.loading: set[int] = set()

    def frame(self, frame: int, found: Feedback | None, reliable: bool = False) -> Orders:
        m, rng = self.manager, self.rng
        came = [page for page in sorted(self.loading) if reliable or rng.random() < 0.5]
        if came and not reliable and rng.random() < 0.1:
            m.failed(np.array(came[:1]))
            self.loading.discard(came.pop(0))
        before = m.state.copy()
        seen_before = m.last_seen.copy()
        orders = m.step(frame, found, np.array(came, np.int64))
        self.loading -= set(came)
        assert m.n_mapped <= m.n_pool, "more mapped than the pool holds"
        assert (m.state[LAYOUT.is_tail] == MAPPED).all(), "a tail that is not there"
        assert len(orders.load) <= m.n_frame >= len(orders.map), "more than the bandwidth"
        assert not self.loading & set(orders.load.tolist()), "asked for twice"
        assert np.isin(before[orders.map], (LOADING, LOADED)).all(), "mapped and never loaded"
        assert (before[orders.evict] == MAPPED).all() and not set(orders.map.tolist()) & set(orders.evict.tolist())
        if not self.published:
            required = m.last_required > m._heard - RECENT_FEEDBACKS
            assert not required[orders.evict].any(), "a page needed now was evicted"
            fresh = int((frame - np.maximum(seen_before, m.last_seen)[orders.evict] <= FRESH_FRAMES).sum())
            assert fresh <= int(required[orders.map].sum()), "a predicted page evicted one seen lately"
            assert m.n_pool < len(LAYOUT.parents) or not len(orders.evict), "evicted from a pool that holds all"
        self.loading |= set(orders.load.tolist())
        return orders


class _Viewer:
    """A window of pages of a photograph and level, with a speed."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.reach = rng.integers(1, 5, 2)
        self.jump()

    def jump(self) -> None:
        self.photo = int(self.rng.integers(len(LAYOUT.sizes_px)))
        self.at, self.level = self.rng.random(2), float(self.rng.uniform(0, 3))
        self.speed, self.zoom = self.rng.normal(0, 0.03, 2), float(self.rng.normal(0, 0.05))

    def move(self) -> None:
        if self.rng.random() < 0.03:
            self.jump()
        self.at, self.level = (self.at + self.speed) % 1.0, abs(self.level + self.zoom)

    def wants(self) -> Feedback:
        parts = [self.window(0.0, 0.0, REQUIRED), self.window(6.0, 0.0, POSE), self.window(0.0, -0.5, BIAS)]
        return merged([with_ancestors(part, LAYOUT.parents) for part in parts])

    def window(self, ahead: float, bias: float, tier: int) -> Feedback:
        width, height = LAYOUT.sizes_px[self.photo]
        level = int(max(0.0, self.level + bias))
        step = LAYOUT.page_px * 2**level
        place = (self.at + ahead * self.speed) % 1.0
        x, y = np.meshgrid(*(np.arange(n) * step for n in self.reach))
        x, y = (x.ravel() + place[0] * width) % width, (y.ravel() + place[1] * height) % height
        page = np.unique(LAYOUT.pages_at(np.full(len(x), self.photo), np.full(len(x), level), x, y))
        page = page[~LAYOUT.is_tail[page]]
        n = len(page)
        if not n:
            return EMPTY
        return Feedback(
            page, np.full(n, tier, np.int8), self.rng.uniform(1, 1e4, n), self.rng.integers(0, 256, n).astype(np.uint8)
        )


def keys_order(seed: int, n: int = 64) -> None:
    """The 64-bit keys of Figure 5 sort as their fields do, one after the other."""
    rng = np.random.default_rng(seed)
    last, predicted = rng.integers(0, 1 << int(rng.integers(1, 40)), n), rng.random(n) < 0.5
    level, difference, parent = (rng.integers(0, 16, n) for _ in range(3))
    distance = rng.integers(0, 256, n).astype(np.uint8)
    rows = np.lexsort((255 - distance.astype(int), 15 - parent, difference, level, ~predicted, last))
    keys = load_and_map_key(last, predicted, level, difference, parent, distance)
    assert (np.diff(keys[rows].astype(object)) >= 0).all(), "loadAndMapKey does not sort as its fields"
    assert len(set(keys.tolist())) == len(set(zip(*map(np.ndarray.tolist, (last, predicted, level, difference, parent, distance)), strict=True)))  # fmt: skip
    evicted = evict_key(last, level)
    assert (np.diff(evicted[np.lexsort((level, last))].astype(object)) >= 0).all(), (
        "evictKey does not sort as its fields"
    )
