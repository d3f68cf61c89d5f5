"""Certified search: the atoms of exact OMP, ties aside, on patches that suit it and on those that do not."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from pipeline.coding.omp import pursue_patches, reconstruct, sparse_encode
from pipeline.coding.search import choice, stepwise
from pipeline.coding.search.coarse import coarsen
from pipeline.coding.search.stepwise import principal_components, shorten
from pipeline.texture.patches import centred
from pipeline.texture.resample import PATCH_DIM
from tests.pipeline.coding.test_omp import smooth_patches, unit_rows

DIM, N_ATOMS, MOST = 192, 300, 6


def normalised(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def near_twins(rng) -> tuple[np.ndarray, np.ndarray]:
    """Atoms in tens that differ by a thousandth, in directions outside the components as well."""
    atoms = np.repeat(smooth_patches(rng, N_ATOMS // 10), 10, axis=0)
    return smooth_patches(rng, 60), normalised(normalised(atoms) + 1e-4 * rng.standard_normal(atoms.shape))


def flat_spectrum(rng) -> tuple[np.ndarray, np.ndarray]:
    return rng.standard_normal((60, DIM)).astype(np.float32), unit_rows(rng, N_ATOMS, DIM)


def outside_the_components(rng) -> tuple[np.ndarray, np.ndarray]:
    """Most atoms are smooth; the patches are not, and what they call for is a few rough atoms."""
    atoms = np.concatenate([normalised(smooth_patches(rng, N_ATOMS - 20)), unit_rows(rng, 20, DIM)])
    return (rng.standard_normal((60, 20)) @ atoms[-20:]).astype(np.float32), atoms


def all_equal_but_scale(rng) -> tuple[np.ndarray, np.ndarray]:
    patches, atoms = smooth_patches(rng, 6), normalised(smooth_patches(rng, N_ATOMS))
    return (patches[np.arange(60) % 6] * 10.0 ** rng.uniform(-4, 4, (60, 1))).astype(np.float32), atoms


def learned(rng) -> tuple[np.ndarray, np.ndarray]:
    patches = smooth_patches(rng, 60 + N_ATOMS)
    return patches[:60], normalised(patches[60:])


CASES = [near_twins, flat_spectrum, outside_the_components, all_equal_but_scale, learned]


def assert_greedy(patches, atoms, codes, most_loss: float = 1e-5) -> None:
    """Each atom in turn has the largest correlation with the float64 residual of those before it, but for ties."""
    wide, patches = atoms.astype(np.float64), patches.astype(np.float64)
    for patch, support, n in zip(patches, codes.atom_index, codes.n_atoms):
        residual = patch
        for t in range(n):
            size = np.abs(wide @ residual)
            size[support[:t]] = 0
            assert size[support[t]] >= size.max() - most_loss * np.linalg.norm(patch)
            kept = wide[support[: t + 1]]
            residual = patch - np.linalg.lstsq(kept.T, patch, rcond=None)[0] @ kept


both_ways = pytest.mark.parametrize("split_by", [coarsen, shorten], ids=["gram", "in step"])


@both_ways
@pytest.mark.parametrize("case", CASES, ids=lambda c: c.__name__)
def test_certified__takes_the_atoms_of_the_float64_twin(case, split_by):
    patches, atoms = case(np.random.default_rng(0))
    found = pursue_patches(patches, split_by(atoms, components=12), max_atoms=MOST, search="certified")
    exact = pursue_patches(patches, atoms, max_atoms=MOST)
    assert_greedy(patches, atoms, found.codes)
    assert found.residual.sum() == pytest.approx(exact.residual.sum(), rel=1e-3)
    lost = ((patches - reconstruct(found.codes, atoms)).astype(np.float64) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.residual, lost, rtol=1e-3, atol=1e-5 * (patches**2).sum(axis=1).max())


@both_ways
@pytest.mark.parametrize("case", CASES[1:], ids=lambda c: c.__name__)
def test_certified__takes_the_supports_of_exact_search_where_no_atoms_are_twins(case, split_by):
    patches, atoms = case(np.random.default_rng(1))
    split = split_by(atoms, components=12)
    found, exact = (
        pursue_patches(patches, d, max_atoms=MOST, search=s).codes for d, s in ((split, "certified"), (atoms, "exact"))
    )
    assert (found.atom_index == exact.atom_index).all(axis=1).mean() > 0.98
    assert (found.n_atoms == exact.n_atoms).all()


@both_ways
@pytest.mark.parametrize("quantised", [False, True], ids=["exact weights", "quantised"])
def test_certified__cuts_off_and_quantises_as_exact_search_does(quantised, split_by):
    patches, atoms = learned(np.random.default_rng(2))
    levels = np.tile(np.linspace(-3, 3, 64), (MOST, 1)) if quantised else None
    options = {"max_atoms": MOST, "tolerance": 0.02, "weight_levels": levels}
    found = pursue_patches(patches, split_by(atoms, components=12), search="certified", **options)
    exact = pursue_patches(patches, atoms, **options)
    assert len(set(exact.codes.n_atoms.tolist())) > 3
    assert (found.codes.n_atoms == exact.codes.n_atoms).mean() > 0.98
    same = (found.codes.atom_index == exact.codes.atom_index).all(axis=1)
    assert same.mean() > 0.98
    assert (found.weight_code[same] == exact.weight_code[same]).mean() > 0.99
    if quantised:
        for rank in range(MOST):
            used = found.codes.n_atoms > rank
            assert (
                found.codes.weight[used, rank] == levels[rank][found.weight_code[used, rank]].astype(np.float32)
            ).all()


def test_certified__settles_few_atoms_of_smooth_patches():
    rng = np.random.default_rng(3)
    patches, atoms = learned(rng)
    split = shorten(atoms, components=32)
    n, most = len(patches), 4
    weight, path = np.zeros((n, most)), np.zeros((n, most + 1))
    energy = (patches.astype(np.float64) ** 2).sum(axis=1)
    n_settled = stepwise.pursue_rows(
        patches,
        energy,
        split,
        True,
        np.zeros(n),
        0.0,
        np.empty((0, 0)),
        np.zeros((n, most), np.int32),
        weight,
        np.zeros((n, most), np.int32),
        np.zeros(n, np.int32),
        path,
    )
    assert n * most <= n_settled < 0.1 * n * most * N_ATOMS


@both_ways
def test_certified__approximate_search_loses_little_and_says_its_residual(split_by):
    patches, atoms = learned(np.random.default_rng(4))
    found, certain = (
        pursue_patches(patches, split_by(atoms, components=24), max_atoms=MOST, search=s)
        for s in ("approximate", "certified")
    )
    assert (found.codes.atom_index != certain.codes.atom_index).any()
    exact = pursue_patches(patches, atoms, max_atoms=MOST)
    assert found.residual.sum() < 1.05 * exact.residual.sum()
    lost = ((patches - reconstruct(found.codes, atoms)).astype(np.float64) ** 2).sum(axis=1)
    np.testing.assert_allclose(found.residual, lost, rtol=1e-3, atol=1e-5)


def test_certified__recovers_through_atoms_in_the_span_of_the_support():
    rng = np.random.default_rng(5)
    atoms = unit_rows(rng, 20, DIM)
    twice = np.concatenate([atoms, atoms, -atoms])
    found = sparse_encode(smooth_patches(rng, 50), twice, max_atoms=8, search="certified")
    split = [
        pursue_patches(smooth_patches(rng, 50), by(twice, components=8), max_atoms=8, search="certified").codes
        for by in (coarsen, shorten)
    ]
    for codes in (found, *split):
        assert all(len(set(a[:n] % 20)) == n for a, n in zip(codes.atom_index, codes.n_atoms))


@both_ways
def test_certified__a_patch_depends_on_neither_neighbours_nor_threads(split_by):
    patches, atoms = learned(np.random.default_rng(6))
    split = split_by(atoms, components=12)
    patches = np.tile(patches, (20, 1))
    alone, threads = (pursue_patches(patches, split, max_atoms=MOST, search="certified", n_threads=n) for n in (1, 3))
    for a, b in zip((*alone.codes, alone.residual), (*threads.codes, threads.residual)):
        assert (a == b).all()


def test_certified__of_real_patches_is_exact():
    """Patches as the pipeline stores them: a photograph's, resampled."""
    from skimage import data

    photo = data.astronaut()
    rng = np.random.default_rng(7)
    at = rng.integers(0, 512 - 32, (1300, 2))
    texel = np.stack([photo[y : y + 32, x : x + 32].reshape(-1) for y, x in at])
    patches = centred(texel, texel.reshape(-1, 1024, 3).mean(axis=1).round().astype(np.uint8))
    patches = patches[(patches**2).sum(axis=1) > 1e-3]
    atoms = normalised(patches[20:])
    assert shorten(atoms) is None  # patches themselves lie in no few components: it is exact, but does not pay
    split = shorten(atoms, stepwise.COMPONENTS)
    assert split.short.shape == (len(atoms), stepwise.COMPONENTS) and patches.shape[1] == PATCH_DIM
    codes = pursue_patches(patches[:20], split, max_atoms=8, search="certified").codes
    assert_greedy(patches[:20], atoms, codes)


def test_certified__basis_is_orthonormal_and_holds_what_svd_says():
    rows = smooth_patches(np.random.default_rng(8), 400)
    basis = principal_components(rows, 16)
    np.testing.assert_allclose(basis.T @ basis, np.eye(16), atol=1e-6)
    best = np.linalg.svd(rows, compute_uv=False)[16:] @ np.linalg.svd(rows, compute_uv=False)[16:]
    assert ((rows - rows @ basis @ basis.T) ** 2).sum() < 1.02 * best


def test_certified__a_dictionary_without_few_components_is_searched_exactly():
    rng = np.random.default_rng(9)
    assert shorten(unit_rows(rng, 2048, 1024)) is None and coarsen(unit_rows(rng, 2048, 1024)) is None
    assert coarsen(unit_rows(rng, 100, 1024)) is None
    assert shorten(normalised(smooth_patches(rng, 300, 192))) is None


@pytest.mark.parametrize("search", ["exact", "certified", "approximate"])
def test_certified__large_dictionaries_are_coded_without_a_gram_matrix(search, monkeypatch):
    monkeypatch.setattr(choice, "MOST_WITH_GRAM", 4096)
    rng = np.random.default_rng(10)
    atoms = normalised(smooth_patches(rng, 4100, 768))
    patches = smooth_patches(rng, 8, 768)
    sparse_encode(patches, atoms, max_atoms=3, search=search, n_threads=1)
    tracemalloc.start()
    codes = sparse_encode(patches, atoms, max_atoms=3, search=search, n_threads=1)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * 4100**2 / 2
    if search != "approximate":
        assert_greedy(patches, atoms, codes)


def test_certified__says_which_searches_there_are():
    with pytest.raises(ValueError, match="search is 'best'; allowed: exact, certified, approximate"):
        sparse_encode(np.ones((1, 4)), np.eye(4), max_atoms=1, search="best")
