"""Groups of splats in a pool of fixed size: what is missing is stood for by its nearest ancestor, and nothing is drawn
twice."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from renderer.residency.groups import GroupPool
from renderer.splats.detail import parents_of
from storage.packed.schema import GROUP

PARENT = parents_of((2 * GROUP, 11 * GROUP, 47 * GROUP))
CHILDREN = [np.flatnonzero(g == PARENT) for g in range(len(PARENT))]
LEAVES = np.flatnonzero([len(c) == 0 for c in CHILDREN])


def shares_at(rng: np.random.Generator) -> np.ndarray:
    """A cut through the tree with fades, as views ask for: shares along each path add up to 1."""
    refined = np.where(rng.random(len(PARENT)) < 0.5, 1.0, rng.random(len(PARENT)))
    refined[LEAVES] = 0
    shares, reach = np.zeros(len(PARENT)), np.ones(len(PARENT))
    for g in range(len(PARENT)):
        reach[g] = 1 if PARENT[g] < 0 else reach[PARENT[g]] * refined[PARENT[g]]
        shares[g] = reach[g] * (1 - refined[g])
    return shares.astype(np.float32)


def paths_sum(values: np.ndarray) -> np.ndarray:
    total = values.astype(float).copy()
    for g in range(len(PARENT)):
        total[g] += total[PARENT[g]] if PARENT[g] >= 0 else 0
    return total[LEAVES]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_groups__what_is_drawn_is_resident_and_stands_for_all_that_is_seen(seed):
    rng = np.random.default_rng(seed)
    pool, came = GroupPool(PARENT, int(rng.integers(1, 30)), int(rng.integers(1, 9))), np.empty(0, np.int64)
    for _ in range(12):
        shares, seen = shares_at(rng), rng.random(len(PARENT)) < 0.7
        for g in range(len(PARENT) - 1, -1, -1):  # boxes of parents hold those of their children
            seen[g] |= seen[CHILDREN[g]].any()
        came = pool.ask(shares, seen, came).load
        drawn = pool.drawn(shares, seen)
        assert not drawn[~pool.resident].any()
        assert np.allclose(paths_sum(drawn)[seen[LEAVES]], 1, atol=1e-6)
        assert pool.resident.sum() <= pool.manager.n_pool + len(pool.always)


def test_groups__with_all_of_them_there_the_shares_are_those_asked_for():
    shares, seen = shares_at(np.random.default_rng(7)), np.ones(len(PARENT), bool)
    pool, came = GroupPool(PARENT, 2 * len(PARENT), 8), np.empty(0, np.int64)
    assert not np.array_equal(pool.drawn(shares, seen), shares)
    for _ in range(60):
        came = pool.ask(shares, seen, came).load
    assert np.allclose(pool.drawn(shares, seen), shares, atol=1e-6)


def test_groups__one_missing_child_keeps_its_parent_in_its_brothers_place():
    shares = np.zeros(len(PARENT), np.float32)
    shares[LEAVES] = 1
    pool, came, seen = GroupPool(PARENT, 2 * len(PARENT), 64), np.empty(0, np.int64), np.ones(len(PARENT), bool)
    for _ in range(8):
        came = pool.ask(shares, seen, came).load
    lost = LEAVES[0]
    pool.manager.state[lost] = 0
    drawn = pool.drawn(shares, seen)
    brothers = CHILDREN[PARENT[lost]]
    assert drawn[PARENT[lost]] == 1 and not drawn[brothers].any() and (drawn[np.setdiff1d(LEAVES, brothers)] == 1).all()
    seen[lost] = False  # what no view shows is missed by none
    assert (pool.drawn(shares, seen)[brothers[1:]] == 1).all()
