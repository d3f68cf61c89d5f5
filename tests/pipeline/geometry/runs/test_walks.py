"""Runs that cover cells: all of them, few twice, in steps between neighbours; also of graphs that are no grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.geometry.hcp import index_of, key_of, neighbour
from pipeline.geometry.runs.cells import search_size
from pipeline.geometry.runs.gaps import close_gaps
from pipeline.geometry.runs.walks import (
    RUN_LENGTH,
    cut,
    euler_walk,
    neighbours_in_slice,
    runs_of,
    spanning_tree,
)
from tests.pipeline.geometry.runs.test_cells import sphere

HYPOTHESIS = {"deadline": None, "derandomize": True, "database": None, "max_examples": 200}


def graph_of(n: int, edges: set[tuple[int, int]]) -> np.ndarray:
    """A graph (n, 6) of edges, as many as nodes have room for."""
    graph = np.full((n, 6), -1, np.int32)
    degree = np.zeros(n, int)
    for a, b in sorted(edges):
        if a != b and max(degree[a], degree[b]) < 6 and b not in graph[a]:
            graph[a, degree[a]], graph[b, degree[b]] = b, a
            degree[a] += 1
            degree[b] += 1
    return graph


@st.composite
def graphs(draw):
    n = draw(st.integers(1, 60))
    edges = draw(st.sets(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=4 * n))
    return graph_of(n, edges)


@settings(**HYPOTHESIS)
@given(graphs(), st.integers(1, 30), st.integers(0, 5))
def test_walks__cover_any_graph_in_no_more_than_twice_its_nodes(graph, run_length, bridge):
    n = len(graph)
    parent, order = spanning_tree(graph)
    assert sorted(order.tolist()) == list(range(n))
    walk = euler_walk(parent, order)
    assert len(walk) <= 2 * n and set(walk.tolist()) == set(range(n))
    for a, b in zip(walk, walk[1:]):
        assert b in graph[a] or parent[b] < 0
    cells, start = cut(walk, parent, n, run_length, bridge)
    assert set(cells.tolist()) == set(range(n)) and n <= len(cells) <= 2 * n
    length = np.diff(start)
    assert length.min() >= 1 and length.max() <= run_length
    for first, end in zip(start, start[1:]):
        run = cells[first:end]
        assert all(b in graph[a] for a, b in zip(run, run[1:]))
        assert run[0] not in cells[:first] and run[-1] not in cells[:first]


def test_graph__is_that_of_neighbours_within_slices_by_brute_force():
    rng = np.random.default_rng(0)
    keys = np.unique([key_of(int(c), int(r), int(s)) for c, r, s in rng.integers(-6, 6, (900, 3))])
    place = {int(k): i for i, k in enumerate(keys)}
    graph = neighbours_in_slice(keys)
    for i, key in enumerate(keys):
        around = [key_of(*neighbour(*index_of(int(key)), k)) for k in range(6)]
        assert graph[i].tolist() == [place.get(int(k), -1) for k in around]


@pytest.mark.parametrize("most", [1.6, 3.0])
def test_runs__of_a_sphere_cover_every_cell_and_at_most_2_percent_twice(most):
    cells = search_size(sphere(40_000), most)
    runs = runs_of(cells.key)
    seen = np.bincount(runs.cells, minlength=len(cells.key))
    assert seen.min() == 1 and len(runs.cells) <= 1.02 * len(cells.key)
    slices = np.stack(index_of(cells.key[runs.cells]))[2]
    assert all(len(set(slices[a:b])) == 1 for a, b in zip(runs.start, runs.start[1:]))


def test_runs__of_some_slices_are_those_of_all_slices():
    """So slices may be tasks."""
    keys = search_size(sphere(20_000)).key
    whole = runs_of(keys)
    slices = index_of(keys)[2]
    cut_at = np.searchsorted(slices, [slices[0], 0, 5, slices[-1] + 1])
    parts = [runs_of(keys[a:b]) for a, b in zip(cut_at, cut_at[1:])]

    def sets(runs, offset=0):
        return [tuple((runs.cells[a:b] + offset).tolist()) for a, b in zip(runs.start, runs.start[1:])]

    assert sorted(sets(whole)) == sorted(run for part, at in zip(parts, cut_at) for run in sets(part, at))


def test_gaps__closing_keeps_all_cells_makes_runs_longer_and_says_what_it_adds():
    rng = np.random.default_rng(1)
    keys = search_size(sphere(30_000)).key
    keys = keys[rng.uniform(size=len(keys)) < 0.75]
    closed, plain = close_gaps(keys), runs_of(keys)
    assert np.isin(keys, closed.key).all() and np.array_equal(closed.key[~closed.is_added], keys)
    assert closed.runs.mean_length > 1.3 * plain.mean_length and 0 < closed.is_added.mean() < 0.2
    assert set(closed.runs.cells.tolist()) == set(range(len(closed.key)))
    full = close_gaps(np.array([key_of(c, 0, 0) for c in range(4 * RUN_LENGTH)]))
    assert not full.is_added.any() and full.runs.mean_length == RUN_LENGTH
