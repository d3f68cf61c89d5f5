"""Cells of points: how many points they hold, the size that is searched for, normals that cancel."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.hcp import REACH, centres_of
from pipeline.geometry.runs.cells import CANCELLED, average_normals, fill, from_grid, in_grid, search_size


def sphere(n: int, seed: int = 0) -> np.ndarray:
    v = np.random.default_rng(seed).normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_fill__loses_no_point_by_more_than_a_cell_reaches(axis):
    points = sphere(5000)
    assert np.array_equal(from_grid(in_grid(points, axis), axis), points)
    cells = fill(points, 0.05, axis)
    centre = from_grid(centres_of(cells.key, 0.05), axis)
    far = np.linalg.norm(points[:, None] - centre[None], axis=2).min(axis=1)
    assert far.max() <= REACH * 0.05
    assert cells.hit_rate == len(points) / len(cells.key) and (np.diff(cells.key) > 0).all()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize("most", [1.2, 1.6, 3.0])
def test_search__meets_the_hit_rate_closely_at_any_scale(scale, most):
    cells = search_size(sphere(20_000) * scale, most)
    assert 0.97 * most <= cells.hit_rate <= most


def test_search__of_copies_and_of_one_place():
    points = sphere(500)
    cells = search_size(np.repeat(points, 4, axis=0))
    assert 4 <= cells.hit_rate < 4.2
    assert len(search_size(np.zeros((50, 3))).key) == 1
    assert len(search_size(np.array([[0.0, 0, 0], [1, 0, 0]])).key) == 2


def test_average_normals__are_unit_where_normals_cancel_are_zero_or_nan():
    position = np.zeros((9, 3))
    position[3:6, 0], position[6:, 0] = 10, 20
    normal = np.array(
        [[0, 0, 2.0], [0, 0, -1], [0, 0, 1], [0, 1, 0], [0, -1, 0], [np.nan, 0, 0], [0, 0, 0], [np.nan] * 3, [0] * 3]
    )
    found = average_normals(position, normal, fill(position, 1.0))
    assert np.allclose(found, [[0, 0, 1], [0, 1, 0], [0, 0, 1]])
    plain = normal[3:5].sum(axis=0)
    assert np.linalg.norm(plain) < CANCELLED  # what a mean alone would divide by
