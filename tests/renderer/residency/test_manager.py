"""The residency manager on random paths of a made set of pages: what holds whatever is asked for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from renderer.residency.feedback import BIAS, REQUIRED, Feedback, merged, with_ancestors
from renderer.residency.keys import evict_key, load_and_map_key
from renderer.residency.manager import FRESH_FRAMES, MAPPED, Manager
from storage.pages.layout import PageLayout
from tests.renderer.residency.random_paths import keys_order, walk

LAYOUT = PageLayout(((700, 500), (300, 900)), 64)
PAGES = np.flatnonzero(~LAYOUT.is_tail)


def feedback(rng: np.random.Generator, n: int) -> Feedback:
    page = rng.choice(PAGES, n, replace=False)
    tier = rng.integers(REQUIRED, BIAS + 1, n).astype(np.int8)
    found = Feedback(page, tier, rng.uniform(1, 1e5, n), rng.integers(0, 256, n).astype(np.uint8))
    return with_ancestors(found, LAYOUT.parents)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_manager__on_random_paths_its_guarantees_hold_and_nobody_starves(seed, published):
    """`benchmarks.residency` walks 10,000 of them."""
    walk(seed, published)
    keys_order(seed)


@pytest.mark.parametrize("published", [False, True])
def test_manager__what_is_asked_for_again_and_again_is_mapped_if_it_fits(published):
    rng = np.random.default_rng(5)
    wanted = feedback(rng, 10)
    wanted = Feedback(wanted.page, np.zeros_like(wanted.tier), wanted.pixels, wanted.distance)
    n_pool = int(wanted.n_pages / 0.8) + 2
    manager, loading = Manager(LAYOUT.level_of, LAYOUT.parents, n_pool, 2, published), np.empty(0, np.int64)
    for frame in range(100):
        loading = manager.step(frame, wanted, loading).load
    assert (manager.state[wanted.page] == MAPPED).all()


def test_manager__a_predicted_page_evicts_none_seen_lately():
    manager = Manager(LAYOUT.level_of, LAYOUT.parents, 2, 4)
    seen, predicted = PAGES[:2], PAGES[5:7]

    def asked(pages, tier):
        n = len(pages)
        return Feedback(pages, np.full(n, tier, np.int8), np.full(n, 100.0), np.zeros(n, np.uint8))

    loading = np.empty(0, np.int64)
    for frame in range(5):
        loading = manager.step(frame, asked(seen, REQUIRED), loading).load
    assert (manager.state[seen] == MAPPED).all()
    for frame in range(5, 4 + FRESH_FRAMES):
        loading = manager.step(frame, asked(predicted, BIAS), loading).load
        assert (manager.state[seen] == MAPPED).all()


def test_keys__order_as_figure_5_says():
    """Each row beats all after it, for loading; bits of a field never reach its neighbour."""
    rows = [  # last seen, predicted, level, difference, parent's level, distance
        (9, True, 0, 0, 15, 255),
        (8, False, 0, 0, 15, 255),
        (8, True, 3, 0, 15, 255),
        (8, True, 2, 5, 15, 255),
        (8, True, 2, 4, 0, 255),
        (8, True, 2, 4, 1, 0),
        (8, True, 2, 4, 1, 1),
    ]
    keys = load_and_map_key(*(np.array(column) for column in zip(*rows, strict=True)))
    assert keys.dtype == np.uint64 and (np.diff(keys.astype(object)) < 0).all()
    evicted = evict_key(np.array([3, 3, 4]), np.array([0, 2, 0]))
    assert evicted[0] < evicted[1] < evicted[2], "seen longest ago, of those the finest first"


def test_feedback__a_page_has_the_first_reason_that_wants_it():
    one = Feedback(np.array([3, 7]), np.array([2, 0], np.int8), np.array([5.0, 6.0]), np.array([9, 8], np.uint8))
    two = Feedback(np.array([3]), np.array([0], np.int8), np.array([4.0]), np.array([20], np.uint8))
    found = merged([one, two])
    assert found.page.tolist() == [3, 7] and found.tier.tolist() == [0, 0]
    assert found.pixels.tolist() == [4.0, 6.0] and found.distance.tolist() == [9, 8]


def test_feedback__ancestors_of_a_page_are_wanted_with_it():
    leaf = PAGES[:1]
    found = with_ancestors(Feedback(leaf, np.zeros(1, np.int8), np.ones(1), np.zeros(1, np.uint8)), LAYOUT.parents)
    chain, at = [], int(leaf[0])
    while LAYOUT.parents[at] >= 0:
        chain.append(at)
        at = int(LAYOUT.parents[at])
    assert found.page.tolist() == sorted(chain)
