"""A beam over supports. Dimensions: w nodes, r ranks, t atoms of a support, p children tried.

A node is a support; its children are the support with one of the atoms of highest score (see `scores`). A child is
valued by the squared residual with the weights that will be stored, so with the rounding of all of them.

Papers: Karabulut and Yongacoglu 2004 (a beam over supports); HPG 2021, section 3.4 (quantised weights in the loop).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.beam.scores import take_best
from pipeline.coding.omp_kernels import (
    SMALLEST_PIVOT,
    append_to_cholesky,
    dot,
    quantise_weights,
    residual_energy,
    solve_cholesky,
)
from pipeline.execution.compiled import part

# Share of a patch's squared norm within which two residuals count as one: a support that is found in two orders leaves
# the same but for rounding, which must not choose.
TIE = 1e-6


class Nodes(NamedTuple):
    """Supports of a patch; of a node the first t entries are in use, and entry t is for trials."""

    support: np.ndarray  # (w, r) int64: atoms
    target: np.ndarray  # (w, r) float64: products of the patch with the atoms
    along: np.ndarray  # (w, r) float64: and with the orthonormal basis
    gram: np.ndarray  # (w, r, r) float64
    chol: np.ndarray  # (w, r, r) float64: its Cholesky factor, reciprocals on the diagonal
    slot: np.ndarray  # (w, r) int64: at which node of its step each vector of the basis was made
    exact: np.ndarray  # (w,) float64: squared residual with exact weights


class Pool(NamedTuple):
    """Children, in the order of their trial."""

    atom: np.ndarray  # (p,) int64
    parent: np.ndarray  # (p,) int64
    target: np.ndarray  # (p,) float64
    error: np.ndarray  # (p,) float64: squared residual with the weights
    weight: np.ndarray  # (p, r) float64
    code: np.ndarray  # (p, r) int32
    tried: np.ndarray  # (c,) int64: atoms that the node at hand was tried with


class Products(NamedTuple):
    """Where products of two atoms come from: a Gram matrix, or the atoms themselves where `gram` is empty."""

    dictionary: np.ndarray  # (k, d) float32
    gram: np.ndarray  # (k / m, k) float32
    quotients: np.ndarray  # (m, m) int64, see `omp_kernels.pursue`


@part()
def new_pool(width, candidates, most):
    """An empty pool for `width` nodes of at most `most` atoms, with `candidates` each."""
    n = width * candidates
    return Pool(
        np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n), np.empty(n), np.empty((n, most)),
        np.zeros((n, most), np.int32), np.empty(max(width, candidates), np.int64),
    )  # fmt: skip


@part()
def _product(products, a, b):
    """<a, b> of two atoms, the same from both sides."""
    gram = products.gram
    if gram.shape[0] == 0:
        return dot(products.dictionary[a], products.dictionary[b])
    n = gram.shape[0]
    return np.float64(gram[a % n, products.quotients[a // n, b // n] * n + b % n])


@part()
def _is_coherent(products, atom, others, n):
    """Whether an atom is, but for its sign and as far as pivots tell, one of n others."""
    for j in range(n):
        if 1 - _product(products, atom, others[j]) ** 2 <= SMALLEST_PIVOT:
            return True
    return False


@part()
def _append(nodes, b, t, atom, target, products):
    """Let an atom, whose product with the patch is `target`, be atom t of node b. Returns the squared pivot."""
    nodes.support[b, t], nodes.target[b, t] = atom, target
    for j in range(t + 1):
        product = _product(products, atom, nodes.support[b, j])
        nodes.gram[b, t, j] = product
        nodes.gram[b, j, t] = product
    return append_to_cholesky(nodes.chol[b], nodes.gram[b], t)


@part()
def try_children(nodes, b, t, s, beside, look, n_wanted, enough, patch, energy, unit, products, levels, pool, n_found):
    """Try node b with the atoms of highest score, by `beside` and `look` of `take_best`; children that leave less than
    `enough` come into the pool, of which there are `n_found` before and the number returned after."""
    n_tried = 0
    while n_tried < n_wanted:
        best, gain = take_best(s, patch, products.dictionary, unit, beside, look, t)
        if best < 0 or nodes.exact[b] - energy * gain >= enough:  # no weights leave less than exact ones
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
        weight, code = pool.weight[n_found], pool.code[n_found]
        solve_cholesky(nodes.chol[b], nodes.target[b], nodes.along[b], weight, t + 1)
        if levels.shape[1] > 0:
            quantise_weights(levels, nodes.target[b], nodes.gram[b], weight, code, t + 1)
            error = residual_energy(energy, nodes.target[b], nodes.gram[b], weight, t + 1)
        else:
            error = max(nodes.exact[b] - nodes.along[b, t] ** 2, 0.0)
        if error < enough:
            pool.atom[n_found], pool.parent[n_found], pool.target[n_found], pool.error[n_found] = best, b, target, error
            n_found += 1
    return n_found


@part()
def _copy_node(source, b, to, c, t):
    for j in range(t):
        to.support[c, j] = source.support[b, j]
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
def _least(values, n, tie):
    """The first of n values that is no more than `tie` above the least; -1 where all are infinite."""
    least = np.inf
    for m in range(n):
        least = min(least, values[m])
    if least < np.inf:
        for m in range(n):
            if values[m] <= least + tie:
                return m
    return -1


@part()
def keep_best(nodes, t, pool, n_found, n_wanted, tie, products, children, atom, weight, code):
    """Make nodes of the children that leave least, `n_wanted` of them, none twice in another order; the codes become
    those of the first. Of children within `tie` of each other the one tried first counts as the better. Returns how
    many there are, and what the first leaves."""
    n_kept, error = 0, np.inf
    while n_kept < n_wanted:
        first = _least(pool.error, n_found, tie)
        if first < 0:
            break
        parent, left = pool.parent[first], pool.error[first]
        pool.error[first] = np.inf
        _copy_node(nodes, parent, children, n_kept, t)
        _append(children, n_kept, t, pool.atom[first], pool.target[first], products)
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
