"""Scores of order-recursive matching pursuit (ORMP). Dimensions: k atoms, d texels, t atoms of a support, m tiles.

OMP takes the atom of largest |<r, a>|. ORMP takes the one that leaves least once the whole support is fitted again:

    argmax  <r, a>^2 / |a - P a|^2        P: projection onto the span of the support, r: what exact weights leave

With an orthonormal basis q_0 .. q_(t-1) of the support

    |a - P a|^2 = 1 - sum_j <q_j, a>^2        <r, a> = <y, a> - sum_j <y, q_j> <q_j, a>

so that a support one atom larger takes one more row of products <q_t, a>.

Scores are made and searched by tiles of neighbouring atoms: group g are the g-th atoms of all tiles, and the highest
score of every group is kept on the way.

Papers: Rebollo-Neira and Lowe 2002 (optimised OMP, the same rule); Cotter et al. 1999 (order recursion).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.omp_kernels import SMALLEST_CORRELATION, SMALLEST_PIVOT, dot
from pipeline.execution.compiled import FAST, part


class Tiles(NamedTuple):
    """Where tiles begin and how many atoms they have; `width` is the most."""

    start: np.ndarray  # (m,) int64
    length: np.ndarray  # (m,) int64

    @classmethod
    def of(cls, n_straight: int, n_turns: int, width: int) -> Tiles:
        """Of atoms in turns, n_straight of each, so that a tile's atoms have the same turn."""
        start = np.arange(0, n_straight, width)
        length = np.minimum(width, n_straight - start)
        return cls((start + n_straight * np.arange(n_turns)[:, None]).ravel(), np.tile(length, n_turns))


class Scores(NamedTuple):
    """Of one support's atoms, for a patch scaled to norm 1: squares in float32 then neither overflow nor vanish."""

    initial: np.ndarray  # (k,) float32: products with the patch
    slack: np.ndarray  # (k,) float32: how far off they may be
    clear: int  # 0 where all slack is 0, so that its beginning will do for all of it; else 1
    score: np.ndarray  # (k,) float32
    upper: np.ndarray  # (g,) float32: the highest score of each group
    bits: np.ndarray  # (g,) int32: the same memory
    tiles: Tiles


@part()
def of_node(s, b):
    """The scores of node b, where they are those of some: (w, k) and (w, g)."""
    return Scores(s.initial, s.slack, s.clear, s.score[b], s.upper[b], s.bits[b], s.tiles)


@part(fastmath=FAST)
def score_first(s):
    """Upper bounds of <y, a>^2."""
    for g in range(s.upper.shape[0]):
        s.upper[g] = 0
    for m in range(s.tiles.start.shape[0]):
        at, n = np.uintp(s.tiles.start[m]), np.uintp(s.tiles.length[m])
        for i in range(n):
            size = abs(s.initial[at + i]) + s.slack[at + i]
            value = size * size
            s.score[at + i] = value
            s.upper[i] = max(s.upper[i], value)


@part(fastmath=FAST)
def _ratios_of_one(s, at, n, row, x, explained, norm):
    least = np.float32(SMALLEST_PIVOT)
    for i in range(n):
        told, outside = x * row[at + i], np.float32(1) - row[at + i] * row[at + i]
        explained[at + i], norm[at + i] = told, outside
        size = abs(s.initial[at + i] - told) + s.slack[at + i]
        value = size * size / max(outside, least)
        value = value if outside > least else np.float32(0)
        s.score[at + i] = value
        s.upper[i] = max(s.upper[i], value)


@part(fastmath=FAST)
def _ratios(s, at, n, row, x, old_explained, old_norm, explained, norm):
    least = np.float32(SMALLEST_PIVOT)
    for i in range(n):
        told, outside = old_explained[at + i] + x * row[at + i], old_norm[at + i] - row[at + i] * row[at + i]
        explained[at + i], norm[at + i] = told, outside
        size = abs(s.initial[at + i] - told) + s.slack[at + i]
        value = size * size / max(outside, least)
        value = value if outside > least else np.float32(0)
        s.score[at + i] = value
        s.upper[i] = max(s.upper[i], value)


@part()
def score_beside(s, row, along, parent, explained, norm, t):
    """Upper bounds of <r, a>^2 / |a - P a|^2, zero for atoms in the span of the support.

    row = <q_(t-1), a> of all atoms, along = <y, q_(t-1)>; explained and norm (k,) become what the support explains of
    every correlation and what of every atom's squared norm lies outside its span, from `parent`, the same of one atom
    fewer.
    """
    for g in range(s.upper.shape[0]):
        s.upper[g] = 0
    for m in range(s.tiles.start.shape[0]):
        at, n = np.uintp(s.tiles.start[m]), np.uintp(s.tiles.length[m])
        if t == 1:
            _ratios_of_one(s, at, n, row, np.float32(along), explained, norm)
        else:
            _ratios(s, at, n, row, np.float32(along), parent[0], parent[1], explained, norm)


@part()
def _highest(bits):
    """The first of the largest of non-negative float32 values, by their bits: whole numbers in the same order, of which
    compilers make the maximum in vectors."""
    best = np.int64(-1)
    for i in range(np.uintp(bits.shape[0])):
        best = max(best, (np.int64(bits[i]) << 32) | (np.int64(0xFFFFFFFF) - np.int64(i)))
    return np.int64(0xFFFFFFFF) - (best & np.int64(0xFFFFFFFF))


@part()
def _rescore(s, a, g, value):
    s.score[a] = value
    largest = np.float32(0)
    for m in range(s.tiles.start.shape[0]):
        if g < s.tiles.length[m]:
            largest = max(largest, s.score[s.tiles.start[m] + g])
    s.upper[g] = largest


@part()
def take_best(s, patch, dictionary, unit, beside, look, t):
    """The atom of highest score which then has none, and that score; -1 where correlations are all rounding.

    Bounds are settled on the way: the atom whose bound is highest is made exact, until the highest is exact itself. Of
    equals the first of the first group. `unit` times the patch has norm 1; `look(beside, a)` is what a support of t
    atoms, at least one, explains of the correlation with atom a, and what of its squared norm lies outside its span.
    """
    while True:
        g, m = _highest(s.bits), 0
        largest = s.upper[g]
        if largest <= SMALLEST_CORRELATION**2:
            return -1, 0.0
        while g >= s.tiles.length[m] or s.score[s.tiles.start[m] + g] < largest:
            m += 1
        best = s.tiles.start[m] + g
        settled = s.slack[best] == 0
        if not settled:
            s.initial[best] = np.float32(unit * dot(patch, dictionary[best]))
            s.slack[best] = 0
        left, outside = s.initial[best], np.float32(1)
        if t > 0:
            told, outside = look(beside, best)
            left = left - told
        _rescore(s, best, g, np.float32(0) if settled else left * left / outside)
        if settled and left * left > SMALLEST_CORRELATION**2:
            return best, np.float64(largest)
