"""Cells and leaves: what tasks count and deal out each for itself is one partition, whatever their number."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.geometry.cells import MOST_BITS, count_cells, grid_of, merge_counts
from pipeline.geometry.chunks import split_rank
from pipeline.geometry.leaves import Leaves, grow_leaves
from storage.packed.schema import GROUP

MOST = 4 * GROUP


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    n = 40 * GROUP + 77
    dense = rng.normal(size=(n, 3)) * 10.0 ** rng.uniform(-3, 0, (n, 1))
    return {
        "cloud": rng.normal(size=(n, 3)),
        "surface": np.column_stack([rng.uniform(0, 30, (n, 2)), 0.01 * rng.normal(size=n)]),
        "one far stray": np.concatenate([rng.normal(size=(n - 1, 3)), [[1e9, -1e9, 1e9]]]),
        "spacing varies a thousandfold": dense,
        "a line": np.outer(rng.uniform(0, 1, n), [1.0, 2.0, 3.0]),
        "georeferenced": rng.uniform(0, 30, (n, 3)) + [4.5e5, 5.4e6, 100],
        "equal groups": np.repeat(rng.normal(size=(n // GROUP + 1, 3)), GROUP, axis=0)[:n],
        "all equal": np.full((n, 3), 7.0),
    }


def grown(position: np.ndarray, most: int = MOST) -> tuple[Leaves, np.ndarray]:
    """Leaves, and the leaf of each point, found in one piece."""
    grid = grid_of(position[::16], MOST_BITS)
    cell = grid.cells_of(position)
    leaves = grow_leaves(count_cells(cell), grid, position.min(axis=0), position.max(axis=0), most)
    return leaves, leaves.of_points(cell, np.zeros(len(leaves.divided), np.int64))


@pytest.mark.parametrize("kind", clouds())
def test_leaves__hold_as_many_points_as_they_were_given(kind):
    leaves, of_points = grown(clouds()[kind])
    assert np.bincount(of_points, minlength=leaves.n_leaves).tolist() == np.diff(leaves.start).tolist()
    assert leaves.start[-1] == len(of_points)


@pytest.mark.parametrize("kind", sorted(clouds().keys() - {"all equal", "equal groups"}))
def test_leaves__fit_and_start_at_the_ranks_of_the_median_split(kind):
    position = clouds()[kind]
    leaves, _ = grown(position)

    def starts(first: int, n: int) -> list[int]:
        if n <= MOST:
            return [first]
        return starts(first, split_rank(n)) + starts(first + split_rank(n), n - split_rank(n))

    assert leaves.start.tolist() == [*starts(0, len(position)), len(position)]


@pytest.mark.parametrize("kind", clouds())
def test_leaves__do_not_depend_on_how_the_file_is_dealt_out(kind):
    position = clouds()[kind]
    leaves, expected = grown(position)
    grid = grid_of(position[::16], MOST_BITS)
    pieces = np.array_split(grid.cells_of(position), [17, 5000, 5001, 100_000])
    parts = [count_cells(cell) for cell in pieces]
    again = grow_leaves(merge_counts(parts), grid, position.min(axis=0), position.max(axis=0), MOST)
    n_before, found = np.zeros(len(again.divided), np.int64), []
    for cell in pieces:
        found.append(again.of_points(cell, n_before))
        n_before += np.array([(cell == divided).sum() for divided in again.divided], np.int64)
    assert np.concatenate(found).tolist() == expected.tolist()
    assert again.start.tolist() == leaves.start.tolist()


@pytest.mark.parametrize("kind", ["cloud", "surface", "one far stray", "georeferenced"])
def test_leaves__are_nearly_as_compact_as_those_of_exact_medians(kind):
    position = clouds()[kind]
    _, of_points = grown(position)

    def exact(members: np.ndarray) -> list[np.ndarray]:
        if len(members) <= MOST:
            return [members]
        axis = np.ptp(position[members], axis=0).argmax()
        members = members[np.argsort(position[members, axis], kind="stable")]
        left = split_rank(len(members))
        return exact(members[:left]) + exact(members[left:])

    def reach(parts: list[np.ndarray]) -> float:
        """Mean distance of points to the middle of their leaf, on the axes of what is not stray."""
        middle = [np.median(position[p], axis=0) for p in parts]
        return float(
            np.mean(
                [
                    np.linalg.norm(position[p] - m, axis=1).mean()
                    for p, m in zip(parts, middle)
                    if np.ptp(position[p]) < 1e8
                ]
            )
        )

    found = [np.flatnonzero(of_points == leaf) for leaf in range(of_points.max() + 1)]
    assert reach(found) < 1.1 * reach(exact(np.arange(len(position))))


def test_leaves__equal_points_stay_together_in_one_leaf():
    leaves, of_points = grown(clouds()["all equal"])
    assert leaves.n_leaves == 1 and not of_points.any()


def test_leaves__a_cell_is_divided_by_the_order_of_the_file():
    position = clouds()["cloud"]
    grid = grid_of(position[::16], MOST_BITS)
    cell = np.repeat(grid.cells_of(position[:20]), 8 * GROUP // 20)  # 20 cells, of a twentieth each
    leaves = grow_leaves(count_cells(cell), grid, position.min(axis=0), position.max(axis=0), MOST)
    of_points = leaves.of_points(cell, np.zeros(len(leaves.divided), np.int64))
    assert leaves.n_leaves > 1 and len(leaves.divided)
    for divided in leaves.divided:
        portions = leaves.leaf[leaves.cell == divided]
        here = of_points[cell == divided]
        changes = np.flatnonzero(np.diff(here)) + 1
        assert here[[0, *changes]].tolist() == portions.tolist()  # each portion in turn, and none twice
        assert changes.tolist() == leaves.begin[leaves.cell == divided][1:].tolist()


def test_leaves__a_heavy_cell_is_not_divided_and_its_leaf_is_larger():
    rng = np.random.default_rng(1)
    position = np.concatenate([rng.normal(size=(11 * GROUP, 3)), np.full((5 * GROUP, 3), -9.0)])
    position = position[rng.permutation(len(position))]
    leaves, of_points = grown(position, GROUP)
    assert np.diff(leaves.start).max() == 8 * GROUP
    assert len(set(of_points[(position == -9.0).all(axis=1)])) == 1
    assert np.diff(leaves.start).tolist().count(GROUP) == 8


def test_cells__slabs_hold_equal_shares_of_the_sample():
    sample = np.random.default_rng(0).normal(size=(1 << 14, 3)) ** 5
    grid = grid_of(sample, MOST_BITS)
    cell = grid.cells_of(sample)
    for axis in range(3):
        assert set(np.bincount(grid.slab_of(cell, axis)).tolist()) == {16}


def test_cells__a_point_on_an_edge_belongs_above_it():
    sample = np.arange(3072.0).reshape(-1, 3)
    grid = grid_of(sample, MOST_BITS)
    for s in (1, 500, 1023):
        edge = grid.edges[:, s - 1]
        assert [grid.slab_of(grid.cells_of(edge[None]), axis)[0] for axis in range(3)] == [s] * 3
        below = grid.cells_of(np.nextafter(edge, -np.inf)[None])
        assert [grid.slab_of(below, axis)[0] for axis in range(3)] == [s - 1] * 3
