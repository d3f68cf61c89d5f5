"""What size a splat needs: as far as points lie apart about it, whatever single ones do."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.splats.sizes import LARGE, NEIGHBOURS, areas, needed_sizes


def grid(n: int, step: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])


def spacing_of(position: np.ndarray) -> np.ndarray:
    return cKDTree(position).query(position, k=5)[0][:, 4]


def test_sizes__are_the_median_over_the_splat_and_its_neighbours():
    position = np.random.default_rng(2).random((500, 3))
    spacing = spacing_of(position)
    found = needed_sizes(position, spacing, 0.1)
    for i in range(0, 500, 41):
        near = np.argsort(np.linalg.norm(position - position[i], axis=1))[: NEIGHBOURS + 1]
        assert found[i] == pytest.approx(np.median(spacing[near]))


def test_sizes__follow_the_spacing():
    fine, coarse = grid(40, 0.01), grid(20, 0.05) + [5, 0, 0]
    position = np.concatenate([fine, coarse])
    found = needed_sizes(position, spacing_of(position), 0.01)
    assert np.median(found[:1600]) == pytest.approx(0.01) and np.median(found[1600:]) == pytest.approx(0.05)


def test_sizes__a_stray_point_is_no_larger_than_the_surface_that_is_nearest():
    position = np.concatenate([grid(30, 0.1), [[1.5, 1.5, 40.0]]])
    assert needed_sizes(position, spacing_of(position), 0.1)[-1] <= 0.1 * 1.5


@pytest.mark.parametrize("position", [np.zeros((1, 3)), np.zeros((300, 3)), np.eye(3)], ids=["one", "copies", "three"])
def test_sizes__where_spacing_is_not_known_the_one_radius_stands(position):
    assert np.array_equal(needed_sizes(position, np.full(len(position), np.inf), 0.25), np.full(len(position), 0.25))


def test_sizes__the_area_that_needs_large_splats_is_counted_by_area():
    size = np.array([1.0, 1.0, 1.0, 1.0, 2.0, LARGE])
    assert areas(size, 1.0) == (4 + 4 + LARGE**2, 4.0)
