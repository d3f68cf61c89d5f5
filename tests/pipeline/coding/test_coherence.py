"""Twins against all products in float64."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.coherence import MOST_COHERENCE, coherent_with_earlier, distinct_directions
from pipeline.coding.grid import patches_of
from pipeline.texture.resample import PATCH_DIM


def atoms_with_twins(kind: str, n: int = 1100) -> np.ndarray:
    """Unit atoms (n, d): a third are another one, to a coherence just above or below the threshold, or its opposite."""
    rng = np.random.default_rng(3)
    if kind == "short":
        atoms = rng.standard_normal((n, 192))
    elif kind == "smooth":
        atoms = patches_of(rng.standard_normal((n, 192)).astype(np.float32) / (1 + np.arange(192)), 8).astype(
            np.float64
        )
    else:  # of which short products tell nothing
        atoms = rng.standard_normal((n, PATCH_DIM))
    atoms /= np.linalg.norm(atoms, axis=1, keepdims=True)
    for i, of in zip(rng.permutation(n)[: n // 3], rng.integers(0, n, n // 3)):
        off = rng.standard_normal(atoms.shape[1])
        off -= off @ atoms[of] * atoms[of]
        coherence = rng.choice([0.985, 0.9895, 0.9905, 1.0])
        atoms[i] = rng.choice([-1, 1]) * (coherence * atoms[of] + np.sqrt(1 - coherence**2) * off / np.linalg.norm(off))
    return atoms.astype(np.float32)


def products(atoms: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.abs(atoms.astype(np.float64) @ others.astype(np.float64).T)


@pytest.mark.parametrize("kind", ["short", "smooth", "rough"])
def test_coherence__of_living_earlier_ones_are_those_of_all_products(kind):
    atoms = atoms_with_twins(kind)
    alive = np.random.default_rng(4).random(len(atoms)) < 0.9
    expected = alive & (np.tril(products(atoms, atoms), -1)[:, alive] >= MOST_COHERENCE).any(axis=1)
    found = coherent_with_earlier(atoms, alive)
    assert 50 < expected.sum() < 500 and (found == expected).all()


@pytest.mark.parametrize("kind", ["short", "smooth", "rough"])
def test_coherence__distinct_directions_are_the_first_that_are_no_twin(kind):
    atoms = atoms_with_twins(kind)
    taken, candidates = atoms[:300], 3 * atoms[300:]
    candidates[7] = 0
    of_all, kept = products(atoms, atoms), list(range(300))
    for i in range(300, len(atoms)):
        if i != 307 and not (of_all[i, kept] >= MOST_COHERENCE).any():
            kept.append(i)
    expected = atoms[kept[300:]]
    found = distinct_directions(candidates, taken, len(candidates))
    assert len(found) == len(expected) < len(candidates) - 50
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert (distinct_directions(candidates, taken, 10) == found[:10]).all()
