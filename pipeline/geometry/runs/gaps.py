"""Gaps of one cell between runs, closed where that makes short runs longer: DuoDecim (2006), section 2.4.

Of each run shorter than half a full one the cells two steps away are looked at; where one belongs to another part of the slice that
nothing joins yet, the cell between is filled. That adds cells in which no point lies, and so splats: they are counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.geometry.hcp import index_of, key_of, neighbour
from pipeline.geometry.runs.walks import BRIDGE, RUN_LENGTH, Runs, _find, neighbours_in_slice, runs_over

ENOUGH = 0.7  # of the full length, from which mean on nothing is closed
ROUNDS = 4
FEW = 0.002  # of all cells: where a round adds no more it is the last


@dataclass(frozen=True)
class Closed:
    """Cells with those that close gaps, and their runs."""

    key: np.ndarray  # (n,) int64, ascending
    is_added: np.ndarray  # (n,) bool
    runs: Runs


@part()
def _root(of, i):
    while of[i] != i:
        of[i] = of[of[i]]
        i = of[i]
    return i


@kernel()
def _closing(keys, graph, cells, start, most):
    """Keys of cells that join parts, found from runs of `most` cells or fewer; perhaps some twice."""
    n = len(keys)
    of = np.arange(n)
    for i in range(n):
        for k in range(3):
            if graph[i, k] >= 0:
                of[_root(of, i)] = _root(of, graph[i, k])
    found, n_found = np.empty(n, np.int64), 0
    for r in range(len(start) - 1):
        if start[r + 1] - start[r] > most:
            continue
        for at in range(start[r], start[r + 1]):
            i = cells[at]
            column, row, slice_ = index_of(keys[i])
            for k in range(6):
                if graph[i, k] >= 0:
                    continue
                between = neighbour(column, row, slice_, k)
                for turn in range(-1, 2):
                    beyond = neighbour(between[0], between[1], between[2], (k + turn) % 6)
                    j = _find(keys, key_of(beyond[0], beyond[1], beyond[2]), 0)
                    if j >= 0 and _root(of, i) != _root(of, j) and n_found < n:
                        of[_root(of, i)] = _root(of, j)
                        found[n_found] = key_of(between[0], between[1], between[2])
                        n_found += 1
    return found[:n_found]


def close_gaps(keys: np.ndarray, run_length: int = RUN_LENGTH, bridge: int = BRIDGE, enough: float = ENOUGH) -> Closed:
    """Runs of the cells (n,), with gaps closed until runs are `enough` of the full length on average, or nothing is left to close.

    Guarantees: all given cells are there; runs are no shorter on average than without; deterministic, slice by slice.
    """
    graph = neighbours_in_slice(keys)
    plain = runs_over(graph, run_length, bridge)
    best = Closed(keys, np.zeros(len(keys), bool), plain)
    now, runs, n_added = keys, plain, len(keys)
    for _ in range(ROUNDS):
        if runs.mean_length >= enough * run_length or n_added <= FEW * len(now):
            break
        added = np.unique(_closing(now, graph, runs.cells, runs.start, run_length // 2))
        n_added = len(added)
        if not n_added:
            break
        now = np.insert(now, np.searchsorted(now, added), added)
        graph = neighbours_in_slice(now)
        runs = runs_over(graph, run_length, bridge)
        if runs.mean_length > best.runs.mean_length:
            best = Closed(now, ~np.isin(now, keys, assume_unique=True), runs)
    return best
