"""Order-recursive pursuit with a beam (see `beam_kernels`): with a Gram matrix patch by patch, without one step by step."""

from __future__ import annotations

import numpy as np

from pipeline.coding.beam_kernels import (
    Nodes,
    Searched,
    explain,
    explain_first,
    first_scores,
    keep_best,
    new_nodes,
    new_pool,
    scores,
    try_candidates,
)
from pipeline.coding.certified import ShortDictionary
from pipeline.coding.omp_kernels import NO_TURNS, TRUSTED, n_groups
from pipeline.execution.compiled import FAST, kernel, part

NO_GRAM = np.empty((0, 0), np.float32)
MOST_BYTES = 64 << 20  # of products and what is kept of them, where there is no Gram matrix


@part(fastmath=FAST)
def _row_of_basis(row, gram, turns, straight, turn, chol, before, slot, t):
    """row = <q_t, a> of all atoms a: the Gram row of the support's atom t less its shares of q_0 .. q_(t-1), over its norm.

    before (r, w, k): rows of earlier atoms, slot (r,): which of them are this support's.
    """
    k, n_turns, scale = np.uintp(gram.shape[0]), turns.shape[0], np.float32(chol[t, t])
    a = np.uintp(straight[t])
    for s in range(n_turns):
        at, at_a = np.uintp(s) * k, np.uintp(turns[turn[t], s]) * k
        for i in range(k):
            row[at + i] = scale * gram[a, at_a + i]
    _subtract_shares(row, chol, before, slot, t)


@part(fastmath=FAST)
def _subtract_shares(row, chol, before, slot, t):
    width, j, scale = np.uintp(row.shape[0]), 0, chol[t, t]
    while j + 2 <= t:
        x, y = np.float32(scale * chol[t, j]), np.float32(scale * chol[t, j + 1])
        first, second = before[j, slot[j]], before[j + 1, slot[j + 1]]
        for i in range(width):
            row[i] -= x * first[i] + y * second[i]
        j += 2
    if j < t:
        x, first = np.float32(scale * chol[t, j]), before[j, slot[j]]
        for i in range(width):
            row[i] -= x * first[i]


@part()
def _explained_by(row, unit, nodes, b, t, explained, norm, now):
    """`explain` of node b, of what its parent of the step before explained."""
    along, parent = unit * nodes.along[b, t - 1], nodes.slot[b, t - 1]
    if t == 1:
        explain_first(row, along, explained[now, b], norm[now, b])
    else:
        explain(row, along, explained[1 - now, parent], norm[1 - now, parent], explained[now, b], norm[now, b])
    nodes.slot[b, t - 1] = b


@kernel()
def pursue_beam(patches, dictionary, initial, spread, rest, certify, energy, gram, turns, tolerance, price, levels, width, candidates,
                atom, weight, code, n_atoms, path):  # fmt: skip
    """As `omp_kernels.pursue`, by order-recursive selection with a beam; `initial` is overwritten.

    Of each of up to `width` supports the `candidates` atoms of highest score (of the empty one `width`, if those are more) are
    tried. Of all supports so made that lower the residual by more than `price`, the `width` that leave least are kept. path
    (n, r + 1): what the best of t atoms leaves, t = 0, 1, and so on; the codes are the best of the last step.
    """
    n, k = initial.shape
    most = atom.shape[1]
    slack, score, upper = np.zeros(k, np.float32), np.empty(k, np.float32), np.empty(n_groups(k), np.float32)
    nodes, children, pool = new_nodes(width, most), new_nodes(width, most), new_pool(width, candidates, most)
    row = np.empty((most - 1, width, k), np.float32)
    explained, norm = np.empty((2, width, k), np.float32), np.empty((2, width, k), np.float32)
    for i in range(n):
        unit = 1.0 / np.sqrt(energy[i])
        for a in range(k):
            initial[i, a] = np.float32(unit * initial[i, a])
        if spread[i] > 0:
            trust = np.float32(unit * spread[i]) * (np.float32(1) if certify else TRUSTED)
            for a in range(k):
                slack[a] = trust * rest[a]
        s = Searched(initial[i], slack, score, upper)
        t, n_nodes = 0, 1
        path[i, 0] = nodes.exact[0] = energy[i]
        while t < most and path[i, t] > tolerance[i]:
            now, n_found = t % 2, 0
            for b in range(n_nodes):
                if t == 0:
                    first_scores(s)
                else:
                    new = row[t - 1, b]
                    _row_of_basis(
                        new, gram, turns, nodes.straight[b], nodes.turn[b], nodes.chol[b], row, nodes.slot[b], t - 1
                    )
                    _explained_by(new, unit, nodes, b, t, explained, norm, now)
                    scores(s, explained[now, b], norm[now, b], nodes.support[b], t)
                n_found = try_candidates(
                    nodes, b, t, s, candidates if t else max(candidates, width), path[i, t] - price, energy[i], patches[i], dictionary,
                    unit, gram, turns, explained[now, b], norm[now, b], levels, pool, n_found)  # fmt: skip
            n_nodes, error = keep_best(nodes, t, pool, n_found, width if t + 1 < most else 1, dictionary, gram, turns, children,
                                       atom[i], weight[i], code[i])  # fmt: skip
            if n_nodes == 0:
                break
            t += 1
            path[i, t] = error
            nodes, children = children, nodes
        n_atoms[i] = t
