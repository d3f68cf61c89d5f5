"""Order-recursive pursuit with a beam, by a Gram matrix: a kernel a patch, as `omp_kernels.pursue`."""

from __future__ import annotations

import numpy as np

from pipeline.coding.beam.nodes import TIE, Nodes, Pool, Products, keep_best, new_pool, try_children
from pipeline.coding.beam.scores import Scores, score_beside, score_first
from pipeline.coding.omp_kernels import TRUSTED, n_groups
from pipeline.execution.compiled import FAST, borrowed, kernel, part


def _new_nodes(width: int, most: int) -> Nodes:
    ranks, square = (width, most), (width, most, most)
    return Nodes(
        np.empty(ranks, np.int64), np.empty(ranks), np.empty(ranks),
        np.empty(square), np.empty(square), np.empty(ranks, np.int64), np.empty(width),
    )  # fmt: skip


@part()
def _borrowed_nodes(n):
    return Nodes(
        borrowed(n.support), borrowed(n.target), borrowed(n.along), borrowed(n.gram), borrowed(n.chol), borrowed(n.slot), borrowed(n.exact),
    )  # fmt: skip


@part()
def _borrowed_pool(p):
    return Pool(
        borrowed(p.atom), borrowed(p.parent), borrowed(p.target), borrowed(p.error), borrowed(p.weight), borrowed(p.code), borrowed(p.tried),
    )  # fmt: skip


@part(fastmath=FAST)
def _gram_row(row, gram, quotients, atom, scale):
    """row = scale <a, b> of all atoms b, of which `gram` has those of the straight ones."""
    k, n_turns, x = np.uintp(gram.shape[0]), quotients.shape[0], np.float32(scale)
    a, turn = np.uintp(atom % gram.shape[0]), atom // gram.shape[0]
    for s in range(n_turns):
        at, at_a = np.uintp(s) * k, np.uintp(quotients[turn, s]) * k
        for i in range(k):
            row[at + i] = x * gram[a, at_a + i]


@part(fastmath=FAST)
def _subtract_earlier(row, chol, rows, slot, t):
    """row -= chol[t, j] / pivot * (row of <q_j, a>), of all j < t; rows (r, w, k), that of q_j at node slot[j] of its
    step."""
    width, j, scale = np.uintp(row.shape[0]), 0, chol[t, t]
    while j + 2 <= t:
        x, y = np.float32(scale * chol[t, j]), np.float32(scale * chol[t, j + 1])
        first, second = rows[j, slot[j]], rows[j + 1, slot[j + 1]]
        for i in range(width):
            row[i] -= x * first[i] + y * second[i]
        j += 2
    if j < t:
        x, first = np.float32(scale * chol[t, j]), rows[j, slot[j]]
        for i in range(width):
            row[i] -= x * first[i]


def pursue_beam(
    patches, dictionary, initial, spread, rest, certify, energy, gram, quotients, tolerance, multiplier, levels, width, candidates,
    atom, weight, code, n_atoms, path,
):  # fmt: skip
    """As `omp_kernels.pursue`, by order-recursive selection with a beam; `initial` is overwritten.

    Of each of up to `width` supports the `candidates` atoms of highest score (of the empty one `width`, if those are
    more) are tried. Of all supports so made that lower the residual by more than `multiplier`, the `width` that leave
    least are kept. path (n, r + 1): what the best of t atoms leaves, t = 0, 1, and so on; the codes are the best of the
    last step.
    """
    k, most = initial.shape[1], atom.shape[1]
    scratch = (
        np.zeros(k, np.float32), np.empty(k, np.float32), np.empty(n_groups(k), np.float32), np.empty((most - 1, width, k), np.float32),
        np.empty((2, width, k), np.float32), np.empty((2, width, k), np.float32),
    )  # fmt: skip
    _pursue(
        patches, dictionary, initial, spread, rest, certify, energy, gram, quotients, tolerance, multiplier, levels, width, candidates,
        atom, weight, code, n_atoms, path, _new_nodes(width, most), _new_nodes(width, most), new_pool(width, candidates, most), scratch,
    )  # fmt: skip


@kernel()
def _pursue(
    patches, dictionary, initial, spread, rest, certify, energy, gram, quotients, tolerance, multiplier, levels, width, candidates,
    atom, weight, code, n_atoms, path, nodes_now, nodes_next, made_pool, scratch,
):  # fmt: skip
    n, k = initial.shape
    most = atom.shape[1]
    patches, dictionary, initial, gram, quotients, levels = (
        borrowed(patches), borrowed(dictionary), borrowed(initial), borrowed(gram), borrowed(quotients), borrowed(levels),
    )  # fmt: skip
    atom, weight, code, path, rest = borrowed(atom), borrowed(weight), borrowed(code), borrowed(path), borrowed(rest)
    slack, score, upper, rows = borrowed(scratch[0]), borrowed(scratch[1]), borrowed(scratch[2]), borrowed(scratch[3])
    explained, norm = borrowed(scratch[4]), borrowed(scratch[5])
    nodes, children, pool = _borrowed_nodes(nodes_now), _borrowed_nodes(nodes_next), _borrowed_pool(made_pool)
    products = Products(dictionary, gram, quotients)
    for i in range(n):
        unit = 1.0 / np.sqrt(energy[i])
        for a in range(k):
            initial[i, a] = np.float32(unit * initial[i, a])
        if spread[i] > 0:
            trust = np.float32(unit * spread[i]) * (np.float32(1) if certify else TRUSTED)
            for a in range(k):
                slack[a] = trust * rest[a]
        s = Scores(initial[i], slack, score, upper)
        t, n_nodes = 0, 1
        path[i, 0] = nodes.exact[0] = energy[i]
        while t < most and path[i, t] > max(tolerance[i], multiplier):
            now, n_found = t % 2, 0
            for b in range(n_nodes):
                if t == 0:
                    score_first(s)
                else:
                    last, parent, chol = t - 1, nodes.slot[b, t - 1], nodes.chol[b]
                    row, along = rows[last, b], unit * nodes.along[b, last]
                    _gram_row(row, gram, quotients, nodes.support[b, last], chol[last, last])
                    if t > 1:
                        _subtract_earlier(row, chol, rows, nodes.slot[b], last)
                    parents = (explained[1 - now, parent], norm[1 - now, parent])
                    score_beside(s, row, along, parents, explained[now, b], norm[now, b], nodes.support[b], t)
                    nodes.slot[b, last] = b
                n_found = try_children(
                    nodes, b, t, s, explained[now, b], norm[now, b], candidates if t else max(candidates, width),
                    path[i, t] - multiplier, patches[i], energy[i], unit, products, levels, pool, n_found,
                )  # fmt: skip
            n_wanted = width if t + 1 < most else 1
            n_nodes, error = keep_best(
                nodes, t, pool, n_found, n_wanted, TIE * energy[i], products, children, atom[i], weight[i], code[i]
            )
            if n_nodes == 0:
                break
            t += 1
            path[i, t] = error
            nodes, children = children, nodes
        n_atoms[i] = t
