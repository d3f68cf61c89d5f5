"""The inner loop of order-recursive matching pursuit (ORMP), and of a beam search over its candidates.

Dimensions: n patches, k atoms, d texels, t atoms of a support, r ranks, w nodes of the beam, p children tried.

OMP takes the atom of largest |<r, a>|. ORMP takes the one that leaves least once the whole support is fitted again:

    argmax  <r, a>^2 / |a - P a|^2        P: projection onto the span of the support, r: what exact weights leave

With an orthonormal basis q_0 .. q_(t-1) of the support, |a - P a|^2 = 1 - sum_j <q_j, a>^2 and <r, a> = <y, a> - sum_j <y, q_j> <q_j, a>:
a row of products <q_t, a> a step. A node of the beam is a support; its candidates are its atoms of highest score, and a
candidate is valued by the squared residual with the weights that will be stored, the rounding of all of them included.

Papers: Rebollo-Neira and Lowe 2002 (optimised OMP, the same rule); Cotter et al. 1999 (order recursion); Karabulut and
Yongacoglu 2004 (a beam over supports).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.omp_kernels import (
    SMALLEST_CORRELATION,
    SMALLEST_PIVOT,
    append_to_cholesky,
    dot,
    quantize_weights,
    residual_energy,
    solve_cholesky,
)
from pipeline.execution.compiled import FAST, part


class Nodes(NamedTuple):
    """Supports of a patch; of a node b the first t entries are in use, and entry t is for trials."""

    support: np.ndarray  # (w, r) int64: atoms
    straight: np.ndarray  # (w, r) int64: the same without their turns
    turn: np.ndarray  # (w, r) int64
    target: np.ndarray  # (w, r) float64: products of the patch with the atoms
    along: np.ndarray  # (w, r) float64: and with the orthonormal basis
    gram: np.ndarray  # (w, r, r) float64
    chol: np.ndarray  # (w, r, r) float64: its Cholesky factor, reciprocals on the diagonal
    slot: np.ndarray  # (w, r) int64: at which node each vector of the basis was made
    exact: np.ndarray  # (w,) float64: squared residual with exact weights


class Pool(NamedTuple):
    """Children that were tried, in the order of their trial."""

    atom: np.ndarray  # (p,) int64
    parent: np.ndarray  # (p,) int64
    target: np.ndarray  # (p,) float64
    error: np.ndarray  # (p,) float64: squared residual with the weights
    weight: np.ndarray  # (p, r) float64
    code: np.ndarray  # (p, r) int32


class Searched(NamedTuple):
    """What scores of one node's atoms are made of, for a patch scaled to norm 1: so squares in float32 neither overflow nor vanish."""

    initial: np.ndarray  # (k,) float32: products with the patch
    slack: np.ndarray  # (k,) float32: and how far off they may be
    score: np.ndarray  # (k,) float32
    upper: np.ndarray  # (g,) float32: the highest score of each group, see `bound_groups`


@part()
def new_nodes(width, most):
    square = (width, most, most)
    return Nodes(
        np.empty((width, most), np.int64), np.empty((width, most), np.int64), np.empty((width, most), np.int64),
        np.empty((width, most)), np.empty((width, most)), np.empty(square), np.empty(square),
        np.empty((width, most), np.int64), np.empty(width),
    )  # fmt: skip


@part()
def new_pool(width, candidates, most):
    n = width * candidates
    return Pool(
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n),
        np.empty(n),
        np.empty((n, most)),
        np.zeros((n, most), np.int32),
    )


@part(fastmath=FAST)
def explain(row, along, old_explained, old_norm, explained, norm):
    """What a support one atom larger explains of every correlation, and how much of every atom's squared norm lies outside it."""
    x = np.float32(along)
    for i in range(np.uintp(row.shape[0])):
        explained[i] = old_explained[i] + x * row[i]
        norm[i] = old_norm[i] - row[i] * row[i]


@part(fastmath=FAST)
def explain_first(row, along, explained, norm):
    """`explain` of a support of one atom."""
    x = np.float32(along)
    for i in range(np.uintp(row.shape[0])):
        explained[i] = x * row[i]
        norm[i] = np.float32(1) - row[i] * row[i]


@part(fastmath=FAST)
def first_scores(s):
    """Upper bounds of <y, a>^2."""
    n_atoms, width, start = np.uintp(s.score.shape[0]), np.uintp(s.upper.shape[0]), np.uintp(0)
    for g in range(width):
        s.upper[g] = 0
    while start < n_atoms:
        for g in range(min(width, n_atoms - start)):
            size = abs(s.initial[start + g]) + s.slack[start + g]
            s.score[start + g] = size * size
            s.upper[g] = max(s.upper[g], size * size)
        start += width


@part(fastmath=FAST)
def _raw_scores(s, explained, norm):
    n_atoms, width, start = np.uintp(s.score.shape[0]), np.uintp(s.upper.shape[0]), np.uintp(0)
    least = np.float32(SMALLEST_PIVOT)
    for g in range(width):
        s.upper[g] = 0
    while start < n_atoms:
        for g in range(min(width, n_atoms - start)):
            size = abs(s.initial[start + g] - explained[start + g]) + s.slack[start + g]
            value = size * size / max(norm[start + g], least)
            value = value if norm[start + g] > least else np.float32(0)
            s.score[start + g] = value
            s.upper[g] = max(s.upper[g], value)
        start += width


@part()
def scores(s, explained, norm, support, t):
    """Upper bounds of <r, a>^2 / |a - P a|^2; none for atoms in the span of the support."""
    _raw_scores(s, explained, norm)
    for j in range(t):
        _rescore(s, support[j], np.float32(0))


@part()
def _rescore(s, a, value):
    s.score[a] = value
    g, largest = a % s.upper.shape[0], np.float32(0)
    for b in range(g, s.score.shape[0], s.upper.shape[0]):
        largest = max(largest, s.score[b])
    s.upper[g] = largest


@part()
def _take_best(s, patch, dictionary, unit, explained, norm, t):
    """The atom of highest score, which then has none, and that score; -1 where correlations are all rounding.

    Bounds are settled on the way: the atom whose bound is highest is made exact, until the highest is exact itself. Of
    equals the first of the first group.
    """
    while True:
        top, largest = 0, np.float32(0)
        for g in range(s.upper.shape[0]):
            if s.upper[g] > largest:
                top, largest = g, s.upper[g]
        if largest <= SMALLEST_CORRELATION**2:
            return -1, 0.0
        best = top
        while s.score[best] < largest:
            best += s.upper.shape[0]
        settled = s.slack[best] == 0
        if not settled:
            s.initial[best] = np.float32(unit * dot(patch, dictionary[best]))
            s.slack[best] = 0
        left, outside = s.initial[best], np.float32(1)
        if t > 0:
            left, outside = left - explained[best], norm[best]
        _rescore(s, best, np.float32(0) if settled else left * left / outside)
        if settled and left * left > SMALLEST_CORRELATION**2:
            return best, np.float64(largest)


@part()
def _append(nodes, b, t, atom, target, dictionary, gram, turns):
    """Let an atom, whose product with the patch is `target`, be atom t of node b. Returns the squared pivot."""
    n_straight = max(gram.shape[0], 1)
    nodes.support[b, t], nodes.target[b, t] = atom, target
    nodes.straight[b, t], nodes.turn[b, t] = atom % n_straight, atom // n_straight
    for j in range(t + 1):
        if gram.shape[0] > 0:
            at = turns[nodes.turn[b, t], nodes.turn[b, j]] * n_straight + nodes.straight[b, j]
            product = np.float64(gram[nodes.straight[b, t], at])
        else:
            product = dot(dictionary[atom], dictionary[nodes.support[b, j]])
        nodes.gram[b, t, j] = product
        nodes.gram[b, j, t] = product
    return append_to_cholesky(nodes.chol[b], nodes.gram[b], t)


@part()
def try_candidates(
    nodes,
    b,
    t,
    s,
    n_wanted,
    enough,
    energy,
    patch,
    dictionary,
    unit,
    gram,
    turns,
    explained,
    norm,
    levels,
    pool,
    n_found,
):
    """Try the atoms of highest score of node b, whose scores are in `s`; those that leave less than `enough` come into the pool.
    Returns how many are in it."""
    tried = 0
    while tried < n_wanted:
        best, gain = _take_best(s, patch, dictionary, unit, explained, norm, t)
        if best < 0 or nodes.exact[b] - energy * gain >= enough:  # no weights leave less than exact ones
            break
        target = np.float64(s.initial[best]) / unit
        if _append(nodes, b, t, best, target, dictionary, gram, turns) <= SMALLEST_PIVOT:
            continue
        weight, code = pool.weight[n_found], pool.code[n_found]
        solve_cholesky(nodes.chol[b], nodes.target[b], nodes.along[b], weight, t + 1)
        if levels.shape[1] > 0:
            quantize_weights(levels, nodes.target[b], nodes.gram[b], weight, code, t + 1)
            error = residual_energy(energy, nodes.target[b], nodes.gram[b], weight, t + 1)
        else:
            error = max(nodes.exact[b] - nodes.along[b, t] ** 2, 0.0)
        tried += 1
        if error < enough:
            pool.atom[n_found], pool.parent[n_found], pool.target[n_found], pool.error[n_found] = best, b, target, error
            n_found += 1
    return n_found


@part()
def _copy_node(source, b, to, c, t):
    for j in range(t):
        to.support[c, j], to.straight[c, j], to.turn[c, j] = (
            source.support[b, j],
            source.straight[b, j],
            source.turn[b, j],
        )
        to.target[c, j], to.along[c, j], to.slot[c, j] = source.target[b, j], source.along[b, j], source.slot[b, j]
        for i in range(t):
            to.gram[c, j, i], to.chol[c, j, i] = source.gram[b, j, i], source.chol[b, j, i]


@part()
def _is_known(nodes, n, t):
    """Whether node n has the support, as a set, of one before it."""
    for c in range(n):
        n_same = 0
        for i in range(t):
            for j in range(t):
                n_same += nodes.support[n, i] == nodes.support[c, j]
        if n_same == t:
            return True
    return False


@part()
def _least(values, n):
    """The first of the least of n values; -1 where all are infinite."""
    least, at = np.inf, -1
    for m in range(n):
        if values[m] < least:
            least, at = values[m], m
    return at


@part()
def keep_best(nodes, t, pool, n_found, n_wanted, dictionary, gram, turns, children, atom, weight, code):
    """Make nodes of the children that leave least, `n_wanted` of them, none twice in another order; the codes are those of
    the first. Returns how many there are and what the first leaves."""
    n_kept, error = 0, np.inf
    while n_kept < n_wanted:
        first = _least(pool.error, n_found)
        if first < 0:
            break
        parent, left = pool.parent[first], pool.error[first]
        pool.error[first] = np.inf
        _copy_node(nodes, parent, children, n_kept, t)
        _append(children, n_kept, t, pool.atom[first], pool.target[first], dictionary, gram, turns)
        if _is_known(children, n_kept, t + 1):
            continue
        along = children.target[n_kept, t]
        for j in range(t):
            along -= children.chol[n_kept, t, j] * children.along[n_kept, j]
        along *= children.chol[n_kept, t, t]
        children.along[n_kept, t], children.slot[n_kept, t] = along, parent
        children.exact[n_kept] = max(nodes.exact[parent] - along * along, 0.0)
        if n_kept == 0:
            error = left
            for j in range(t + 1):
                atom[j], weight[j], code[j] = children.support[0, j], pool.weight[first, j], pool.code[first, j]
        n_kept += 1
    return n_kept, error
