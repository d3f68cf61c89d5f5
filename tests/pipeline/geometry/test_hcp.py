"""The HCP grid against brute force over all cells about a point."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pipeline.geometry.hcp import (
    IN_SLICE,
    MOST,
    N_NEIGHBOURS,
    REACH,
    ROW,
    SLICE,
    centres_of,
    index_of,
    key_of,
    keys_of,
    neighbour,
)
from storage.errors import InvalidScan


def _lattice(reach: int) -> np.ndarray:
    """Columns, rows and slices -reach..reach, (n, 3) int64."""
    return np.array(list(itertools.product(*[range(-reach, reach + 1)] * 3)))


def _centres(cells: np.ndarray, size: float) -> np.ndarray:
    c, r, s = cells.T
    return size * np.stack([c + 0.5 * ((r + s) % 2), ROW * (r + (s % 2) / 3), SLICE * s], axis=1)


@pytest.mark.parametrize("size", [1.0, 0.037, 12.5])
def test_cell_of__is_the_nearest_centre_by_brute_force(size):
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (20_000, 3)) * size
    cells = _lattice(6)
    far = np.stack([((points - centre) ** 2).sum(axis=1) for centre in _centres(cells, size)], axis=1)
    nearest = far.min(axis=1)
    keys = keys_of(points, size)
    of_brute_force = np.array([key_of(*cells[i]) for i in far.argmin(axis=1)])
    assert np.array_equal(keys, of_brute_force)
    off = np.linalg.norm(points - centres_of(keys, size), axis=1)
    assert np.allclose(off, np.sqrt(nearest), atol=1e-12 * size)
    assert off.max() <= REACH * size


def test_cell_of__of_points_on_borders_is_one_of_the_nearest_and_the_same_wherever_the_cell_lies():
    cells = _lattice(1)
    centre = _centres(cells, 1.0)
    others = _centres(_lattice(4), 1.0)
    for shift in ((0, 0, 0), (1000, 2000, -3000)):
        move = _centres(np.array([shift]), 1.0)
        for a, b in itertools.combinations(centre, 2):
            if abs(np.linalg.norm(a - b) - 1) < 1e-9:
                middle = (a + b) / 2
                found = centres_of(keys_of(middle[None] + move, 1.0), 1.0)[0] - move[0]
                least = np.linalg.norm(others - middle, axis=1).min()
                assert abs(np.linalg.norm(found - middle) - least) < 1e-9


def test_key__comes_back_and_orders_by_slice_row_column():
    cells = np.random.default_rng(1).integers(-MOST, MOST, (5000, 3))
    keys = np.array([key_of(*map(int, c)) for c in cells])
    assert [index_of(int(k)) for k in keys] == [tuple(c) for c in cells]
    assert np.array_equal(np.argsort(keys, kind="stable"), np.lexsort(cells.T))


def test_centre__of_each_cell_lies_in_it():
    keys = np.array([key_of(*map(int, c)) for c in np.random.default_rng(2).integers(-50_000, 50_000, (5000, 3))])
    assert np.array_equal(keys_of(centres_of(keys, 0.25), 0.25), keys)


@pytest.mark.parametrize("row,slice_", [(0, 0), (1, 0), (0, 1), (1, 1), (-1, -2), (-2, -3)])
def test_neighbours__are_the_12_at_one_cell_and_the_reverse_of_k_is_k_plus_3(row, slice_):
    cell = (5, row, slice_)
    around = [neighbour(*cell, k) for k in range(N_NEIGHBOURS)]
    assert len(set(around)) == N_NEIGHBOURS
    off = _centres(np.array(around), 1.0) - _centres(np.array([cell]), 1.0)
    assert np.allclose(np.linalg.norm(off, axis=1), 1)
    for k in range(IN_SLICE):
        assert around[k][2] == slice_
        assert neighbour(*around[k], (k + 3) % 6) == cell
    assert {n[2] - slice_ for n in around[6:]} == {1, -1}


def test_large_coordinates__keep_their_cell_and_those_beyond_the_bits_are_refused():
    points = np.random.default_rng(3).uniform(0.9e6, 1e6, (1000, 3))
    off = np.linalg.norm(points - centres_of(keys_of(points, 1.5), 1.5), axis=1)
    assert off.max() <= REACH * 1.5
    with pytest.raises(InvalidScan, match="choose a cell of"):
        keys_of(np.array([[2e6, 0.0, 0.0]]), 1.0)
    with pytest.raises(InvalidScan):
        keys_of(np.array([[np.nan, 0.0, 0.0]]), 1.0)
