"""The loops over all atoms that score them beside a support: the products with the last vector of its basis, what the
support explains of every correlation and of every atom's squared norm, and the score, in one pass without a store
between. What loads and stores take is most of a pursuit's time, so there is a loop for each number of earlier vectors.
Dimensions: k atoms, w nodes, r ranks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.omp_kernels import SMALLEST_PIVOT
from pipeline.execution.compiled import FAST, borrowed, fetched, part

MOST = 4  # earlier vectors of a pass; more are folded into `folded` before


class Tables(NamedTuple):
    """What passes read, flat: an index into them costs one addition."""

    gram: np.ndarray  # (k / m * k,) float32
    quotients: np.ndarray  # (m, m) int64, see `omp_kernels.pursue`
    made: np.ndarray  # (r * w * k,) float32: products with vectors of bases, that of node b of step j at (j w + b) k
    at: np.ndarray  # (w, r) uint64: where those of each node's basis begin
    less: np.ndarray  # (w, r) float32: how much of each the next vector has less than its atom
    along: np.ndarray  # (w, r) float32: products of the patch with them
    folded: np.ndarray  # (3 * width of a tile,) float32: Gram row, products and norms, less what vectors explain
    ones: np.ndarray  # (width of a tile,) float32


@part()
def borrowed_tables(t):
    """The same tables, see `borrowed`."""
    return Tables(
        borrowed(t.gram), borrowed(t.quotients), borrowed(t.made), borrowed(t.at), borrowed(t.less), borrowed(t.along),
        borrowed(t.folded), borrowed(t.ones),
    )  # fmt: skip


def new_tables(gram: np.ndarray, quotients: np.ndarray, width: int, most: int, tile: int) -> Tables:
    """For `width` nodes of at most `most` atoms."""
    return Tables(
        gram.reshape(-1),
        quotients,
        np.empty(max(1, most - 1) * width * gram.shape[1], np.float32),
        np.empty((width, most), np.uint64),
        np.empty((width, most), np.float32),
        np.empty((width, most), np.float32),
        np.empty(3 * tile, np.float32),
        np.ones(tile, np.float32),
    )


@part(fastmath=FAST)
def _score(s, b, i, at, size, outside):
    least = np.float32(SMALLEST_PIVOT)
    value = size * size / max(outside, least)
    value = value if outside > least else np.float32(0)
    s.score[b, at + i] = value
    s.upper[b, i] = max(s.upper[b, i], value)


@part(fastmath=FAST)
def _beside_none(s, t, b, at, n, last, x, gram, at_g, told, at_told, norm, at_norm):
    to, along, clear = t.at[b, last] + at, t.along[b, last], s.clear
    for i in range(n):
        q = x * gram[at_g + i]
        t.made[to + i] = q
        size = abs(told[at_told + i] - along * q) + s.slack[clear * at + i]
        _score(s, b, i, at, size, norm[at_norm + i] - q * q)


@part(fastmath=FAST)
def _beside_one(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm):
    to, along, clear = t.at[b, last] + at, t.along[b, last], s.clear
    a0, y0, z0 = t.at[b, j] + at, t.less[b, j], t.along[b, j]
    for i in range(n):
        q0 = t.made[a0 + i]
        q = x * gram[at_g + i] - y0 * q0
        t.made[to + i] = q
        size = abs(told[at_told + i] - z0 * q0 - along * q) + s.slack[clear * at + i]
        _score(s, b, i, at, size, norm[at_norm + i] - q0 * q0 - q * q)


@part(fastmath=FAST)
def _beside_two(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm):
    to, along, clear = t.at[b, last] + at, t.along[b, last], s.clear
    a0, y0, z0 = t.at[b, j] + at, t.less[b, j], t.along[b, j]
    a1, y1, z1 = t.at[b, j + 1] + at, t.less[b, j + 1], t.along[b, j + 1]
    for i in range(n):
        q0, q1 = t.made[a0 + i], t.made[a1 + i]
        q = x * gram[at_g + i] - y0 * q0 - y1 * q1
        t.made[to + i] = q
        size = abs(told[at_told + i] - z0 * q0 - z1 * q1 - along * q) + s.slack[clear * at + i]
        _score(s, b, i, at, size, norm[at_norm + i] - q0 * q0 - q1 * q1 - q * q)


@part(fastmath=FAST)
def _beside_three(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm):
    to, along, clear = t.at[b, last] + at, t.along[b, last], s.clear
    a0, y0, z0 = t.at[b, j] + at, t.less[b, j], t.along[b, j]
    a1, y1, z1 = t.at[b, j + 1] + at, t.less[b, j + 1], t.along[b, j + 1]
    a2, y2, z2 = t.at[b, j + 2] + at, t.less[b, j + 2], t.along[b, j + 2]
    for i in range(n):
        q0, q1, q2 = t.made[a0 + i], t.made[a1 + i], t.made[a2 + i]
        q = x * gram[at_g + i] - y0 * q0 - y1 * q1 - y2 * q2
        t.made[to + i] = q
        size = abs(told[at_told + i] - z0 * q0 - z1 * q1 - z2 * q2 - along * q) + s.slack[clear * at + i]
        _score(s, b, i, at, size, norm[at_norm + i] - q0 * q0 - q1 * q1 - q2 * q2 - q * q)


@part(fastmath=FAST)
def _beside_four(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm):
    to, along, clear = t.at[b, last] + at, t.along[b, last], s.clear
    a0, y0, z0 = t.at[b, j] + at, t.less[b, j], t.along[b, j]
    a1, y1, z1 = t.at[b, j + 1] + at, t.less[b, j + 1], t.along[b, j + 1]
    a2, y2, z2 = t.at[b, j + 2] + at, t.less[b, j + 2], t.along[b, j + 2]
    a3, y3, z3 = t.at[b, j + 3] + at, t.less[b, j + 3], t.along[b, j + 3]
    for i in range(n):
        q0, q1, q2, q3 = t.made[a0 + i], t.made[a1 + i], t.made[a2 + i], t.made[a3 + i]
        q = x * gram[at_g + i] - y0 * q0 - y1 * q1 - y2 * q2 - y3 * q3
        t.made[to + i] = q
        size = abs(told[at_told + i] - z0 * q0 - z1 * q1 - z2 * q2 - z3 * q3 - along * q) + s.slack[clear * at + i]
        _score(s, b, i, at, size, norm[at_norm + i] - q0 * q0 - q1 * q1 - q2 * q2 - q3 * q3 - q * q)


@part(fastmath=FAST)
def _fold_four(t, b, j, at, n, x, gram, at_g, told, at_told, norm, at_norm, width):
    """folded = the Gram row times x, products and norms, less what four vectors explain; may be done in place."""
    a0, y0, z0 = t.at[b, j] + at, t.less[b, j], t.along[b, j]
    a1, y1, z1 = t.at[b, j + 1] + at, t.less[b, j + 1], t.along[b, j + 1]
    a2, y2, z2 = t.at[b, j + 2] + at, t.less[b, j + 2], t.along[b, j + 2]
    a3, y3, z3 = t.at[b, j + 3] + at, t.less[b, j + 3], t.along[b, j + 3]
    for i in range(n):
        q0, q1, q2, q3 = t.made[a0 + i], t.made[a1 + i], t.made[a2 + i], t.made[a3 + i]
        t.folded[i] = x * gram[at_g + i] - y0 * q0 - y1 * q1 - y2 * q2 - y3 * q3
        t.folded[width + i] = told[at_told + i] - z0 * q0 - z1 * q1 - z2 * q2 - z3 * q3
        t.folded[np.uintp(2) * width + i] = norm[at_norm + i] - q0 * q0 - q1 * q1 - q2 * q2 - q3 * q3


@part()
def score_beside(s, t, nodes, n_nodes, unit, last):
    """Upper bounds of <r, a>^2 / |a - P a|^2 of all atoms beside each node (`scores.of_node`), a support of last + 1 atoms, and
    q_last = (a_last - sum_j chol[last, j] q_j) / pivot by its products with all atoms.

    What the support explains of a correlation and of an atom's squared norm is summed up again from the rows that
    q_last takes anyway: kept for every node, they were twice as many bytes to read and write. All nodes take a tile
    together, while the rows that they share are in the first-level cache.
    """
    k, width = s.initial.shape[0], nodes.exact.shape[0]
    for b in range(n_nodes):
        for j in range(last):
            t.at[b, j] = np.uint64((j * width + nodes.slot[b, j]) * k)
            t.less[b, j] = np.float32(nodes.chol[b, last, last] * nodes.chol[b, last, j])
        for j in range(last + 1):
            t.along[b, j] = np.float32(unit * nodes.along[b, j])
        t.at[b, last] = np.uint64((last * width + b) * k)
        nodes.slot[b, last] = b
        for g in range(s.upper.shape[1]):
            s.upper[b, g] = 0
    for m in range(s.tiles.start.shape[0]):
        at, n = np.uintp(s.tiles.start[m]), np.uintp(s.tiles.length[m])
        for b in range(n_nodes):
            if m + 1 < s.tiles.start.shape[0]:
                fetched(t.gram, _in_gram(s, t, nodes.support[b, last], m + 1), np.uintp(s.tiles.length[m + 1]))
            at_gram = _in_gram(s, t, nodes.support[b, last], m)
            _score_tile(s, t, b, last, at, n, np.float32(nodes.chol[b, last, last]), at_gram)


@part()
def _in_gram(s, t, atom, m):
    """Where the products of an atom with tile m begin."""
    k = s.initial.shape[0]
    straight = k // t.quotients.shape[0]
    other = s.tiles.start[m] // straight
    turned = t.quotients[atom // straight, other] - other
    return np.uintp(atom % straight * k + turned * straight + s.tiles.start[m])


@part()
def _score_tile(s, t, b, last, at, n, x, at_g):
    tile, zero, j = np.uintp(t.ones.shape[0]), np.uintp(0), 0
    gram, told, at_told, norm, at_norm = t.gram, s.initial, at, t.ones, zero
    while last - j > MOST:
        _fold_four(t, b, j, at, n, x, gram, at_g, told, at_told, norm, at_norm, tile)
        x, gram, at_g, told, at_told, norm, at_norm = (
            np.float32(1), t.folded, zero, t.folded, tile, t.folded, tile + tile
        )  # fmt: skip
        j += 4
    if last - j == 0:
        _beside_none(s, t, b, at, n, last, x, gram, at_g, told, at_told, norm, at_norm)
    elif last - j == 1:
        _beside_one(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm)
    elif last - j == 2:
        _beside_two(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm)
    elif last - j == 3:
        _beside_three(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm)
    else:
        _beside_four(s, t, b, at, n, last, j, x, gram, at_g, told, at_told, norm, at_norm)


@part()
def explained(beside, a):
    """See `scores.take_best`: the sums that `score_beside` makes, of one atom."""
    t, b, last = beside
    told, outside = np.float32(0), np.float32(1)
    for j in range(last + 1):
        q = t.made[t.at[b, j] + np.uintp(a)]
        told += t.along[b, j] * q
        outside -= q * q
    return told, outside
