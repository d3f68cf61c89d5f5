"""Weight levels that are learned in the loop: from the weights that a pursuit with these levels takes.

Levels of least squared error for weights that are not rounded are not those that a beam wants: it takes other atoms
where these round better, and lets atoms exchange their ranks. So patches are coded again and again, and each level
moves to the mean of what the weights at it would be were they alone not rounded (the k-means of Lloyd 1982, with a
pursuit for the nearest).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.coding.omp import Pursuit, reconstruct
from pipeline.execution.compiled import kernel

ROUNDS = 6
STEP = 1.8  # times the way to the mean: as far in 6 rounds as in 12 without
FEW = 4.0  # weights that move a level half of the way: a few patches tell little


def learn_levels(
    levels: np.ndarray,  # (r, w) ascending rows
    patches: np.ndarray,  # (n, d) float32
    dictionary: np.ndarray,  # (k, d) float32, unit rows
    stands_for: np.ndarray,  # (n,) float64: how many patches each of these stands for
    pursue: Callable[[np.ndarray], Pursuit],
    multiplier: float,  # that it codes with
    rounds: int = ROUNDS,
) -> np.ndarray:
    """Levels (r, w) float32, ascending rows, for patches that `pursue` codes with the levels it is given: of all that
    were tried, these at first among them, those of the least error and multiplier times atoms. One that few weights
    take hardly moves."""
    best, least = levels, np.inf
    levels = levels.astype(np.float64)
    for _ in range(rounds + 1):
        tried = levels.astype(np.float32)
        found = pursue(tried)
        cost = float(stands_for @ (found.residual + multiplier * found.codes.n_atoms))
        if cost < least:
            best, least = tried, cost
        total, count = np.zeros_like(levels), np.zeros_like(levels)
        left = patches - reconstruct(found.codes, dictionary)
        _add_optima(left, dictionary, *found.codes, found.weight_code, stands_for, total, count)
        levels += STEP * (total - count * levels) / (count + FEW * stands_for.mean())
        levels.sort(axis=1)
    return best


@kernel()
def _add_optima(left, dictionary, atom, weight, n_atoms, code, stands_for, total, count):
    """Add up, by rank and code, what each weight would be if it alone were not rounded; `left` (n, d): what all leave."""
    for i in range(left.shape[0]):
        for j in range(n_atoms[i]):
            optimum, texels = np.float64(weight[i, j]), dictionary[atom[i, j]]
            for d in range(texels.shape[0]):
                optimum += np.float64(left[i, d]) * np.float64(texels[d])
            total[j, code[i, j]] += stands_for[i] * optimum
            count[j, code[i, j]] += stands_for[i]
