"""Cells of a slice -> runs that cover them: the 2-approximation of DuoDecim (2006), section 2.3.

    sort cells by slice, row, x; start at cells of degree 1 or less; go to the neighbour with fewest free neighbours; sum subtree
    sizes; Euler walk, largest child last; skip covered cells at starts of runs; bridge at most BRIDGE covered cells, else cut; cut
    at RUN_LENGTH.

A walk goes back through a cell at a dead end, so all 6 steps occur, not the 5 of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.geometry.hcp import index_of, key_of, neighbour

RUN_LENGTH = 25
BRIDGE = 2  # of 1 to 3 the bits of a cell that was given are the same to .1 %; with 3 fountain_p11, gaps closed, has 2.5 % twice, with 2 1.8 %


@dataclass(frozen=True)
class Runs:
    """Runs one behind the other: run r is cells[start[r] : start[r + 1]], by their place among the cells."""

    cells: np.ndarray  # (m,) int32
    start: np.ndarray  # (n_runs + 1,) int64

    @property
    def mean_length(self) -> float:
        return len(self.cells) / (len(self.start) - 1)


@part()
def _find(keys, wanted, at):
    """Place of `wanted` from `at` on where keys ascend, or -1."""
    low, high = at, len(keys)
    while low < high:
        mid = (low + high) // 2
        if keys[mid] < wanted:
            low = mid + 1
        else:
            high = mid
    return low if low < len(keys) and keys[low] == wanted else -1


@kernel()
def neighbours_in_slice(keys):
    """The graph (n, 6) int32 of cells (n,) by ascending keys: place of neighbour k, or -1. Those of other slices are none."""
    n = len(keys)
    graph = np.full((n, 6), -1, np.int32)
    for i in range(n):
        column, row, slice_ = index_of(keys[i])
        for k in range(3):
            there = neighbour(column, row, slice_, k)
            j = _find(keys, key_of(there[0], there[1], there[2]), i + 1)
            if j >= 0:
                graph[i, k] = j
                graph[j, k + 3] = i
    return graph


@kernel()
def spanning_tree(graph):
    """Depth first: parent (n,) of each node, -1 of roots, and the order (n,) in which they were met."""
    n, n_ways = graph.shape
    parent, order = np.full(n, -1, np.int32), np.empty(n, np.int32)
    free = np.zeros(n, np.int32)  # neighbours not yet met
    for i in range(n):
        for k in range(n_ways):
            free[i] += graph[i, k] >= 0
    degree, met, n_met = free.copy(), np.zeros(n, np.bool_), 0
    stack = np.empty(n, np.int32)
    for turn in range(2):
        for root in range(n):
            if met[root] or (turn == 0 and degree[root] > 1):
                continue
            depth, stack[0] = 1, root
            met[root], order[n_met] = True, root
            n_met += 1
            for k in range(n_ways):
                if graph[root, k] >= 0:
                    free[graph[root, k]] -= 1
            while depth:
                at, best, least = stack[depth - 1], -1, n_ways + 1
                for k in range(n_ways):
                    to = graph[at, k]
                    if to >= 0 and not met[to] and free[to] < least:
                        best, least = to, free[to]
                if best < 0:
                    depth -= 1
                    continue
                parent[best], met[best], order[n_met] = at, True, best
                n_met += 1
                for k in range(n_ways):
                    if graph[best, k] >= 0:
                        free[graph[best, k]] -= 1
                stack[depth] = best
                depth += 1
    return parent, order


@kernel()
def euler_walk(parent, order):
    """The long runs: nodes (at most 2 n) in the order of a walk through each tree, its largest branch last and one-way; a root begins one.

    Guarantees: neighbours in the walk are neighbours in the graph, but before a root; every node occurs; no more than 2 n in all.
    """
    n = len(order)
    size = np.ones(n, np.int32)
    for at in range(n - 1, -1, -1):
        node = order[at]
        if parent[node] >= 0:
            size[parent[node]] += size[node]
    # Children by parent in the order in which they were met, as lists of first and next.
    first, following, largest = np.full(n, -1, np.int32), np.full(n, -1, np.int32), np.full(n, -1, np.int32)
    for at in range(n - 1, -1, -1):
        node = order[at]
        above = parent[node]
        if above >= 0:
            following[node], first[above] = first[above], node
            if largest[above] < 0 or size[node] >= size[largest[above]]:
                largest[above] = node
    walk, length = np.empty(2 * n, np.int32), 0
    one_way = np.zeros(n, np.bool_)
    child = first.copy()  # next child of each node to go to
    for at in range(n):
        if parent[order[at]] >= 0:
            continue
        node = order[at]
        one_way[node] = True
        walk[length] = node
        length += 1
        while True:
            to = child[node]
            if to >= 0 and to == largest[node] and one_way[node]:
                child[node] = to = following[to]  # kept for last
            if to >= 0:
                child[node] = following[to]
                node = to
            elif one_way[node] and largest[node] >= 0:
                node = largest[node]
                one_way[node] = True
            elif one_way[node]:
                break
            else:
                node = parent[node]
            walk[length] = node
            length += 1
    return walk[:length]


@kernel()
def cut(walk, parent, n, run_length, bridge):
    """Short runs of a walk: their cells, and where each begins."""
    cells, start = np.empty(2 * n, np.int32), np.empty(n + 1, np.int64)
    covered, n_cells, n_runs = np.zeros(n, np.bool_), 0, 0
    length, waiting = 0, 0  # of the run under way; covered cells gone through since its last
    for at in range(len(walk)):
        node = walk[at]
        if parent[node] < 0 and not covered[node]:
            length = 0  # another tree begins
        if covered[node]:
            waiting += 1
            continue
        if length == 0 or waiting > bridge or length + waiting + 1 > run_length:
            start[n_runs] = n_cells
            n_runs += 1
            length = 0
        else:
            for back in range(waiting, 0, -1):
                cells[n_cells] = walk[at - back]
                n_cells += 1
            length += waiting
        cells[n_cells], covered[node], waiting = node, True, 0
        n_cells += 1
        length += 1
    start[n_runs] = n_cells
    return cells[:n_cells], start[: n_runs + 1]


def runs_of(keys: np.ndarray, run_length: int = RUN_LENGTH, bridge: int = BRIDGE) -> Runs:
    """Runs of at most `run_length` cells that cover all cells (n,), by ascending keys; each run in one slice.

    Guarantees: every cell is in a run; cells side by side in a run are
    neighbours; no more than 2 n in all runs.
    """
    return runs_over(neighbours_in_slice(keys), run_length, bridge)


def runs_over(graph: np.ndarray, run_length: int, bridge: int) -> Runs:
    """`runs_of` cells whose graph (n, 6) is known."""
    parent, order = spanning_tree(graph)
    return Runs(*cut(euler_walk(parent, order), parent, len(graph), run_length, bridge))
