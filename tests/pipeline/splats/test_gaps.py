"""Gaps between splats: discs that reach the farthest vertices of their cells leave none, and nothing grows over a
rim."""

import numpy as np
import pytest
from scipy.spatial import Voronoi, cKDTree

from pipeline.splats.gaps import MOST, gap_radii, neighbours_in_reach
from pipeline.splats.neighbours import Blocks, points_around
from pipeline.splats.sizes import needed_sizes

NOWHERE = np.empty((0, 3))


def plane(n: int, seed: int = 0) -> np.ndarray:
    return np.column_stack([np.random.default_rng(seed).random((n, 2)), np.zeros(n)])


def sizes_and_gaps(position, normal=(0.0, 0.0, 1.0), around=NOWHERE):
    spacing = cKDTree(position).query(position, k=5)[0][:, 4]
    size = needed_sizes(position, spacing, 0.01)
    unit = np.broadcast_to(np.array(normal) / np.linalg.norm(normal), position.shape)
    return size, gap_radii(*neighbours_in_reach(position, around), unit, size)


def bare_share(position, radius):
    """Of a lattice on the plane's middle: what no disc covers."""
    x, y = np.meshgrid(np.linspace(0.1, 0.9, 300), np.linspace(0.1, 0.9, 300))
    at = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    away, near = cKDTree(position).query(at, k=30)
    return 1 - (away <= radius[near]).any(axis=1).mean()


def test_gap_radii__cover_a_plane_of_random_points():
    position = plane(4000)
    size, gap = sizes_and_gaps(position)
    assert bare_share(position, size) > 0.02
    assert bare_share(position, np.maximum(size, gap)) < 0.0025
    assert (np.maximum(size, gap) ** 2).sum() < 1.13 * (size**2).sum()


def test_gap_radii__are_those_of_a_brute_force_cell_whichever_way_the_plane_lies():
    position = plane(300, 1)
    size, gap = sizes_and_gaps(position)
    cells = Voronoi(position[:, :2])
    for i in range(0, 300, 7):
        region = cells.regions[cells.point_region[i]]
        if -1 in region or np.abs(position[i, :2] - 0.5).max() > 0.35:
            continue
        away = np.linalg.norm(cells.vertices[region] - position[i, :2], axis=1)
        assert gap[i] == pytest.approx(away[away <= MOST * size[i]].max())
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turned = sizes_and_gaps(position @ turn.T, turn @ [0, 0, 1])[1]
    np.testing.assert_allclose(turned, gap, rtol=1e-6)


def test_gap_radii__of_a_lattice_ask_for_nothing_more_and_rims_stay_where_they_are():
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    position = np.column_stack([x.ravel(), y.ravel(), np.zeros(900)])
    size, gap = sizes_and_gaps(position)
    assert (gap <= size).all()
    window = position[np.abs(position[:, :2] - 14.5).max(axis=1) > 5]  # no gap of the sampling
    size, gap = sizes_and_gaps(window)
    assert (gap <= size).all()


def test_gap_radii__close_stripes_between_rows_of_a_scanner():
    x, y = np.meshgrid(np.arange(120) * 0.25, np.arange(30.0))
    position = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    size, gap = sizes_and_gaps(position)
    inner = np.abs(position[:, :2] - [15, 14.5]).max(axis=1) < 8
    assert size[inner].max() < 0.51 and (gap[inner] >= 0.5).all()


def test_gap_radii__see_points_of_other_blocks():
    position = plane(2000, 3)
    low, high = np.array([[0, 0, 0], [0.5, 0, 0], [9, 9, 9]]), np.array([[0.5, 1, 0], [1, 1, 0], [9, 9, 9]])
    blocks = [position[position[:, 0] < 0.5], position[position[:, 0] >= 0.5], np.full((1, 3), 9.0)]
    around = points_around(0, 0.1, Blocks(blocks.__getitem__, low, high))
    assert len(around) == (np.abs(blocks[1][:, 0] - 0.5) <= 0.1).sum()
    whole = sizes_and_gaps(position)[1][position[:, 0] < 0.5]
    parts = gap_radii(
        *neighbours_in_reach(blocks[0], around),
        np.tile([0.0, 0, 1], (len(blocks[0]), 1)),
        sizes_and_gaps(position)[0][position[:, 0] < 0.5],
    )
    np.testing.assert_array_equal(parts, whole)


@pytest.mark.parametrize(
    "position",
    [np.zeros((1, 3)), np.zeros((300, 3)), np.arange(300)[:, None] * [1.0, 2, 3], np.random.default_rng(4).random((300, 3))],
    ids=["one", "copies", "line", "cloud"],
)  # fmt: skip
def test_gap_radii__of_what_is_no_surface_are_small_and_finite(position):
    size, gap = sizes_and_gaps(position)
    assert np.isfinite(gap).all() and (gap <= MOST * size).all() and (gap > size).mean() < 0.05
