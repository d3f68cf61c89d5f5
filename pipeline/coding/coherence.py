"""Coherent atoms, |<a, b>| near 1: a dictionary keeps the first of them.

Papers: HPG 2021, section 3.3; the threshold is that of KSVD-Box. All pairs are looked at, but of whole patches few are
multiplied: what short rows leave of two atoms adds no more to their product than the product of its norms
(Cauchy-Schwarz).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.grid import coefficients
from pipeline.coding.omp_kernels import dot, squared_norms
from pipeline.execution.compiled import kernel
from pipeline.texture.resample import PATCH_DIM

MOST_COHERENCE = 0.99  # above it two atoms are one
SKETCH_SIZE = 4  # texels to a side of the grid whose coefficients tell which whole patches may be coherent
NO_END = 1 << 40  # more rows than there are
SKETCH_ROUNDING = 1e-3  # of what they leave of a unit atom: products of two of these are float32's rounding


def distinct_directions(candidates: np.ndarray, taken: np.ndarray, n_wanted: int) -> np.ndarray:
    """The first `n_wanted` candidates (n, d), normalised, each less coherent than MOST_COHERENCE with `taken` and with
    those before it."""
    chosen = np.empty((len(taken) + n_wanted, candidates.shape[1]), np.float32)
    chosen[: len(taken)] = taken
    others, n_chosen = [_sketched(chosen[: len(taken)])], len(taken)
    for start in range(0, len(candidates), 256):
        rows = candidates[start : start + 256].astype(np.float32)
        norms = np.linalg.norm(rows, axis=1, keepdims=True)
        rows = rows / np.where(norms > 0, norms, 1)  # type: ignore[assignment]
        coherent, sketch = norms[:, 0] == 0, _sketched(rows)
        for other in others:
            _mark_coherent(
                sketch.short @ other.short.T, *sketch, *other, np.ones(len(other.rows), bool), NO_END, coherent
            )
        fresh_from = n_chosen
        for row in rows[~coherent]:
            if n_chosen == len(chosen):
                return chosen[len(taken) :]
            if (np.abs(chosen[fresh_from:n_chosen] @ row) < MOST_COHERENCE).all():
                chosen[n_chosen] = row
                n_chosen += 1
        others.append(_sketched(chosen[fresh_from:n_chosen]))
    return chosen[len(taken) : n_chosen]


def coherent_with_earlier(atoms: np.ndarray, alive: np.ndarray) -> np.ndarray:
    """Which living ones of atoms (k, d) float32 point, or point away, like a living one of lower index, (k,) bool.
    Block by block, in 4 MiB."""
    coherent = np.zeros(len(atoms), bool)
    blocks = [(start, _sketched(atoms[start : start + 1024])) for start in range(0, len(atoms), 1024)]
    for i, (start, rows) in enumerate(blocks):
        for earlier, others in blocks[: i + 1]:
            _mark_coherent(
                rows.short @ others.short.T,
                *rows,
                *others,
                alive[earlier : earlier + 1024],
                start - earlier,
                coherent[start : start + 1024],
            )
    return coherent & alive


class _Sketched(NamedTuple):
    """Unit rows, and what short products need to tell which of them may be coherent."""

    rows: np.ndarray  # (n, d) float32
    short: np.ndarray  # (n, s) float32
    left: np.ndarray  # (n,) float32: norms of what they leave; zeros where they are the rows themselves


def _sketched(rows: np.ndarray) -> _Sketched:
    if rows.shape[1] != PATCH_DIM:
        return _Sketched(rows, rows, np.zeros(len(rows), np.float32))
    short = coefficients(rows, SKETCH_SIZE)
    left = np.sqrt(np.maximum(squared_norms(rows) - squared_norms(short), 0)) + SKETCH_ROUNDING
    return _Sketched(rows, short, left.astype(np.float32))


@kernel()
def _mark_coherent(product, rows, short, left, others, others_short, others_left, alive, n_before, coherent):
    """Mark row i where it is coherent with a living one among the first `n_before` + i of `others`; `product` are short
    products."""
    for i in range(product.shape[0]):
        for j in range(min(product.shape[1], n_before + i)):
            if abs(product[i, j]) + left[i] * others_left[j] >= MOST_COHERENCE and alive[j]:
                coherent[i] |= left[i] == 0 or abs(dot(rows[i], others[j])) >= MOST_COHERENCE
