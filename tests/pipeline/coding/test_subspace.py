"""Components: they keep the floor, orthogonally, and learning in them is learning of whole patches."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.ksvd import learn_dictionary
from pipeline.coding.omp import pursue_patches
from pipeline.coding.subspace import HALF, STEP, find_components, halves_suffice, lift, project


def smooth(n: int, side: int = 16, seed: int = 0, grain: float = 0.01) -> np.ndarray:
    """Patches (n, side * side) with energy that falls with frequency, as photographs have, and a little grain."""
    rng = np.random.default_rng(seed)
    frequency = np.add.outer(np.arange(side) ** 2, np.arange(side) ** 2).ravel() + 1.0
    cosines = np.cos(np.pi * np.outer(np.arange(side), np.arange(side) + 0.5) / side)
    waves = np.einsum("ax,by->abxy", cosines, cosines).reshape(side * side, -1)
    rows = (rng.standard_normal((n, side * side)) / frequency) @ waves / side
    return (rows - rows.mean(axis=1, keepdims=True) + grain * rng.standard_normal(rows.shape)).astype(np.float32)


@pytest.mark.parametrize("floor", [0.5, 0.1, 0.03])
def test_subspace__keeps_the_floor_on_patches_it_was_not_found_from(floor):
    basis, left = find_components(smooth(2 * HALF), floor)
    _, rest = project(smooth(1000, seed=9), basis)
    assert left <= floor and rest.mean() <= 1.1 * floor
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-5)


def test_subspace__takes_no_more_components_than_the_floor_asks_for():
    patches, floor = smooth(2 * HALF), 0.1
    basis, _ = find_components(patches, floor)
    values = np.linalg.svd(patches[1::2].astype(float), compute_uv=False) ** 2 / HALF
    fewest = int(np.argmax(values.sum() - np.cumsum(values) <= floor)) + 1  # of any basis
    assert fewest <= basis.shape[1] <= fewest + 2 * STEP < patches.shape[1]


def test_subspace__patches_without_few_components_keep_as_many_as_there_are():
    noise = np.random.default_rng(0).standard_normal((600, 96)).astype(np.float32)
    basis, left = find_components(noise, 1e-6)
    assert basis.shape == (96, 96) and left <= 1e-2
    np.testing.assert_allclose(lift(project(noise, basis)[0], basis), noise, atol=1e-4)


@pytest.mark.parametrize("n", [1, 5, 70])
def test_subspace__fewer_patches_than_components_are_kept_whole(n):
    patches = smooth(n)
    basis, left = find_components(patches, 1e-4)
    np.testing.assert_allclose(lift(project(patches, basis)[0], basis), patches, atol=0.02)
    assert np.isfinite(basis).all() and left <= 1e-4


def test_subspace__squared_errors_there_and_rests_are_squared_errors_of_whole_patches():
    patches = smooth(500)
    basis, _ = find_components(patches, 0.1)
    coefficients, rest = project(patches, basis)
    atoms = learn_dictionary(coefficients, 24, max_atoms=4, iterations=2)
    found = pursue_patches(coefficients, atoms, max_atoms=4)
    whole = patches.astype(float) - np.einsum(
        "nt,ntd->nd", found.codes.weight, lift(atoms, basis).astype(float)[found.codes.atom_index]
    )
    np.testing.assert_allclose(found.residual + rest, np.square(whole).sum(axis=1), rtol=1e-4, atol=1e-5)


def test_subspace__learning_there_is_as_good_as_learning_of_whole_patches():
    patches, unseen = smooth(3000), smooth(1000, seed=5)
    tolerance = 0.1
    basis, _ = find_components(patches, tolerance / 10)
    coefficients, rest = project(patches, basis)
    options = {"max_atoms": 6, "iterations": 5}
    whole = learn_dictionary(patches, 64, tolerance=tolerance, **options)
    short = learn_dictionary(coefficients, 64, tolerance=np.maximum(tolerance - rest, 0), **options)
    error = [
        pursue_patches(unseen, np.ascontiguousarray(d), max_atoms=6, tolerance=tolerance).residual.mean()
        for d in (whole, lift(short, basis))
    ]
    assert basis.shape[1] < patches.shape[1] and error[1] <= 1.02 * error[0]


def test_subspace__halves_are_taken_only_where_they_are_not_felt():
    coefficients = smooth(100)
    error = np.square(coefficients - coefficients.astype(np.float16).astype(np.float32), dtype=float).sum(axis=1).mean()
    assert halves_suffice(coefficients, 101 * error) and not halves_suffice(coefficients, 99 * error)
    assert not halves_suffice(coefficients * 1e6, 1.0)
