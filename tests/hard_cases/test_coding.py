"""Sparse coding of what breaks naive pursuit. Bounds as in docs/NUMERICS.md."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from pipeline.coding.omp import pursue_patches, reconstruct, sparse_encode
from tests import reference
from tests.pipeline.coding.test_omp import smooth_patches, unit_rows

DIM = 768
PURSUITS = ("omp", "ormp", "2x2", "4x4")
SCALES = (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)


def near_twins(rng: np.random.Generator, n: int, coherence_gap: float) -> np.ndarray:
    """n atoms and n more at coherence 1 - gap to them, (2 n, DIM) float32."""
    base, across = rng.standard_normal((2, n, DIM))
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    across -= (across * base).sum(axis=1, keepdims=True) * base
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    twin = (1 - coherence_gap) * base + np.sqrt(1 - (1 - coherence_gap) ** 2) * across
    return np.concatenate([base, twin]).astype(np.float32)


def differences_of_twins(rng: np.random.Generator, atoms: np.ndarray, n: int) -> np.ndarray:
    """Patches along the difference of two near-twins: what tempts a pursuit to take both, with huge weights."""
    first = rng.integers(0, len(atoms) // 2, n)
    difference = atoms[first].astype(float) - atoms[first + len(atoms) // 2]
    noise = rng.standard_normal((n, DIM))
    unit = [rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-30) for rows in (difference, noise)]
    return (unit[0] + 0.05 * unit[1]).astype(np.float32)


def exact_residuals(patches, atoms, codes) -> tuple[np.ndarray, np.ndarray]:
    """Residual norms in float64 of the weights found, and of the least squares on the same supports."""
    found, best = np.empty(len(patches)), np.empty(len(patches))
    for i, patch in enumerate(patches.astype(float)):
        n = codes.n_atoms[i]
        support = atoms[codes.atom_index[i, :n]].astype(float)
        found[i] = np.linalg.norm(patch - codes.weight[i, :n].astype(float) @ support)
        best[i] = np.linalg.norm(patch - reference.least_squares(patch, support) @ support)
    return found, best


# --- scale -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pursuit", PURSUITS)
@pytest.mark.parametrize("scale", SCALES)
def test_coding__scale_leaves_atoms_and_proportions_of_weights(scale, pursuit):
    rng = np.random.default_rng(1)
    atoms, patches = unit_rows(rng, 64, 192), smooth_patches(rng, 100)
    plain = sparse_encode(patches, atoms, max_atoms=6, tolerance=0.05, pursuit=pursuit)
    scaled = sparse_encode(patches * np.float32(scale), atoms, max_atoms=6, tolerance=0.05 * scale**2, pursuit=pursuit)
    assert (plain.n_atoms == scaled.n_atoms).all() and (plain.atom_index == scaled.atom_index).all()
    off = np.abs(scaled.weight / scale - plain.weight).max(axis=1)
    assert (off <= 1e-5 * np.abs(plain.weight).max(axis=1)).all()


def test_coding__scale_breaks_a_pursuit_with_an_absolute_threshold():
    rng = np.random.default_rng(1)
    atoms, patches = unit_rows(rng, 64, 192), smooth_patches(rng, 20)
    for patch in patches:
        assert len(reference.naive_omp(patch, atoms, 6)[0]) == 6
        assert len(reference.naive_omp(patch * np.float32(1e-6), atoms, 6)[0]) < 6


@pytest.mark.parametrize("pursuit", PURSUITS)
def test_coding__a_patch_of_1e_minus_22_is_coded_as_one_of_1(pursuit):
    """Squares of its correlations vanish in float32, not those in float64."""
    rng = np.random.default_rng(2)
    atoms, patches = unit_rows(rng, 64, 192), smooth_patches(rng, 50)
    plain = sparse_encode(patches, atoms, max_atoms=4, pursuit=pursuit)
    faint = (patches.astype(float) * 1e-22).astype(np.float32)
    tiny = sparse_encode(faint, atoms, max_atoms=4, pursuit=pursuit)
    correlation = faint @ atoms.T
    assert (
        (correlation**2).argmax(axis=1) != np.abs(correlation).argmax(axis=1)
    ).any()  # the naive way: float32 squares
    assert (plain.atom_index == tiny.atom_index).all()


# --- parallel atoms --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pursuit", PURSUITS)
@pytest.mark.parametrize("gap", [0.0, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
def test_coding__near_twins_are_within_1e_minus_4_of_least_squares(gap, pursuit):
    rng = np.random.default_rng(3)
    atoms = near_twins(rng, 20, gap)
    mixed = (rng.standard_normal((40, 40)) @ atoms + 0.01 * rng.standard_normal((40, DIM))).astype(np.float32)
    for patches in (mixed, differences_of_twins(rng, atoms, 60)):
        before = np.linalg.norm(patches.astype(float), axis=1)
        for most in (1, 2, 3, 5, 8):
            codes = sparse_encode(patches, atoms, max_atoms=most, pursuit=pursuit)
            assert np.isfinite(codes.weight).all()
            assert all(len(set(a[:n])) == n for a, n in zip(codes.atom_index, codes.n_atoms))
            found, best = exact_residuals(patches, atoms, codes)
            assert (found <= best * (1 + 1e-4)).all()
            assert (found <= before * (1 + 1e-7)).all()
            before = found


@pytest.mark.parametrize("gap", [0.0, 1e-7])
def test_coding__near_twins_break_a_pursuit_without_a_pivot_test(gap):
    rng = np.random.default_rng(3)
    atoms = near_twins(rng, 4, gap)
    patches = (rng.standard_normal((40, 8)) @ atoms + rng.standard_normal((40, DIM))).astype(np.float32)
    broken = 0
    for patch in patches:
        support, weight = reference.naive_cholesky_omp(patch, atoms, 8)
        best = reference.least_squares(patch, atoms[support]) @ atoms[support].astype(float)
        lost = np.linalg.norm(patch - weight @ atoms[support].astype(float))
        broken += not lost <= np.linalg.norm(patch - best) * (1 + 1e-4)  # NaN too
    found = sparse_encode(patches, atoms, max_atoms=8)
    assert np.abs(found.weight).max() < 10 * np.linalg.norm(patches, axis=1).max()
    assert broken > 0


@pytest.mark.parametrize("pursuit", PURSUITS)
def test_coding__copies_of_atoms_are_never_taken_twice(pursuit):
    rng = np.random.default_rng(4)
    atoms, patches = unit_rows(rng, 32, 192), smooth_patches(rng, 200)
    copies = np.concatenate([atoms, -atoms, atoms])
    found = pursue_patches(patches, copies, max_atoms=8, pursuit=pursuit)
    codes, residual = found.codes, found.residual
    assert all(len(set(a[:n] % 32)) == n for a, n in zip(codes.atom_index, codes.n_atoms))
    alone = pursue_patches(patches, atoms, max_atoms=8, pursuit=pursuit).residual
    # A beam follows a support and its copy for two where rounding chose another copy in each.
    np.testing.assert_allclose(residual, alone, rtol=1e-4 if pursuit in ("omp", "ormp") else 5e-3)
    assert residual.sum() == pytest.approx(alone.sum(), rel=2e-4)


@pytest.mark.parametrize("pursuit", PURSUITS)
def test_coding__a_dictionary_of_one_direction_gives_one_atom(pursuit):
    rng = np.random.default_rng(5)
    atoms = np.tile(unit_rows(rng, 1, 192), (16, 1))
    codes = sparse_encode(smooth_patches(rng, 30), atoms, max_atoms=8, pursuit=pursuit)
    assert (codes.n_atoms == 1).all() and (codes.atom_index[:, 0] == 0).all()
    support, weight = reference.naive_cholesky_omp(smooth_patches(rng, 1)[0], atoms, 8)
    assert len(support) > 1 and not np.abs(weight).max() < 100  # the naive way: the same atom again, or NaN


# --- hard patches ----------------------------------------------------------------------------------------------------


def hard_patches() -> dict[str, np.ndarray]:
    y, x = np.mgrid[:32, :32]
    rng = np.random.default_rng(6)
    return {
        "zero": np.zeros((32, 32, 3)),
        "constant": np.full((32, 32, 3), 0.37),
        "black": np.zeros((32, 32, 3)),
        "white": np.ones((32, 32, 3)),
        "impulse": ((x == 5) & (y == 9))[..., None] * np.ones(3),
        "checkerboard": ((x + y) % 2)[..., None] * np.ones(3),
        "half black, half white": (x < 16)[..., None] * np.ones(3),
        "contrast of 1e-3": 0.5 + 1e-3 * (rng.random((32, 32, 3)) - 0.5),
    }


@pytest.mark.parametrize("pursuit", PURSUITS)
@pytest.mark.parametrize("name", hard_patches())
def test_coding__hard_patches_are_no_worse_than_their_average(name, pursuit):
    """In bytes as the pipeline has them: the average costs at most half a level, and atoms only lower the error."""
    from pipeline.texture.patches import _measure, centred

    rng, dim = np.random.default_rng(7), 3072
    texel = np.round(hard_patches()[name] * 255).astype(np.uint8).reshape(1, -1)
    average, energy = np.empty((1, 3), np.float32), np.empty(1, np.float32)
    _measure(texel.reshape(1, -1, 3), average, energy)
    patch = centred(texel, np.round(average))
    atoms = np.concatenate([unit_rows(rng, 60, dim), unit_rows(rng, 4, 4).repeat(dim // 4, axis=1) / np.sqrt(dim // 4)])
    levels = np.tile(np.linspace(-20, 20, 16), (8, 1))
    deviation = texel.reshape(-1, 3) / 255.0 - (texel.reshape(-1, 3) / 255.0).mean(axis=0)
    for weight_levels in (None, levels):
        found = pursue_patches(
            patch, atoms.astype(np.float32), max_atoms=8, weight_levels=weight_levels, pursuit=pursuit
        )
        codes, residual = found.codes, found.residual
        decoded = reconstruct(codes, atoms.astype(np.float32))
        assert np.isfinite(decoded).all() and np.isfinite(residual).all()
        lost = float(((patch - decoded).astype(float) ** 2).sum())
        assert lost <= (deviation**2).sum() + dim * (0.5 / 255) ** 2 + 1e-6
        if energy[0] == 0:
            assert codes.n_atoms[0] == 0


def test_coding__an_impulse_of_one_texel_is_found_where_an_atom_has_it():
    atoms = np.eye(192, dtype=np.float32)
    patches = np.zeros((192, 192), np.float32)
    patches[np.arange(192), np.arange(192)] = 1e-3
    codes = sparse_encode(patches, atoms, max_atoms=4)
    assert (codes.n_atoms == 1).all() and (codes.atom_index[:, 0] == np.arange(192)).all()


@pytest.mark.parametrize("most", [0, 17, 10**6])
def test_coding__more_atoms_than_exist_or_none_is_an_error_that_says_so(most):
    rng = np.random.default_rng(9)
    with pytest.raises(ValueError, match=rf"max_atoms is {most}; the dictionary allows 1 to 16"):
        sparse_encode(smooth_patches(rng, 3, 64), unit_rows(rng, 16, 64), max_atoms=most)


@pytest.mark.parametrize("pursuit", PURSUITS)
def test_coding__all_atoms_of_the_dictionary_may_be_asked_for(pursuit):
    rng = np.random.default_rng(10)
    atoms = unit_rows(rng, 16, 64)
    patches = (rng.standard_normal((20, 16)) @ atoms).astype(np.float32)
    found = pursue_patches(patches, atoms, max_atoms=16, pursuit=pursuit)
    codes, residual = found.codes, found.residual
    assert (codes.n_atoms >= 15).all()
    assert (residual <= 1e-6 * (patches.astype(float) ** 2).sum(axis=1)).all()


@pytest.mark.parametrize("layout", ["read-only", "strided", "reversed", "float64", "fortran", "empty"])
def test_coding__every_layout_of_inputs_gives_the_same_codes(layout):
    rng = np.random.default_rng(11)
    atoms, patches = unit_rows(rng, 16, 64), smooth_patches(rng, 20, 64)
    plain = sparse_encode(patches, atoms, max_atoms=3)
    n = 0 if layout == "empty" else 20
    changed = {
        "read-only": patches.copy(),
        "strided": np.repeat(np.repeat(patches, 2, axis=0), 3, axis=1)[::2, ::3],
        "reversed": patches[::-1].copy()[::-1],
        "float64": patches.astype(float),
        "fortran": np.asfortranarray(patches),
        "empty": patches[:0],
    }[layout]
    changed.setflags(write=False)
    before = changed.copy()
    codes = sparse_encode(changed, np.asfortranarray(atoms), max_atoms=3)
    assert (codes.atom_index == plain.atom_index[:n]).all() and (codes.weight == plain.weight[:n]).all()
    assert (changed == before).all()


def test_coding__values_that_are_not_finite_are_refused():
    rng = np.random.default_rng(12)
    atoms, patches = unit_rows(rng, 16, 64), smooth_patches(rng, 600, 64)
    for value in (np.nan, np.inf, -np.inf):
        broken = patches.copy()
        broken[555, 3] = value
        with pytest.raises(ValueError, match="patch 555 is not finite"):
            sparse_encode(broken, atoms, max_atoms=3)
        with pytest.raises(ValueError, match="atom 0 has norm"):
            sparse_encode(patches, np.full_like(atoms, value), max_atoms=3)
        bad = np.float32(1.5) * atoms
        bad[7, 2] = value
        with pytest.raises(ValueError, match="atom 7 has norm"):  # not one that is merely too long
            sparse_encode(patches, bad, max_atoms=3)


@pytest.mark.parametrize("pursuit", PURSUITS)
def test_coding__levels_far_from_every_weight_end_the_pursuit_and_never_raise_the_error(pursuit):
    rng = np.random.default_rng(13)
    atoms, patches = unit_rows(rng, 32, 192), smooth_patches(rng, 100)
    for levels in (np.full((8, 16), 1e6), np.zeros((8, 16)), np.tile([-1e-9, 1e-9], (8, 1))):
        found = pursue_patches(patches, atoms, max_atoms=8, weight_levels=levels, pursuit=pursuit)
        residual = found.residual
        energy = (patches.astype(float) ** 2).sum(axis=1)
        assert np.isfinite(residual).all() and (residual <= energy * (1 + 1e-9)).all()
    exact = sparse_encode(patches, atoms, max_atoms=8, pursuit=pursuit)
    rounded = reference.nearest_weights(exact.weight[0], np.full((8, 16), 1e6)) @ atoms[exact.atom_index[0]]
    assert np.linalg.norm(patches[0] - rounded) > np.linalg.norm(
        patches[0]
    )  # the naive way: the nearest level, come what may


# --- the same without numba's compiler -------------------------------------------------------------------------------

_CODE = """
import sys, numpy as np
from pipeline.coding.omp import pursue_patches
from pipeline.coding.ksvd import learn_dictionary
rng = np.random.default_rng(0)
patches = np.cumsum(rng.standard_normal((60, 48)), axis=1).astype(np.float32) / 48
atoms = learn_dictionary(patches, 12, max_atoms=3, iterations=2)
levels = np.tile(np.linspace(-2, 2, 16), (8, 1))
for pursuit in ("omp", "ormp", "2x2", "4x4"):
    codes, weight_code, _ = pursue_patches(patches, atoms, max_atoms=4, tolerance=0.02, weight_levels=levels, pursuit=pursuit)
    print(codes.atom_index.tolist(), codes.n_atoms.tolist(), weight_code.tolist())
"""


def test_coding__takes_the_same_atoms_with_the_jit_off():
    printed = [
        subprocess.run(
            [sys.executable, "-c", _CODE],
            env={**os.environ, "NUMBA_DISABLE_JIT": off},
            check=True,
            capture_output=True,
            text=True,
            timeout=100,
        ).stdout
        for off in ("0", "1")
    ]
    assert printed[0] == printed[1] and len(printed[0]) > 500
