import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.geometry.chunks import longest_axis, median_split, split_rank
from storage.packed.schema import CHUNK, GROUP

# Few different values make ties and duplicates the rule.
COORDINATES = st.sampled_from([-1e9, -1.0, 0.0, 1e-300, 2.5])
POINTS = st.integers(0, 600).flatmap(lambda n: arrays(np.float64, (n, 3), elements=COORDINATES))


def random_points(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (n, 3)) * [4, 2, 1]


def mean_chunk_volume(position: np.ndarray, order: np.ndarray, rows: int = CHUNK) -> float:
    parts = [position[order[s : s + rows]] for s in range(0, len(order), rows)]
    return float(np.mean([np.prod(np.ptp(part, axis=0)) for part in parts]))


@settings(deadline=None, derandomize=True, max_examples=60)
@given(POINTS)
def test_chunks__order_is_a_permutation(position):
    assert np.array_equal(np.sort(median_split(position)), np.arange(len(position)))


@settings(deadline=None, derandomize=True, max_examples=60)
@given(POINTS)
def test_chunks__points_at_the_same_place_keep_their_order(position):
    order = median_split(position)
    for place in np.unique(position, axis=0):
        here = order[(position[order] == place).all(axis=1)]
        assert (np.diff(here) > 0).all()


@pytest.mark.parametrize("n", [0, 1, 2, CHUNK - 1, CHUNK])
def test_chunks__few_points_stay_as_they_are(n):
    assert np.array_equal(median_split(random_points(n)), np.arange(n))


@pytest.mark.parametrize("position", [np.ones((500, 3)), np.tile([5.4e6, 4.5e5, 100], (1000, 1))])
def test_chunks__equal_points_stay_as_they_are(position):
    assert np.array_equal(median_split(position), np.arange(len(position)))


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.integers(CHUNK + 1, 10 * GROUP))
def test_chunks__split_is_the_multiple_nearest_to_the_median(n):
    rank, unit = split_rank(n), max(u for u in (CHUNK, GROUP, 4 * GROUP) if u < n)
    assert 0 < rank < n
    assert rank % unit == 0
    nearest = min(range(unit, n, unit), key=lambda r: abs(r - n / 2))
    assert abs(rank - n / 2) == abs(nearest - n / 2)


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.integers(1, 3000), st.integers(0, 5))
def test_chunks__aligned_powers_of_four_groups_are_nodes(n_groups, k):
    """Each node holds groups 4^k j to 4^k (j + 1) - 1 whole, is held by them, or has nothing of them."""
    pending = [(0, n_groups * GROUP - 77)]
    while pending:
        start, n = pending.pop()
        first, last = start // GROUP // 4**k, (start + n - 1) // GROUP // 4**k
        assert start % (4**k * GROUP) == 0 or first == last
        if n > GROUP:
            pending += [(start, split_rank(n)), (start + split_rank(n), n - split_rank(n))]


@settings(deadline=None, derandomize=True, max_examples=60)
@given(POINTS)
def test_chunks__halves_are_those_of_a_stable_sort(position):
    def halves(members):
        if len(members) <= CHUNK:
            return list(members)
        points = position[members]
        axis = longest_axis(points.min(axis=0), points.max(axis=0))
        left = np.sort(np.argsort(points[:, axis], kind="stable")[: split_rank(len(members))])
        return halves(members[left]) + halves(np.delete(members, left))

    assert median_split(position).tolist() == halves(np.arange(len(position)))


def test_chunks__longest_axis_is_the_first_of_equals():
    assert longest_axis(np.zeros(3), np.array([1.0, 2.0, 2.0])) == 1
    assert longest_axis(np.array([-5.0, 0, 0]), np.array([1.0, 2.0, 2.0])) == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_chunks__a_line_is_cut_in_its_order(axis):
    position = np.zeros((1000, 3))
    position[:, axis] = np.random.default_rng(1).permutation(1000)
    along = position[median_split(position)][:, axis].astype(int)
    for start in range(0, 1000, CHUNK):
        assert sorted(along[start : start + CHUNK]) == list(range(start, min(start + CHUNK, 1000)))


def test_chunks__first_cut_is_along_the_longest_axis():
    position = random_points(16 * CHUNK)
    half = position[median_split(position)][:, 0]
    assert half[: 8 * CHUNK].max() <= half[8 * CHUNK :].min()


def test_chunks__are_compact():
    position = random_points(64 * CHUNK)
    box = np.prod(np.ptp(position, axis=0))
    assert mean_chunk_volume(position, median_split(position)) < box / 64


def test_chunks__groups_are_compact_and_whole():
    position = random_points(4 * GROUP + 77)
    box = np.prod(np.ptp(position, axis=0))
    assert mean_chunk_volume(position, median_split(position), GROUP) < box / 4


def test_chunks__same_input_gives_the_same_order_and_is_left_alone():
    position = random_points(1000)
    position.setflags(write=False)
    assert np.array_equal(median_split(position), median_split(position.copy()))


def test_chunks__moving_the_scan_changes_nothing():
    position = np.round(random_points(1000) * 1024) / 1024  # so that the sum is exact
    assert np.array_equal(median_split(position), median_split(position + [4.5e5, 5.4e6, 100]))


def test_chunks__a_million_duplicates_keep_their_order():
    order = median_split(np.full((1_000_000, 3), 7.0))
    assert np.array_equal(order, np.arange(1_000_000))
