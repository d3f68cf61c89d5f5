"""Order-recursive pursuit with a beam, without a Gram matrix: all patches of a block take their first atom, then their
second.

Beyond 16,384 atoms a Gram matrix is too large. Then the vectors q_t of all nodes are made, as rows of d texels, and one
GEMM a step has their products with all atoms; nothing of the size k x k is made, and the same `MOST_BYTES` hold
whatever k is.
"""

from __future__ import annotations

import numpy as np

from pipeline.coding.beam.nodes import Nodes, Products, make_nodes, new_pool, store_best, try_children
from pipeline.coding.beam.scores import Scores, Tiles, score_beside, score_first
from pipeline.coding.beam.weights import prepare_levels, searched_levels
from pipeline.coding.omp_kernels import ONLY_IDENTITY, n_groups
from pipeline.execution.compiled import FAST, kernel, part

NO_GRAM = np.empty((0, 0), np.float32)
MOST_BYTES = 64 << 20  # of products with atoms and what is kept of them


def rows_at_a_time(n_dictionary: int, width: int) -> int:
    """Patches of a block: 1 row of k products a patch, and 5 a node."""
    return max(1, min(512, MOST_BYTES // (4 * n_dictionary * (1 + 5 * width))))


def pursue_beam_rows(
    rows,
    energy,
    dictionary,
    products,
    tolerance,
    multiplier,
    levels,
    width,
    candidates,
    atom,
    weight,
    code,
    n_atoms,
    path,
):
    """`by_gram.pursue_beam` for a block of patches (n, d), in place, by `products(rows)`: (m, k) float32 of rows (m, d)
    with all atoms of `dictionary`."""
    n, most = atom.shape
    k, d = dictionary.shape
    n_atoms[:], path[:, 0] = 0, energy
    initial = products(rows)
    explained, norm = np.empty((2, n, width, k), np.float32), np.empty((2, n, width, k), np.float32)
    basis, row = np.zeros((max(1, most - 1), n, width, d), np.float32), initial
    nodes = _nodes_of_two_steps(n, width, most)
    nodes.exact[0, :, 0] = energy
    n_nodes, tiles = (energy > tolerance).astype(np.int64), Tiles.of(k, 1, n_groups(k))
    for t in range(most):
        if t > 0:
            _next_of_basis(dictionary, nodes, t - 1, n_nodes, basis)
            row = products(basis[t - 1][np.arange(width) < n_nodes[:, None]])
        _advance(
            rows, energy, Products(dictionary, NO_GRAM, ONLY_IDENTITY), initial, row, tolerance, multiplier, searched_levels(levels), t,
            candidates, nodes, n_nodes, explained, norm, atom, weight, code, n_atoms, path, tiles,
        )  # fmt: skip
        if not n_nodes.any():
            break


def _nodes_of_two_steps(n: int, width: int, most: int) -> Nodes:
    """Nodes of n patches, now and a step before: every array has two dimensions (2, n) more."""
    ranks, square = (2, n, width, most), (2, n, width, most, most)
    return Nodes(
        np.zeros(ranks, np.int64), np.zeros(ranks), np.zeros(ranks), np.zeros(square), np.zeros(square),
        np.zeros(ranks, np.int64), np.zeros(ranks, np.int64), np.zeros(ranks, np.int32), np.zeros(ranks[:3]),
        np.zeros(ranks[:3], np.uint64),
    )  # fmt: skip


@part()
def _look(beside, a):
    explained, norm = beside
    return explained[a], norm[a]


@part()
def _nodes_of(all_nodes, step, i):
    n = all_nodes
    return Nodes(
        n.support[step, i], n.target[step, i], n.along[step, i],
        n.gram[step, i], n.chol[step, i], n.slot[step, i],
        n.rank[step, i], n.code[step, i], n.exact[step, i], n.key[step, i],
    )  # fmt: skip


@part(fastmath=FAST)
def _add_row(row, x, other):
    for i in range(np.uintp(row.shape[0])):
        row[i] += np.float32(x) * other[i]


@kernel()
def _next_of_basis(dictionary, all_nodes, t, n_nodes, basis):
    """basis[t] (n, w, d): the last vector of each node's orthonormal basis, of a support of t + 1 atoms."""
    for i in range(n_nodes.shape[0]):
        nodes = _nodes_of(all_nodes, (t + 1) % 2, i)
        for b in range(n_nodes[i]):
            row, chol, scale = basis[t, i, b], nodes.chol[b], nodes.chol[b, t, t]
            row[:] = 0
            _add_row(row, scale, dictionary[nodes.support[b, t]])
            for j in range(t):
                _add_row(row, -scale * chol[t, j], basis[j, i, nodes.slot[b, j]])


@kernel()
def _advance(
    patches, energy, products, initial, row, tolerance, multiplier, levels, t, candidates, all_nodes, n_nodes, explained, norm,
    atom, weight, code, n_atoms, path, tiles,
):  # fmt: skip
    """One step of every patch that has nodes; those that are done have none after it. row (m, k): products of the last
    vector of each node's basis with all atoms, patch by patch."""
    n, k = initial.shape
    width, most, now = explained.shape[2], atom.shape[1], t % 2
    slack, score, upper = np.zeros(k, np.float32), np.empty(k, np.float32), np.empty(n_groups(k), np.float32)
    prepare_levels(levels)
    pool, at = new_pool(width, candidates, most), -1
    for i in range(n):
        if n_nodes[i] == 0:
            continue
        nodes, children = _nodes_of(all_nodes, now, i), _nodes_of(all_nodes, 1 - now, i)
        unit, n_kept, n_wanted = 1.0 / np.sqrt(energy[i]), 0, width if t + 1 < most else 1
        if t == 0:
            for a in range(k):
                initial[i, a] = np.float32(unit * initial[i, a])
        s = Scores(initial[i], slack, np.uintp(1), score, upper, upper.view(np.int32), tiles)
        for b in range(n_nodes[i]):
            at += 1
            if t == 0:
                score_first(s)
            else:
                parent, along = nodes.slot[b, t - 1], unit * nodes.along[b, t - 1]
                parents = (explained[1 - now, i, parent], norm[1 - now, i, parent])
                score_beside(s, row[at], along, parents, explained[now, i, b], norm[now, i, b], t)
                nodes.slot[b, t - 1] = b
            n_kept = try_children(
                nodes, b, t, s, (explained[now, i, b], norm[now, i, b]), _look, candidates if t else max(candidates, width),
                path[i, t] - multiplier, patches[i], energy[i], unit, products, levels, pool, n_kept, n_wanted,
            )  # fmt: skip
        n_nodes[i] = n_kept
        if n_nodes[i] > 0:
            store_best(nodes, t, pool, atom[i], weight[i], code[i])
            n_nodes[i] = make_nodes(nodes, t, pool, n_kept, multiplier, children)
            n_atoms[i], path[i, t + 1] = t + 1, pool.error[pool.order[0]]
            if t + 1 == most or path[i, t + 1] <= max(tolerance[i], multiplier):
                n_nodes[i] = 0
