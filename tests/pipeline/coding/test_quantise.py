"""Atoms in bytes and weights in levels."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.quantise import dequantise_atoms, quantise_atoms, train_weight_levels
from tests.pipeline.coding.test_omp import unit_rows


def test_quantise__decoded_atoms_are_unit_vectors_close_to_the_learned_ones():
    atoms = unit_rows(np.random.default_rng(0), 20, 3072)
    texels, scale = quantise_atoms(atoms)
    decoded = dequantise_atoms(texels, scale)
    np.testing.assert_allclose(np.linalg.norm(decoded, axis=1), 1, atol=1e-6)
    assert texels.min() >= -127 and np.abs(decoded - atoms).max() <= 0.6 * np.abs(atoms).max() / 127


@pytest.mark.parametrize("n_levels", [16, 256])
def test_quantise__trained_levels_beat_an_even_grid(n_levels):
    sample = np.random.default_rng(2).laplace(size=20000)
    levels = train_weight_levels([sample], n_levels)[0]
    assert (np.diff(levels) >= 0).all()

    def error(grid):
        return (np.abs(sample[:, None] - grid).min(axis=1) ** 2).mean()

    assert error(levels) < 0.6 * error(np.linspace(sample.min(), sample.max(), n_levels))


def test_quantise__a_rank_without_samples_takes_those_before_it():
    rng = np.random.default_rng(3)
    levels = train_weight_levels([rng.normal(size=5000), np.empty(0)], 16)
    assert np.isfinite(levels).all() and (levels[1] == levels[0]).all()
    assert np.isfinite(train_weight_levels([np.empty(0)], 16)).all()
    assert np.isfinite(train_weight_levels([np.array([0.5])], 16)).all()
