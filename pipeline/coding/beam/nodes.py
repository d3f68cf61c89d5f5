"""A beam over supports. Dimensions: w nodes, r ranks, t atoms of a support, p children kept.

A node is a support; its children are the support with one of the atoms of highest score (see `scores`). A child is
valued by the squared residual with the weights that will be stored, so with the rounding of all of them.

Papers: Karabulut and Yongacoglu 2004 (a beam over supports); HPG 2021, section 3.4 (quantised weights in the loop).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.beam.scores import take_best
from pipeline.coding.beam.weights import settle_weights
from pipeline.coding.omp_kernels import SMALLEST_PIVOT, append_to_cholesky, dot, solve_cholesky
from pipeline.execution.compiled import part

# Share of a patch's squared norm within which two residuals count as one: a support that is found in two orders leaves
# the same but for rounding, which must not choose.
TIE = 1e-6
# Of what the best support's last atom mended of it with exact weights, the share that another's next atom is taken to
# mend: a support that would not end below the best then is not followed. Of `fountain_p11` and `monstree` 4x2 takes 19
# and 14 % less time and 0.01 and 0.02 dB less; at 0.3, 22 and 21 %, 0.04 and 0.05 dB; at 0.5, 12 and 10 %, 0.00 and 0.01.
HOPE = 0.4


class Nodes(NamedTuple):
    """Supports of a patch; of a node the first t entries are in use, and entry t is for trials."""

    support: np.ndarray  # (w, r) int64: atoms
    target: np.ndarray  # (w, r) float64: products of the patch with the atoms
    along: np.ndarray  # (w, r) float64: and with the orthonormal basis
    gram: np.ndarray  # (w, r, r) float64
    chol: np.ndarray  # (w, r, r) float64: its Cholesky factor, reciprocals on the diagonal
    slot: np.ndarray  # (w, r) int64: at which node of its step each vector of the basis was made
    rank: np.ndarray  # (w, r) int64: of which levels each atom's weight is one
    code: np.ndarray  # (w, r) int32: which of them it is
    exact: np.ndarray  # (w,) float64: squared residual with exact weights
    key: np.ndarray  # (w,) uint64: one number for the support as a set


class Pool(NamedTuple):
    """The children that leave least, in any order; a further row is for trials."""

    order: np.ndarray  # (p + 1,) int64: rows, that which leaves least first; the row for trials after the last
    parent: np.ndarray  # (p + 1,) int64
    atom: np.ndarray  # (p + 1,) int64
    key: np.ndarray  # (p + 1,) uint64
    target: np.ndarray  # (p + 1,) float64
    along: np.ndarray  # (p + 1,) float64
    exact: np.ndarray  # (p + 1,) float64
    error: np.ndarray  # (p + 1,) float64: squared residual with the weights
    gram: np.ndarray  # (p + 1, r) float64: the child's last row
    chol: np.ndarray  # (p + 1, r) float64
    weight: np.ndarray  # (p + 1, r) float64
    rank: np.ndarray  # (p + 1, r) int64
    code: np.ndarray  # (p + 1, r) int32
    left: np.ndarray  # (r,) float64: see `settle_weights`
    tried: np.ndarray  # (c,) int64: atoms that the node at hand was tried with


class Products(NamedTuple):
    """Where products of two atoms come from: a Gram matrix, or the atoms themselves where `gram` is empty."""

    dictionary: np.ndarray  # (k, d) float32
    gram: np.ndarray  # (k / m, k) float32
    quotients: np.ndarray  # (m, m) int64, see `omp_kernels.pursue`


@part()
def new_pool(width, candidates, most):
    """An empty pool for `width` nodes of at most `most` atoms, with `candidates` each."""
    n = width + 1
    return Pool(
        np.arange(n), np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.uint64), np.empty(n), np.empty(n), np.empty(n), np.empty(n),
        np.empty((n, most)), np.empty((n, most)), np.empty((n, most)), np.zeros((n, most), np.int64), np.zeros((n, most), np.int32),
        np.empty(most), np.empty(max(width, candidates), np.int64),
    )  # fmt: skip


@part()
def _product(products, a, b):
    """<a, b> of two atoms."""
    gram = products.gram
    if gram.shape[0] == 0:
        return dot(products.dictionary[a], products.dictionary[b])
    n = gram.shape[0]
    return np.float64(gram[a % n, products.quotients[a // n, b // n] * n + b % n])


@part()
def _key_of(atom):
    """A number of 64 bits for an atom, the sum of which tells supports apart as sets (the mixer of SplitMix64)."""
    x = np.uint64(atom + 1) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@part()
def _is_coherent(products, atom, others, n):
    """Whether an atom is, but for its sign and as far as pivots tell, one of n others."""
    for j in range(n):
        if 1 - _product(products, others[j], atom) ** 2 <= SMALLEST_PIVOT:
            return True
    return False


@part()
def _append(nodes, b, t, atom, target, products):
    """Let an atom, whose product with the patch is `target`, be atom t of node b. Returns the squared pivot."""
    nodes.support[b, t], nodes.target[b, t] = atom, target
    for j in range(t + 1):
        product = _product(products, nodes.support[b, j], atom)
        nodes.gram[b, t, j] = product
        nodes.gram[b, j, t] = product
    return append_to_cholesky(nodes.chol[b], nodes.gram[b], t)


@part()
def try_children(
    nodes, b, t, s, beside, look, n_wanted, enough, patch, energy, unit, products, levels, pool, n_kept, most
):
    """Try node b with the atoms of highest score, by `beside` and `look` of `take_best`. Of children that leave less
    than `enough`, the `most` that leave least stay in the pool, none twice in another order; it has `n_kept` before and
    the number returned after."""
    n_tried, tie = 0, TIE * energy
    while n_tried < n_wanted:
        best, gain = take_best(s, patch, products.dictionary, unit, beside, look, t)
        most_left = min(enough, pool.error[pool.order[most - 1]]) if n_kept == most else enough
        if best < 0 or nodes.exact[b] - energy * gain >= most_left:  # no weights leave less than exact ones
            break
        if _is_coherent(
            products, best, pool.tried, n_tried
        ):  # its child would be the coherent atom's; symmetric atoms have such quotients
            continue
        target = np.float64(s.initial[best]) / unit
        if _append(nodes, b, t, best, target, products) <= SMALLEST_PIVOT:
            continue
        pool.tried[n_tried] = best
        n_tried += 1
        at = pool.order[n_kept]
        weight, rank, code = pool.weight[at], pool.rank[at], pool.code[at]
        solve_cholesky(nodes.chol[b], nodes.target[b], nodes.along[b], weight, t + 1)
        error = exact = max(nodes.exact[b] - nodes.along[b, t] ** 2, 0.0)
        for j in range(t):
            rank[j], code[j] = nodes.rank[b, j], nodes.code[b, j]
        rank[t], code[t] = t, 0
        if levels.value.shape[1] > 0:
            error = settle_weights(levels, energy, nodes.target[b], nodes.gram[b], rank, pool.left, weight, code, t + 1)
        if error < most_left:
            pool.parent[at], pool.atom[at], pool.target[at], pool.along[at] = b, best, target, nodes.along[b, t]
            pool.exact[at], pool.error[at], pool.key[at] = exact, error, nodes.key[b] + _key_of(best)
            for j in range(t + 1):
                pool.gram[at, j], pool.chol[at, j] = nodes.gram[b, t, j], nodes.chol[b, t, j]
            n_kept = _keep(pool, at, n_kept, most, tie)
    return n_kept


@part()
def _keep(pool, at, n_kept, most, tie):
    """Put the trial in row `at` into its place. Of children within `tie` of each other the one tried first counts as
    the better. Returns how many are kept then."""
    order, last, error = pool.order, n_kept, pool.error[at]
    place = n_kept
    while place > 0 and error < pool.error[order[place - 1]] - tie:
        place -= 1
    for m in range(n_kept):
        if pool.key[order[m]] == pool.key[at]:
            if m < place:
                return n_kept
            last = m
    if last < n_kept:  # the same support in another order, which is the worse
        spare, order[n_kept] = order[n_kept], order[last]
    else:
        spare = order[n_kept]
    for m in range(last, place, -1):
        order[m] = order[m - 1]
    order[place] = spare
    return n_kept if last < n_kept else min(n_kept + 1, most)


@part()
def make_nodes(nodes, t, pool, n_kept, multiplier, children):
    """Make nodes, of t + 1 atoms, of the children in the pool, that which leaves least first, but for those that will
    hardly be the best. Returns how many."""
    best, n_made = pool.order[0], 0
    hoped = pool.error[best] - multiplier + HOPE * (nodes.exact[0] - pool.exact[best])
    for m in range(n_kept):
        at, c = pool.order[m], n_made
        if m > 0 and pool.exact[at] >= hoped:
            continue
        n_made += 1
        b = pool.parent[at]
        for j in range(t):
            children.support[c, j], children.target[c, j] = nodes.support[b, j], nodes.target[b, j]
            children.along[c, j], children.slot[c, j] = nodes.along[b, j], nodes.slot[b, j]
            for i in range(t):
                children.gram[c, j, i], children.chol[c, j, i] = nodes.gram[b, j, i], nodes.chol[b, j, i]
        for j in range(t + 1):
            children.gram[c, t, j], children.gram[c, j, t] = pool.gram[at, j], pool.gram[at, j]
            children.chol[c, t, j] = pool.chol[at, j]
            children.rank[c, j], children.code[c, j] = pool.rank[at, j], pool.code[at, j]
        children.support[c, t], children.target[c, t], children.slot[c, t] = pool.atom[at], pool.target[at], b
        children.along[c, t], children.exact[c], children.key[c] = pool.along[at], pool.exact[at], pool.key[at]
    return n_made


@part()
def store_best(nodes, t, pool, atom, weight, code):
    """Let codes, by rank, be those of the first child in the pool, of t + 1 atoms."""
    at = pool.order[0]
    b = pool.parent[at]
    for j in range(t + 1):
        r = pool.rank[at, j]
        atom[r] = nodes.support[b, j] if j < t else pool.atom[at]
        weight[r], code[r] = pool.weight[at, j], pool.code[at, j]
