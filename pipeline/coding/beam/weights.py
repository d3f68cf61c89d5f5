"""Weights of a support at levels, every rank with levels of its own. Dimensions: t atoms of a support, r ranks, w levels.

Codes do not say which of a support's atoms was found first, and the levels of ranks differ. So atoms may exchange their
ranks where that leaves less: log2(t!) bits that cost nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.execution.compiled import part

SWEEPS = 2  # settle supports of 8 (`omp_kernels.quantise_weights`)
CELLS = 64  # of equal width, between the lowest and the highest level of a rank: where the search for a level starts


class Levels(NamedTuple):
    """What weights may be."""

    value: np.ndarray  # (r, w) float64, ascending rows; w = 0 for exact weights
    first: np.ndarray  # (r, CELLS) int32: the level next to the beginning of each cell
    cells: np.ndarray  # (r,) float64: cells a unit


def searched_levels(levels: np.ndarray) -> Levels:
    """Levels (r, w) float64, with room for what finds them."""
    return Levels(levels, np.empty((len(levels), CELLS), np.int32), np.empty(len(levels)))


@part()
def prepare_levels(levels):
    """Fill in what finds levels."""
    n = levels.value.shape[1]
    for r in range(levels.value.shape[0] if n > 0 else 0):
        row, code = levels.value[r], 0
        levels.cells[r] = CELLS / max(row[n - 1] - row[0], 1e-300)
        for c in range(CELLS):
            code = _nearest_from(row, code, row[0] + c / levels.cells[r])
            levels.first[r, c] = code


@part()
def _nearest_from(row, code, value):
    """The level nearest to a value, the lower of two, from a level that is near."""
    while code + 1 < row.shape[0] and row[code + 1] - value < value - row[code]:
        code += 1
    while code > 0 and row[code] - value >= value - row[code - 1]:
        code -= 1
    return code


@part()
def _nearest(levels, r, value):
    row = levels.value[r]
    cell = (value - row[0]) * levels.cells[r]
    return _nearest_from(row, levels.first[r, np.int64(min(max(cell, 0.0), CELLS - 1.0))], value)


@part()
def _sweep(levels, gram, rank, left, weight, code, t):
    """Let each weight in turn take up what the others' rounding left; `left` (t,): products of the atoms with what the
    weights leave."""
    for _ in range(SWEEPS):
        moved = False
        for j in range(t):
            row = levels.value[rank[j]]
            nearest = _nearest_from(row, code[j], weight[j] + left[j] / gram[j, j])
            if nearest != code[j]:
                change = row[nearest] - weight[j]
                code[j], weight[j], moved = nearest, row[nearest], True
                for i in range(t):
                    left[i] -= change * gram[j, i]
        if not moved:
            break


@part()
def settle_weights(levels, energy, target, gram, rank, left, weight, code, t):
    """Replace least-squares weights of t atoms by levels, in place, and let atoms exchange ranks; `code` is where the
    search for levels starts, but for the last atom. Returns the squared residual."""
    code[t - 1] = _nearest(levels, rank[t - 1], weight[t - 1])
    for j in range(t):
        code[j] = _nearest_from(levels.value[rank[j]], code[j], weight[j])
        weight[j] = levels.value[rank[j], code[j]]
    for j in range(t):
        value = target[j]
        for i in range(t):
            value -= gram[j, i] * weight[i]
        left[j] = value
    _sweep(levels, gram, rank, left, weight, code, t)
    _exchange_ranks(levels, gram, rank, left, weight, code, t)
    for j in range(t):
        energy -= weight[j] * (target[j] + left[j])
    return max(energy, 0.0)


@part()
def _exchange_ranks(levels, gram, rank, left, weight, code, t):
    """Let each atom, the last first, have the rank of that of those before it with which this leaves least, if less than
    now."""
    for i in range(t - 1, 0, -1):
        most, other, code_i, code_j = 0.0, -1, 0, 0
        for j in range(i):
            to_i = _nearest(levels, rank[j], weight[i] + left[i] / gram[i, i])
            x = levels.value[rank[j], to_i] - weight[i]
            to_j = _nearest(levels, rank[i], weight[j] + (left[j] - x * gram[i, j]) / gram[j, j])
            y = levels.value[rank[i], to_j] - weight[j]
            fall = 2 * (x * left[i] + y * left[j] - x * y * gram[i, j]) - x * x * gram[i, i] - y * y * gram[j, j]
            if fall > most:
                most, other, code_i, code_j = fall, j, to_i, to_j
        if other >= 0:
            x, y = levels.value[rank[other], code_i] - weight[i], levels.value[rank[i], code_j] - weight[other]
            rank[i], rank[other] = rank[other], rank[i]
            code[i], code[other] = code_i, code_j
            weight[i], weight[other] = levels.value[rank[i], code_i], levels.value[rank[other], code_j]
            for j in range(t):
                left[j] -= x * gram[i, j] + y * gram[other, j]
            _sweep(levels, gram, rank, left, weight, code, t)
