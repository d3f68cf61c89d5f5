"""Each coarser splat stands for about four: none is lost, surfaces and thin parts stay covered."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pipeline.geometry.chunks import median_split
from pipeline.splats.coarser import coarser_splats, level_sizes, mean_colors, rows_of_group
from storage.packed.levels import n_coarser
from storage.packed.schema import CHUNK, GROUP

N = 4 * GROUP


def plane(n: int = N, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    position = np.column_stack([rng.uniform(0, 1, (n, 2)), np.zeros(n)])
    return ordered(position, np.tile([0.0, 0.0, 1.0], (n, 1)))


def corner(n: int = N) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A wall that stands on a floor."""
    position, _, _ = plane(n)
    wall = position[:, 0] > 0.5
    position[wall] = np.column_stack([np.full(wall.sum(), 0.5), position[wall, 1], position[wall, 0] - 0.5])
    return ordered(position, np.where(wall[:, None], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))


def wire(n: int = N) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    along = np.random.default_rng(0).uniform(0, 100, n)
    return ordered(np.column_stack([along, np.sin(along), np.cos(along)]), np.tile([0.0, 0.6, 0.8], (n, 1)))


def ordered(position: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In chunk order, with the distance to the 4th neighbour as radius."""
    order = median_split(position)
    radius = cKDTree(position).query(position, 5)[0][:, 4]
    return position[order], normal[order], radius[order]


@pytest.mark.parametrize("n", [N, N + 5000, 8 * GROUP - 1])
@pytest.mark.parametrize("make", [plane, corner, wire])
def test_coarser__every_splat_has_one_that_stands_for_it(make, n):
    found = coarser_splats(*make(n))
    counts = np.bincount(found.cell, minlength=GROUP)
    assert counts.min() >= 1 and counts.sum() == n
    assert (found.cell[found.middle] == np.arange(GROUP)).all()
    chunk = found.cell // CHUNK
    assert (np.diff(chunk) >= 0).all()  # a chunk stands for consecutive splats


@pytest.mark.parametrize("make", [plane, corner, wire])
def test_coarser__centres_stay_covered(make):
    position, normal, radius = make()
    found = coarser_splats(position, normal, radius)
    away = np.linalg.norm(position - found.position[found.cell], axis=1)
    assert (away <= found.radius[found.cell] * (1 + 1e-9)).mean() > 0.998
    mean = np.sqrt(np.bincount(found.cell, radius**2))
    assert (found.radius >= mean * (1 - 1e-9)).all() and (found.radius <= 1.5 * mean * (1 + 1e-9)).all()


def test_coarser__a_plane_stays_a_plane_of_twice_the_radius():
    position, normal, radius = plane()
    found = coarser_splats(position, normal, radius)
    assert np.abs(found.position[:, 2]).max() == 0 and np.abs(found.normal - [0, 0, 1]).max() < 1e-12
    assert np.median(found.radius) == pytest.approx(2 * np.median(radius), rel=0.05)
    coarse = cKDTree(found.position).query(found.position, 5)[0][:, 4]
    assert np.median(coarse) == pytest.approx(2 * np.median(radius), rel=0.15)
    assert np.percentile(coarse, 99) < 1.6 * np.median(coarse)  # more even than by chance: 1.9 then


def test_coarser__no_splat_floats_between_two_surfaces():
    found = coarser_splats(*corner())
    on_floor, on_wall = np.abs(found.position[:, 2]) < 1e-12, np.abs(found.position[:, 0] - 0.5) < 1e-12
    assert (on_floor | on_wall).all()
    facing_up = found.normal[:, 2] > 0.99
    assert (facing_up | (found.normal[:, 0] < -0.99)).all()


def test_coarser__normals_turned_either_way_do_not_cancel():
    position, normal, radius = plane()
    flipped = normal * np.where(np.arange(N) % 2, 1, -1)[:, None]
    found = coarser_splats(position, flipped, radius)
    assert np.abs(np.abs(found.normal[:, 2]) - 1).max() < 1e-12


def test_coarser__a_stray_among_four_makes_no_blob():
    position, normal, radius = plane()
    position = position.copy()
    position[1000] = [50.0, 50.0, 50.0]
    found = coarser_splats(position, normal, radius)
    assert found.radius.max() < 4 * np.median(found.radius)


@pytest.mark.parametrize("position", [np.zeros((N, 3)), np.full((N, 3), 5.4e6)])
def test_coarser__equal_points_are_merged_to_themselves(position):
    found = coarser_splats(position, np.tile([0.0, 0.0, 1.0], (N, 1)), np.full(N, 0.1))
    assert (found.position == position[0]).all() and np.allclose(found.radius, 0.2)


def test_coarser__levels_are_whole_groups_and_a_third_in_all():
    for n in (1, 4 * GROUP - 1, 4 * GROUP, 330_000, 10**6, 71 * 10**6):
        sizes = level_sizes(n, 6)
        assert sizes[0] == n and all(s % GROUP == 0 for s in sizes[1:])
        assert 3 * sum(sizes[1:]) <= n


@pytest.mark.parametrize("n", [4 * GROUP, 4 * GROUP + 1, 330_000])
def test_coarser__groups_stand_for_four_and_the_last_for_the_rest(n):
    rows = [rows_of_group(j, n) for j in range(n_coarser(n) // GROUP)]
    assert rows[0][0] == 0 and rows[-1][1] == n
    assert all(a[1] == b[0] == 4 * GROUP * (i + 1) for i, (a, b) in enumerate(zip(rows, rows[1:])))
    assert 4 * GROUP <= rows[-1][1] - rows[-1][0] < 8 * GROUP


def test_coarser__colours_are_means_in_linear_light_by_area():
    cell = np.array([0, 0, 1, 1])
    color = np.array([[0, 0, 0], [255, 255, 255], [10, 20, 30], [10, 20, 30]], np.uint8)
    even = mean_colors(color, np.ones(4), cell)
    assert even.tolist() == [[188] * 3, [10, 20, 30]]  # half the light of white is 188 in sRGB
    assert mean_colors(color, np.array([1.0, 1e-6, 1, 1]), cell)[0].tolist() == [0, 0, 0]


def test_coarser__of_unevenly_dense_splats_cells_are_as_large_not_as_many():
    """Of each chunk three quarters of the splats lie in a quarter of its square: by counts so would its cells."""
    place = np.random.default_rng(0).uniform(0, 1, (GROUP // CHUNK, 4 * CHUNK, 2))
    place[:, : 3 * CHUNK] *= 0.5
    dense = (place < 0.5).all(axis=2)
    position = np.dstack([place + 2 * np.arange(len(place))[:, None, None], np.zeros(dense.shape)]).reshape(-1, 3)
    found = coarser_splats(position, np.tile([0.0, 0.0, 1.0], (N, 1)), np.full(N, 0.04))
    assert dense.mean() > 0.75 and dense.ravel()[found.middle].mean() < 0.7
