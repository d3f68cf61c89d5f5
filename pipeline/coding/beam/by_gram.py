"""Order-recursive pursuit with a beam, by a Gram matrix: a kernel a patch, as `omp_kernels.pursue`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.beam.nodes import TIE, Nodes, Pool, Products, keep_best, new_pool, try_children
from pipeline.coding.beam.scores import Scores, highest_of_groups, score_first
from pipeline.coding.omp_kernels import SMALLEST_PIVOT, TRUSTED, n_groups
from pipeline.execution.compiled import FAST, borrowed, kernel, part

TILE = 512  # atoms whose sums the first-level cache holds, beside what they are made of


class Node(NamedTuple):
    """One support of `Nodes`, of a patch scaled to norm 1 by `unit`."""

    support: np.ndarray  # (r,) int64
    along: np.ndarray  # (r,) float64
    chol: np.ndarray  # (r, r) float64
    slot: np.ndarray  # (r,) int64
    unit: float


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
def _score_beside_first(row, gram, quotients, node, s):
    """`_score_beside` of a support of one atom, which is the first vector of its basis itself."""
    k, n_turns, least = np.uintp(gram.shape[0]), quotients.shape[0], np.float32(SMALLEST_PIVOT)
    a, turn = np.uintp(node.support[0] % gram.shape[0]), node.support[0] // gram.shape[0]
    x, along = np.float32(node.chol[0, 0]), np.float32(node.unit * node.along[0])
    for other in range(n_turns):
        at, at_a = np.uintp(other) * k, np.uintp(quotients[turn, other]) * k
        for i in range(k):
            product = x * gram[a, at_a + i]
            row[at + i] = product
            outside = np.float32(1) - product * product
            size = abs(s.initial[at + i] - along * product) + s.slack[at + i]
            value = size * size / max(outside, least)
            s.score[at + i] = value if outside > least else np.float32(0)


@part(fastmath=FAST)
def _score_beside(row, gram, quotients, node, rows, s, last, tile):
    """Upper bounds of <r, a>^2 / |a - P a|^2 of all atoms beside a support of last + 1 atoms, and row = <q_last, a>.

    q_last = (a_last - sum_j chol[last, j] q_j) / pivot; <q_j, a> are the rows (r, w, k), that of q_j at node slot[j] of
    its step. What the support explains of a correlation and of an atom's squared norm is summed up again from the rows
    that q_last takes anyway, a tile at a time: kept for every node, they were twice as many bytes to read and write.
    """
    k, n_turns, least = gram.shape[0], quotients.shape[0], np.float32(SMALLEST_PIVOT)
    a, turn, scale = np.uintp(node.support[last] % k), node.support[last] // k, node.chol[last, last]
    x, along, told, outside = np.float32(scale), np.float32(node.unit * node.along[last]), tile[0], tile[1]
    for other in range(n_turns):
        for start in range(0, k, TILE):
            n, at = np.uintp(min(TILE, k - start)), np.uintp(other * k + start)
            at_a = np.uintp(quotients[turn, other] * k + start)
            for i in range(n):
                row[at + i] = x * gram[a, at_a + i]
                told[i], outside[i] = np.float32(0), np.float32(1)
            for j in range(last):
                y, z = np.float32(scale * node.chol[last, j]), np.float32(node.unit * node.along[j])
                earlier = rows[j, node.slot[j]]
                for i in range(n):
                    product = earlier[at + i]
                    row[at + i] -= y * product
                    told[i] += z * product
                    outside[i] -= product * product
            for i in range(n):
                product = row[at + i]
                left = outside[i] - product * product
                size = abs(s.initial[at + i] - told[i] - along * product) + s.slack[at + i]
                value = size * size / max(left, least)
                s.score[at + i] = value if left > least else np.float32(0)


@part()
def _look(beside, a):
    """See `take_best`: the sums that `_score_beside` makes, of one atom."""
    rows, node, row, last = beside
    told, outside = np.float32(0), np.float32(1)
    for j in range(last + 1):
        product = row[a] if j == last else rows[j, node.slot[j], a]
        told += np.float32(node.unit * node.along[j]) * product
        outside -= product * product
    return told, outside


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
        np.zeros(k, np.float32), np.empty(k, np.float32), np.empty(n_groups(k), np.float32), np.empty((max(1, most - 1), width, k), np.float32),
        np.empty((2, TILE), np.float32),
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
    tile = borrowed(scratch[4])
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
            n_found, last = 0, max(0, t - 1)
            for b in range(n_nodes):
                node, row = Node(nodes.support[b], nodes.along[b], nodes.chol[b], nodes.slot[b], unit), rows[last, b]
                if t == 0:
                    score_first(s)
                else:
                    if t == 1:
                        _score_beside_first(row, gram, quotients, node, s)
                    else:
                        _score_beside(row, gram, quotients, node, rows, s, last, tile)
                    for j in range(t):
                        s.score[node.support[j]] = 0
                    highest_of_groups(s)
                n_found = try_children(
                    nodes, b, t, s, (rows, node, row, last), _look, candidates if t else max(candidates, width),
                    path[i, t] - multiplier, patches[i], energy[i], unit, products, levels, pool, n_found,
                )  # fmt: skip
                if t > 0:
                    nodes.slot[b, last] = b
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
