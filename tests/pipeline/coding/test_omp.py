"""Sparse coding: each sentence of sparse_encode's docstring, and its twin in float64."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.omp import pursue_patches, reconstruct, sparse_encode
from pipeline.coding.omp_kernels import nearest_level, squared_norms
from tests import reference


def unit_rows(rng: np.random.Generator, n: int, d: int) -> np.ndarray:
    atoms = rng.standard_normal((n, d)).astype(np.float32)
    return atoms / np.linalg.norm(atoms, axis=1, keepdims=True)


def smooth_patches(rng: np.random.Generator, n: int, d: int = 192) -> np.ndarray:
    return np.cumsum(rng.standard_normal((n, d)), axis=1).astype(np.float32) / d


def test_omp__recovers_a_planted_support():
    rng = np.random.default_rng(0)
    atoms = unit_rows(rng, 64, 512)
    support = np.array([rng.choice(64, 4, replace=False) for _ in range(100)])
    weight = rng.uniform(0.5, 2, support.shape) * rng.choice([-1, 1], support.shape)
    patches = np.einsum("nt,ntd->nd", weight, atoms[support]).astype(np.float32)
    codes = sparse_encode(patches, atoms, max_atoms=4)
    assert (np.sort(codes.atom_index) == np.sort(support)).all()
    found = np.take_along_axis(codes.weight, np.argsort(codes.atom_index), axis=1)
    np.testing.assert_allclose(found, np.take_along_axis(weight, np.argsort(support), axis=1), rtol=1e-4)


def test_omp__returns_atoms_weights_and_counts():
    rng = np.random.default_rng(0)
    atom_index, weight, n_atoms = sparse_encode(smooth_patches(rng, 7), unit_rows(rng, 20, 192), max_atoms=5)
    assert (atom_index.shape, weight.shape, n_atoms.shape) == ((7, 5), (7, 5), (7,))


def test_omp__agrees_with_the_float64_twin():
    rng = np.random.default_rng(1)
    atoms, patches = unit_rows(rng, 96, 192), smooth_patches(rng, 200)
    found = pursue_patches(patches, atoms, max_atoms=6, tolerance=0.05)
    codes, residuals = found.codes, found.residual
    for i, patch in enumerate(patches):
        support, weight, residual = reference.omp(patch, atoms, 6, 0.05)
        n = codes.n_atoms[i]
        assert codes.atom_index[i, :n].tolist() == support
        np.testing.assert_allclose(codes.weight[i, :n], weight, atol=2e-5 * np.abs(weight).max(initial=0))
        assert residuals[i] == pytest.approx(residual, rel=1e-3, abs=1e-5)


def test_omp__the_residual_it_reports_is_the_residual():
    rng = np.random.default_rng(2)
    atoms, patches = unit_rows(rng, 96, 192), smooth_patches(rng, 100)
    for levels in (None, np.tile(np.linspace(-2, 2, 16), (8, 1))):
        found = pursue_patches(patches, atoms, max_atoms=8, weight_levels=levels)
        codes, residual = found.codes, found.residual
        lost = ((patches - reconstruct(codes, atoms)).astype(np.float64) ** 2).sum(axis=1)
        np.testing.assert_allclose(residual, lost, rtol=1e-3, atol=1e-5)


def test_omp__stops_at_the_tolerance_and_not_before():
    rng = np.random.default_rng(3)
    atoms, patches = unit_rows(rng, 96, 192), smooth_patches(rng, 200)
    found = pursue_patches(patches, atoms, max_atoms=8, tolerance=0.1)
    codes, residual = found.codes, found.residual
    assert (residual[codes.n_atoms < 8] <= 0.1).all()
    assert len(set(codes.n_atoms.tolist())) > 4
    for n in range(1, 8):
        shorter = pursue_patches(patches[codes.n_atoms == n + 1], atoms, max_atoms=n)
        assert (shorter.residual > 0.1).all()


@pytest.mark.parametrize("levels", [None, np.tile(np.linspace(-2, 2, 16), (8, 1))], ids=["exact", "quantised"])
def test_omp__the_residual_never_rises_with_an_atom(levels):
    rng = np.random.default_rng(4)
    atoms, patches = unit_rows(rng, 96, 192), smooth_patches(rng, 200)
    residuals = [pursue_patches(patches, atoms, max_atoms=n, weight_levels=levels).residual for n in range(1, 9)]
    assert (np.diff(residuals, axis=0) <= 1e-9).all()


def test_omp__takes_no_atom_twice():
    rng = np.random.default_rng(5)
    atoms, patches = unit_rows(rng, 12, 192), smooth_patches(rng, 300)
    coarse = np.tile([-0.5, 0.5], (8, 1))
    for levels in (None, coarse):
        codes = sparse_encode(patches, atoms, max_atoms=8, weight_levels=levels)
        for atom, n in zip(codes.atom_index, codes.n_atoms):
            assert len(set(atom[:n])) == n


def test_omp__duplicate_atoms_do_no_harm():
    rng = np.random.default_rng(6)
    atoms, patches = unit_rows(rng, 32, 192), smooth_patches(rng, 100)
    twice = np.concatenate([atoms, atoms, -atoms])
    found = pursue_patches(patches, twice, max_atoms=8)
    codes, residual = found.codes, found.residual
    once = pursue_patches(patches, atoms, max_atoms=8)
    assert np.isfinite(codes.weight).all()
    assert all(len(set(a[:n] % 32)) == n for a, n in zip(codes.atom_index, codes.n_atoms))
    np.testing.assert_allclose(residual, once.residual, rtol=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_omp__scaling_a_patch_scales_its_weights(scale):
    rng = np.random.default_rng(7)
    atoms, patches = unit_rows(rng, 64, 192), smooth_patches(rng, 100)
    plain = sparse_encode(patches, atoms, max_atoms=6, tolerance=0.05)
    scaled = sparse_encode(patches * np.float32(scale), atoms, max_atoms=6, tolerance=0.05 * scale**2)
    assert (plain.atom_index == scaled.atom_index).all()
    np.testing.assert_allclose(scaled.weight / scale, plain.weight, rtol=1e-5, atol=1e-5)


def test_omp__a_patch_does_not_depend_on_its_neighbours():
    rng = np.random.default_rng(8)
    atoms, patches = unit_rows(rng, 64, 192), smooth_patches(rng, 40)
    together = sparse_encode(patches, atoms, max_atoms=5)
    alone = [sparse_encode(patches[i : i + 1], atoms, max_atoms=5) for i in range(40)]
    assert (together.atom_index == np.concatenate([a.atom_index for a in alone])).all()


def test_omp__quantised_weights_are_levels_of_their_rank():
    rng = np.random.default_rng(9)
    atoms, patches = unit_rows(rng, 64, 192), smooth_patches(rng, 100)
    levels = np.sort(rng.uniform(-2, 2, (8, 16)), axis=1).astype(np.float32)
    codes, weight_code, _ = pursue_patches(patches, atoms, max_atoms=8, weight_levels=levels)
    for rank in range(8):
        used = codes.n_atoms > rank
        assert (codes.weight[used, rank] == levels[rank][weight_code[used, rank]]).all()


def test_omp__quantising_in_the_loop_beats_rounding_afterwards():
    rng = np.random.default_rng(10)
    atoms, patches = smooth_patches(rng, 64), smooth_patches(rng, 300)
    atoms /= np.linalg.norm(atoms, axis=1, keepdims=True)
    levels = np.tile(np.linspace(-3, 3, 16), (8, 1))
    in_loop = pursue_patches(patches, atoms, max_atoms=8, weight_levels=levels).residual.sum()
    exact = sparse_encode(patches, atoms, max_atoms=8)
    nearest = np.abs(levels[0] - exact.weight[..., None]).argmin(axis=2)
    rounded = exact._replace(weight=levels[0][nearest].astype(np.float32))
    after = ((patches - reconstruct(rounded, atoms)) ** 2).sum()
    assert in_loop < 0.5 * after


@pytest.mark.parametrize("patch", [np.zeros(192), np.full(192, 1e-20)], ids=["zero", "denormal square"])
def test_omp__a_patch_of_nothing_needs_no_atom(patch):
    atoms = unit_rows(np.random.default_rng(0), 16, 192)
    found = pursue_patches(patch[None], atoms, max_atoms=8)
    codes, residual = found.codes, found.residual
    assert np.isfinite(codes.weight).all() and np.isfinite(residual).all()
    assert codes.n_atoms[0] == 0 or patch.any()


def test_omp__takes_read_only_strided_float64_and_empty_input():
    rng = np.random.default_rng(11)
    atoms, patches = unit_rows(rng, 16, 64), smooth_patches(rng, 20, 64)
    plain = sparse_encode(patches, atoms, max_atoms=3)
    wide = np.zeros((40, 128))
    wide[::2, ::2] = patches
    strided = wide[::2, ::2]
    strided.flags.writeable = False
    atoms.flags.writeable = False
    assert (sparse_encode(strided, atoms, max_atoms=3).atom_index == plain.atom_index).all()
    assert sparse_encode(patches[:0], atoms, max_atoms=3).atom_index.shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p, a: (p, a, 17), "max_atoms is 17; the dictionary allows 1 to 16"),
        (lambda p, a: (p, a * 1.1, 3), "must be a unit vector"),
        (lambda p, a: (p[:, 1:], a, 3), r"must be \(n, d\) and \(k, d\)"),
        (lambda p, a: (np.where(np.arange(len(p))[:, None] == 7, np.nan, p), a, 3), "patch 7 is not finite"),
    ],
)
def test_omp__says_what_is_wrong_with_its_input(change, words):
    rng = np.random.default_rng(12)
    patches, atoms, most = change(smooth_patches(rng, 20, 64), unit_rows(rng, 16, 64))
    with pytest.raises(ValueError, match=words):
        sparse_encode(patches, atoms, max_atoms=most)


def test_omp__patches_that_are_settled_leave_those_beside_them_as_they_are():
    """In every block of patches, the second and those after it too."""
    rng = np.random.default_rng(8)
    atoms = rng.standard_normal((40, 24))
    atoms /= np.linalg.norm(atoms, axis=1, keepdims=True)
    patches = rng.standard_normal((1400, 24)) * (rng.random((1400, 1)) < 0.6)
    together = sparse_encode(patches, atoms, max_atoms=3)
    assert (together.n_atoms == 0).sum() == (patches == 0).all(axis=1).sum() > 400
    for start in range(0, 1400, 100):
        part = sparse_encode(patches[start : start + 100], atoms, max_atoms=3)
        rows = slice(start, start + 100)
        np.testing.assert_array_equal(together.atom_index[rows], part.atom_index)
        np.testing.assert_array_equal(together.n_atoms[rows], part.n_atoms)
        np.testing.assert_allclose(
            together.weight[rows], part.weight, rtol=2e-6
        )  # BLAS has other kernels for small products


@pytest.mark.parametrize("n_levels", [2, 3, 4, 16])
def test_omp__the_nearest_level_is_the_nearest_and_the_ends_are_reached(n_levels):
    levels = np.sort(np.random.default_rng(n_levels).uniform(-2, 2, n_levels))
    for value in np.concatenate([np.linspace(-3, 3, 200), levels]):
        assert nearest_level(levels, value) == np.abs(levels - value).argmin()


@pytest.mark.parametrize("dim", [1, 7, 8, 9, 23, 3072])
def test_omp__squared_norms_are_those_of_whole_rows(dim):
    rows = np.random.default_rng(dim).standard_normal((3, dim)).astype(np.float32)
    np.testing.assert_allclose(squared_norms(rows), (rows.astype(np.float64) ** 2).sum(axis=1), rtol=1e-12)
