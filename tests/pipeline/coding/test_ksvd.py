"""Dictionary learning: the sums are those of k-SVD's power iteration, and learning ends well."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding import ksvd
from pipeline.coding.coherence import MOST_COHERENCE
from pipeline.coding.ksvd import (
    block_sums,
    initial_dictionary,
    learn_dictionary,
    merge_in_order,
    merge_sums,
    updated_dictionary,
)
from pipeline.coding.omp import pursue_patches
from tests import reference
from tests.pipeline.coding.test_omp import unit_rows


def planted(rng: np.random.Generator, n: int, n_atoms: int, d: int, n_used: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Patches that are sums of a few atoms of a dictionary, and that dictionary."""
    atoms = unit_rows(rng, n_atoms, d)
    weights = np.zeros((n, n_atoms))
    for row in weights:
        row[rng.choice(n_atoms, n_used, replace=False)] = rng.uniform(0.5, 2, n_used) * rng.choice([-1, 1], n_used)
    return (weights @ atoms).astype(np.float32), atoms


def dense(codes, n_atoms: int) -> np.ndarray:
    weights = np.zeros((len(codes.weight), n_atoms))
    for row, atom, weight, n in zip(weights, codes.atom_index, codes.weight, codes.n_atoms):
        row[atom[:n]] = weight[:n]
    return weights


def test_ksvd__one_update_is_a_power_iteration_of_every_atom():
    rng = np.random.default_rng(0)
    patches, _ = planted(rng, 500, 24, 96)
    dictionary = initial_dictionary(patches, 24, seed=1)
    codes = pursue_patches(patches, dictionary, max_atoms=3)
    updated, n_replaced = updated_dictionary(dictionary, block_sums(patches, dictionary, codes))
    expected = reference.ksvd_power_iteration(patches, dictionary, dense(codes.codes, 24))
    assert n_replaced == 0
    np.testing.assert_allclose(np.abs((updated * expected).sum(axis=1)), 1, atol=1e-6)


def test_ksvd__recovers_a_planted_dictionary():
    rng = np.random.default_rng(1)
    patches, atoms = planted(rng, 4000, 20, 64)
    learned = learn_dictionary(patches, 20, max_atoms=3, iterations=40, seed=3)
    found = np.abs(atoms @ learned.T).max(axis=1)
    assert (found > 0.99).mean() >= 0.9


def test_ksvd__blocks_merge_to_the_whole():
    rng = np.random.default_rng(2)
    patches, _ = planted(rng, 700, 16, 48)
    dictionary = initial_dictionary(patches, 16, seed=0)

    def sums(rows):
        return block_sums(rows, dictionary, pursue_patches(rows, dictionary, max_atoms=3))

    whole, parts = sums(patches), [sums(patches[i : i + 100]) for i in range(0, 700, 100)]
    merged = merge_in_order(parts.__getitem__, 0, len(parts))
    np.testing.assert_allclose(merged.moment, whole.moment, atol=1e-4)
    np.testing.assert_allclose(merged.gain, whole.gain, rtol=1e-6)
    assert (merged.n_users == whole.n_users).all() and merged.n_patches == 700
    # Correlations are float32, and BLAS may add up the last rows of a block in another order.
    np.testing.assert_allclose(merged.worst_error[:50], whole.worst_error[:50], rtol=1e-5)


def test_ksvd__the_merge_keeps_the_worst_of_both():
    rng = np.random.default_rng(3)
    patches, _ = planted(rng, 2000, 16, 48)
    dictionary = initial_dictionary(patches, 16, seed=0)
    a, b = (
        block_sums(p, dictionary, pursue_patches(p, dictionary, max_atoms=1)) for p in (patches[:1000], patches[1000:])
    )
    merged = merge_sums(a, b)
    everything = np.sort(np.concatenate([a.worst_error, b.worst_error]))[::-1]
    assert (merged.worst_error == everything[: len(merged.worst_error)]).all()


def test_ksvd__learning_lowers_the_error():
    rng = np.random.default_rng(4)
    patches, _ = planted(rng, 3000, 40, 64)
    errors = []
    learn_dictionary(patches, 40, max_atoms=3, iterations=8, on_iteration=lambda i, e: errors.append(e))
    assert errors[-1] < 0.5 * errors[0]


def test_ksvd__same_seed_same_dictionary_other_seed_another():
    patches, _ = planted(np.random.default_rng(5), 1000, 16, 48)
    first, again, other = (learn_dictionary(patches, 16, max_atoms=3, iterations=3, seed=s) for s in (7, 7, 8))
    assert (first == again).all() and not (first == other).all()


def assert_sound(dictionary: np.ndarray) -> None:
    np.testing.assert_allclose(np.linalg.norm(dictionary, axis=1), 1, atol=1e-5)
    assert (np.abs(dictionary @ dictionary.T)[~np.eye(len(dictionary), dtype=bool)] <= MOST_COHERENCE + 1e-5).all()


def test_ksvd__replaces_an_unused_atom_and_a_twin_by_different_inputs():
    rng = np.random.default_rng(6)
    patches, _ = planted(rng, 2000, 20, 64)
    dictionary = initial_dictionary(patches, 20, seed=0)
    dictionary[3] = dictionary[4]
    codes = pursue_patches(patches, dictionary, max_atoms=3)
    sums = block_sums(patches, dictionary, codes)
    assert sums.n_users[4] == 0 or sums.n_users[3] == 0
    updated, n_replaced = updated_dictionary(dictionary, sums)
    assert n_replaced >= 1
    assert_sound(updated)


@pytest.mark.parametrize("kind", ["all equal", "two directions", "fewer than atoms", "rank one"])
def test_ksvd__poor_inputs_give_a_smaller_dictionary_not_a_broken_one(kind):
    rng = np.random.default_rng(7)
    row = rng.standard_normal(48).astype(np.float32)
    patches = {
        "all equal": np.tile(row, (100, 1)),
        "two directions": np.concatenate([np.tile(row, (50, 1)), np.tile(row[::-1], (50, 1))]),
        "fewer than atoms": rng.standard_normal((5, 48)).astype(np.float32),
        "rank one": np.outer(rng.standard_normal(100), row).astype(np.float32),
    }[kind]
    learned = learn_dictionary(patches, 16, max_atoms=8, iterations=4)
    assert 1 <= len(learned) <= 5
    assert_sound(learned)


def test_ksvd__says_so_where_there_is_nothing_to_learn():
    with pytest.raises(ValueError, match="none of the 10 patches differs from zero"):
        learn_dictionary(np.zeros((10, 48), np.float32), 4)


@pytest.mark.parametrize(("n_atoms", "n_blocks"), [(5, 1), (16, 7), (37, 12)])
def test_ksvd__moments_merged_by_ranges_of_atoms_are_the_same_bytes(n_atoms, n_blocks, monkeypatch):
    monkeypatch.setattr(ksvd, "MERGED_ATOMS", 16)
    rng = np.random.default_rng(8)
    moments = (rng.standard_normal((n_blocks, n_atoms, 6)) * 10.0 ** rng.integers(-3, 4, (n_blocks, 1, 1))).astype(
        np.float32
    )
    sums = [
        ksvd.Sums(m, np.zeros(n_atoms), np.zeros(n_atoms, int), 0.0, 1, np.zeros(0), np.zeros((0, 6))) for m in moments
    ]
    seen = []

    def load(block, atoms):
        seen.append(len(moments[block][atoms]))
        return moments[block][atoms]

    merged = ksvd.merge_moments(load, n_blocks, (n_atoms, 6))
    assert (merged == merge_in_order(sums.__getitem__, 0, n_blocks).moment).all() and max(seen) <= 16
