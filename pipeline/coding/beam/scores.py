"""Scores of order-recursive matching pursuit (ORMP). Dimensions: k atoms, d texels, t atoms of a support.

OMP takes the atom of largest |<r, a>|. ORMP takes the one that leaves least once the whole support is fitted again:

    argmax  <r, a>^2 / |a - P a|^2        P: projection onto the span of the support, r: what exact weights leave

With an orthonormal basis q_0 .. q_(t-1) of the support

    |a - P a|^2 = 1 - sum_j <q_j, a>^2        <r, a> = <y, a> - sum_j <y, q_j> <q_j, a>

so that a support one atom larger takes one more row of products <q_t, a>.

Papers: Rebollo-Neira and Lowe 2002 (optimised OMP, the same rule); Cotter et al. 1999 (order recursion).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.omp_kernels import SMALLEST_CORRELATION, SMALLEST_PIVOT, dot, largest_of
from pipeline.execution.compiled import FAST, part


class Scores(NamedTuple):
    """Of one support's atoms, for a patch scaled to norm 1: squares in float32 then neither overflow nor vanish."""

    initial: np.ndarray  # (k,) float32: products with the patch
    slack: np.ndarray  # (k,) float32: how far off they may be
    score: np.ndarray  # (k,) float32
    upper: np.ndarray  # (g,) float32: the highest score of each group, see `bound_groups`


@part(fastmath=FAST)
def highest_of_groups(s):
    """The highest score of each group, see `bound_groups`."""
    n_atoms, width, start = np.uintp(s.score.shape[0]), np.uintp(s.upper.shape[0]), np.uintp(0)
    for g in range(width):
        s.upper[g] = 0
    while start < n_atoms:
        for g in range(min(width, n_atoms - start)):
            s.upper[g] = max(s.upper[g], s.score[start + g])
        start += width


@part(fastmath=FAST)
def _squares(s):
    for i in range(np.uintp(s.score.shape[0])):
        size = abs(s.initial[i]) + s.slack[i]
        s.score[i] = size * size


@part(fastmath=FAST)
def _ratios_of_one(s, row, along, explained, norm):
    x, least = np.float32(along), np.float32(SMALLEST_PIVOT)
    for i in range(np.uintp(row.shape[0])):
        told, outside = x * row[i], np.float32(1) - row[i] * row[i]
        explained[i], norm[i] = told, outside
        size = abs(s.initial[i] - told) + s.slack[i]
        value = size * size / max(outside, least)
        s.score[i] = value if outside > least else np.float32(0)


@part(fastmath=FAST)
def _ratios(s, row, along, old_explained, old_norm, explained, norm):
    x, least = np.float32(along), np.float32(SMALLEST_PIVOT)
    for i in range(np.uintp(row.shape[0])):
        told, outside = old_explained[i] + x * row[i], old_norm[i] - row[i] * row[i]
        explained[i], norm[i] = told, outside
        size = abs(s.initial[i] - told) + s.slack[i]
        value = size * size / max(outside, least)
        s.score[i] = value if outside > least else np.float32(0)


@part()
def score_first(s):
    """Upper bounds of <y, a>^2."""
    _squares(s)
    highest_of_groups(s)


@part()
def score_beside(s, row, along, parent, explained, norm, support, t):
    """Upper bounds of <r, a>^2 / |a - P a|^2, zero for atoms in the span of the support.

    row = <q_(t-1), a> of all atoms, along = <y, q_(t-1)>; explained and norm (k,) become what the support explains of
    every correlation and what of every atom's squared norm lies outside its span, from `parent`, the same of one atom
    fewer.
    """
    if t == 1:
        _ratios_of_one(s, row, along, explained, norm)
    else:
        _ratios(s, row, along, parent[0], parent[1], explained, norm)
    for j in range(t):
        s.score[support[j]] = 0
    highest_of_groups(s)


@part()
def _rescore(s, a, value):
    s.score[a] = value
    g, largest = a % s.upper.shape[0], np.float32(0)
    for b in range(g, s.score.shape[0], s.upper.shape[0]):
        largest = max(largest, s.score[b])
    s.upper[g] = largest


@part()
def take_best(s, patch, dictionary, unit, beside, look, t):
    """The atom of highest score, which then has none, and that score; -1 where correlations are all rounding.

    Bounds are settled on the way: the atom whose bound is highest is made exact, until the highest is exact itself. Of
    equals the first of the first group. `unit` times the patch has norm 1; `look(beside, a)` is what a support of t
    atoms, at least one, explains of the correlation with atom a, and what of its squared norm lies outside its span.
    """
    while True:
        best, largest = 0, largest_of(s.upper)
        if largest <= SMALLEST_CORRELATION**2:
            return -1, 0.0
        while s.upper[best] < largest:
            best += 1
        while s.score[best] < largest:
            best += s.upper.shape[0]
        settled = s.slack[best] == 0
        if not settled:
            s.initial[best] = np.float32(unit * dot(patch, dictionary[best]))
            s.slack[best] = 0
        left, outside = s.initial[best], np.float32(1)
        if t > 0:
            told, outside = look(beside, best)
            left = left - told
        _rescore(s, best, np.float32(0) if settled else left * left / outside)
        if settled and left * left > SMALLEST_CORRELATION**2:
            return best, np.float64(largest)
