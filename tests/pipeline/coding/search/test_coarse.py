"""Search by coarse products: the atoms of exact OMP, ties aside, whether they hold much of patches and atoms or
little."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.grid import axis_columns
from pipeline.coding.omp import pursue_patches, reconstruct, sparse_encode
from pipeline.coding.omp_kernels import squared_norms
from pipeline.coding.search import coarse
from pipeline.coding.search.coarse import FEWEST_ATOMS, PATCH_DIM, CoarseDictionary, coarsen
from tests.pipeline.coding.search.test_certified import assert_greedy, normalised

N_ATOMS, N_PATCHES, MOST = 150, 40, 8


def grainy(rng, n: int, grain: float) -> np.ndarray:
    """Five frequencies an axis, in all colours, and noise of a share of their norm."""
    low = axis_columns(coarse.SIZE)[:, :5]
    smooth = np.einsum("yp,xq,npqc->nyxc", low, low, 5 * rng.standard_normal((n, 5, 5, 3))).reshape(n, -1)
    noise = rng.standard_normal(smooth.shape)
    return (smooth + noise * grain * np.linalg.norm(smooth, axis=1, keepdims=True) / np.sqrt(PATCH_DIM)).astype(
        np.float32
    )


def smooth(rng):
    return grainy(rng, N_PATCHES, 0.0), normalised(grainy(rng, N_ATOMS, 0.0))


def learned(rng):
    return grainy(rng, N_PATCHES, 0.1), normalised(grainy(rng, N_ATOMS, 0.1))


def all_grain(rng):
    return rng.standard_normal((N_PATCHES, PATCH_DIM)).astype(np.float32), normalised(
        rng.standard_normal((N_ATOMS, PATCH_DIM))
    )


def twins_but_for_grain(rng):
    """Atoms in tens with the same coefficients: what sets them apart is grain."""
    atoms = np.repeat(normalised(grainy(rng, N_ATOMS // 10, 0.0)), 10, axis=0)
    atoms = normalised(atoms + 0.3 / np.sqrt(PATCH_DIM) * rng.standard_normal(atoms.shape))
    return (rng.standard_normal((N_PATCHES, 6)) @ atoms[rng.choice(N_ATOMS, 6)]).astype(np.float32), atoms


def of_any_scale(rng):
    patches, atoms = learned(rng)
    return (patches * 10.0 ** rng.uniform(-4, 4, (N_PATCHES, 1))).astype(np.float32), atoms


CASES = [smooth, learned, all_grain, twins_but_for_grain, of_any_scale]


def split_of(atoms, monkeypatch):
    monkeypatch.setattr(coarse, "MOST_REST", 2.0)
    return coarsen(atoms)


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_coarse__takes_the_atoms_of_exact_search(case, monkeypatch):
    patches, atoms = case(np.random.default_rng(0))
    found = pursue_patches(patches, split_of(atoms, monkeypatch), max_atoms=MOST, search="certified")
    exact = pursue_patches(patches, atoms, max_atoms=MOST, search="exact")
    assert_greedy(patches, atoms, found.codes)
    assert (found.codes.atom_index == exact.codes.atom_index).all(axis=1).mean() > 0.95
    assert found.residual.sum() == pytest.approx(exact.residual.sum(), rel=1e-4, abs=1e-6 * float((patches**2).sum()))
    lost = ((patches - reconstruct(found.codes, atoms)).astype(np.float64) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.residual, lost, rtol=1e-3, atol=1e-5 * (patches**2).sum(axis=1).max())


def test_coarse__products_are_no_further_off_than_they_say(monkeypatch):
    for case in CASES:
        patches, atoms = case(np.random.default_rng(1))
        split = split_of(atoms, monkeypatch)
        product, spread = split.products(patches, squared_norms(patches))
        off = np.abs(product - patches.astype(np.float64) @ atoms.T.astype(np.float64))
        assert (off <= spread[:, None] * split.rest).all(), case.__name__
    assert off.max() > 0  # of the last case: what is left of patches and atoms is felt


def test_coarse__cuts_off_prices_and_quantises_as_exact_search_does(monkeypatch):
    patches, atoms = learned(np.random.default_rng(2))
    levels = np.tile(np.linspace(-30, 30, 256), (MOST, 1))
    options = {"max_atoms": MOST, "tolerance": 1100.0, "multiplier": 30.0, "weight_levels": levels}
    found = pursue_patches(patches, split_of(atoms, monkeypatch), search="certified", **options)
    exact = pursue_patches(patches, atoms, search="exact", **options)
    assert len(set(exact.codes.n_atoms.tolist())) > 2
    assert (found.codes.n_atoms == exact.codes.n_atoms).mean() > 0.95
    same = (found.codes.atom_index == exact.codes.atom_index).all(axis=1)
    assert same.mean() > 0.95
    assert (found.weight_code[same] == exact.weight_code[same]).all()


def test_coarse__is_left_where_it_would_not_pay():
    rng = np.random.default_rng(3)
    _, atoms = learned(rng)
    assert coarsen(atoms) is not None
    assert coarsen(atoms[: FEWEST_ATOMS - 1]) is None
    assert coarsen(normalised(rng.standard_normal((N_ATOMS, 768)))) is None  # not whole patches
    assert coarsen(all_grain(rng)[1]) is None


def test_coarse__sparse_encode_takes_it_by_itself(monkeypatch):
    patches, atoms = learned(np.random.default_rng(4))
    asked, products = [], CoarseDictionary.products
    monkeypatch.setattr(CoarseDictionary, "products", lambda *a: asked.append(len(a[1])) or products(*a))
    certified = sparse_encode(patches, atoms, max_atoms=3, search="certified")
    assert sum(asked) == N_PATCHES
    exact = sparse_encode(patches, atoms, max_atoms=3)
    assert sum(asked) == N_PATCHES  # exact search is by whole products
    assert (certified.atom_index == exact.atom_index).all(axis=1).mean() > 0.95
