"""Order-recursive pursuit with a beam: its twin that tries all atoms, SPAMS, and the same codes whatever the way to the
products."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.beam import by_steps
from pipeline.coding.beam.form import Beam, beam_of, canonical_pursuit
from pipeline.coding.grid import in_all_symmetries
from pipeline.coding.omp import pursue_patches, reconstruct, sparse_encode
from pipeline.coding.search.coarse import coarsen
from pipeline.coding.search.stepwise import unshortened
from pipeline.coding.search.symmetric import with_symmetries
from pipeline.coding.search.whole import WholeDictionary
from tests import reference_beam
from tests.pipeline.coding.test_omp import smooth_patches, unit_rows

BEAMS = ["ormp", "1x4", "2x2", "4x4"]


def levels_of_ranks(rng: np.random.Generator, n: int = 12) -> np.ndarray:
    """Other levels for every rank."""
    return np.sort(rng.uniform(-2.5, 2.5, (8, n)), axis=1)


def alike_atoms(rng: np.random.Generator, n: int, d: int = 48) -> np.ndarray:
    """Atoms of a coherence at which OMP chooses badly."""
    atoms = rng.standard_normal((n, d)) + 1.5 * rng.standard_normal((n // 4, d)).repeat(4, axis=0)
    return (atoms / np.linalg.norm(atoms, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("quantised", [False, True], ids=["exact weights", "levels"])
@pytest.mark.parametrize("pursuit", BEAMS)
def test_beam__agrees_with_the_twin_that_tries_every_atom(pursuit, quantised):
    rng = np.random.default_rng(1)
    atoms, patches = alike_atoms(rng, 32), smooth_patches(rng, 25, 48) * rng.uniform(0.2, 3, (25, 1))
    levels = levels_of_ranks(rng) if quantised else None
    found = pursue_patches(
        patches, atoms, max_atoms=5, tolerance=0.02, multiplier=0.004, weight_levels=levels, pursuit=pursuit
    )
    beam, differ = beam_of(pursuit), 0
    for i, patch in enumerate(patches):
        support, weight, path = reference_beam.beam(patch, atoms, 5, beam.width, beam.candidates, 0.02, 0.004, levels)
        n = found.codes.n_atoms[i]
        assert n == len(support)
        np.testing.assert_allclose(found.path[i, : n + 1], path, rtol=1e-4, atol=2e-6)
        chosen = found.codes.atom_index[i, :n].tolist()
        # a support found in two orders leaves the same: either order of a beam will do
        differ += sorted(chosen) != sorted(support) if beam.width > 1 else chosen != support
        if chosen == support:
            np.testing.assert_allclose(found.codes.weight[i, :n], weight, atol=2e-4)
    assert not differ
    assert found.codes.n_atoms.min() < 5 and found.codes.n_atoms.max() == 5


@pytest.mark.parametrize("levels", [None, levels_of_ranks(np.random.default_rng(0))], ids=["exact weights", "levels"])
@pytest.mark.parametrize("pursuit", [*BEAMS, "16x3"])
def test_beam__takes_the_same_atoms_whatever_the_way_to_the_products(pursuit, levels):
    rng = np.random.default_rng(2)
    atoms, patches = alike_atoms(rng, 256, 192), smooth_patches(rng, 300)
    most = 8 if levels is not None else 11
    options = {"max_atoms": most, "weight_levels": levels, "pursuit": pursuit, "multiplier": 1e-4}
    whole = pursue_patches(patches, WholeDictionary(atoms, atoms @ atoms.T), **options)
    split = coarsen(atoms, 48)
    for other in (
        pursue_patches(patches, unshortened(atoms), **options),
        pursue_patches(patches, split, search="certified", **options),
        pursue_patches(patches, split, search="exact", **options),
    ):
        assert (other.codes.atom_index == whole.codes.atom_index).all(axis=1).mean() > 0.98
        np.testing.assert_allclose(other.path, whole.path, rtol=1e-3, atol=1e-5)
    loose = pursue_patches(patches, split, search="approximate", **options)
    assert whole.residual.sum() < loose.residual.sum() < 1.2 * whole.residual.sum()


@pytest.mark.parametrize("with_gram", [True, False])
@pytest.mark.parametrize("pursuit", ["ormp", "2x2"])
def test_beam__takes_atoms_in_turns_as_the_dictionary_written_out(pursuit, with_gram):
    rng = np.random.default_rng(3)
    straight, patches = unit_rows(rng, 20, 192), smooth_patches(rng, 150) * 4
    turned = in_all_symmetries(straight, 8)
    made = with_symmetries(straight, 8, turned, with_gram)
    options = {"max_atoms": 6, "weight_levels": levels_of_ranks(rng), "pursuit": pursuit}
    found = pursue_patches(patches, made if with_gram else unshortened(turned, made), **options)
    plain = pursue_patches(patches, turned, **options)
    assert found.codes.n_atoms.mean() > 2
    assert (found.codes.atom_index == plain.codes.atom_index).all(axis=1).mean() > 0.98
    assert found.residual.sum() == pytest.approx(plain.residual.sum(), rel=1e-4)


@pytest.mark.parametrize("n_atoms", [2, 4, 8])
@pytest.mark.parametrize("kind", ["random", "alike", "patches"])
def test_beam__order_recursive_pursuit_leaves_what_spams_leaves(kind, n_atoms):
    spams = pytest.importorskip("spams", reason="pip install spams-bin")
    rng = np.random.default_rng(4)
    atoms = {
        "random": unit_rows(rng, 256, 192),
        "alike": alike_atoms(rng, 256, 192),
        "patches": smooth_patches(rng, 256),
    }[kind]
    atoms = (atoms / np.linalg.norm(atoms, axis=1, keepdims=True)).astype(np.float32)
    patches = smooth_patches(rng, 400)
    theirs = spams.omp(np.asfortranarray(patches.T), np.asfortranarray(atoms.T), L=n_atoms, eps=0.0, numThreads=1)
    lost = ((patches - (atoms.T @ theirs.toarray()).T).astype(float) ** 2).sum()
    ours = pursue_patches(patches, atoms, max_atoms=n_atoms, pursuit="ormp").residual.sum()
    assert 10 * np.log10(ours / lost) < 0.01


def test_beam__what_it_reports_is_what_is_left_and_never_rises():
    rng = np.random.default_rng(5)
    atoms, patches = alike_atoms(rng, 64, 192), smooth_patches(rng, 100)
    for levels in (None, levels_of_ranks(rng)):
        for pursuit in BEAMS:
            found = pursue_patches(patches, atoms, max_atoms=8, weight_levels=levels, pursuit=pursuit)
            lost = ((patches - reconstruct(found.codes, atoms)).astype(np.float64) ** 2).sum(axis=1)
            np.testing.assert_allclose(found.residual, lost, rtol=1e-3, atol=1e-5)
            np.testing.assert_allclose(found.path[:, 0], (patches.astype(float) ** 2).sum(axis=1), rtol=1e-6)
            used = np.arange(8) < found.codes.n_atoms[:, None]
            assert (np.diff(found.path, axis=1)[used] < 0).all() and (found.path[:, 1:][~used] == 0).all()
            assert all(len(set(a[:n])) == n for a, n in zip(found.codes.atom_index, found.codes.n_atoms))
            if levels is not None:
                for rank in range(8):
                    at = used[:, rank]
                    assert (
                        found.codes.weight[at, rank] == levels[rank][found.weight_code[at, rank]].astype(np.float32)
                    ).all()


@pytest.mark.parametrize("pursuit", BEAMS)
def test_beam__a_pursuit_of_fewer_atoms_is_the_beginning_of_one_of_more(pursuit):
    """So multipliers above the one that was searched with are told from its path."""
    rng = np.random.default_rng(6)
    atoms, patches = alike_atoms(rng, 64, 192), smooth_patches(rng, 100)
    options = {"weight_levels": levels_of_ranks(rng), "pursuit": pursuit}
    whole = pursue_patches(patches, atoms, max_atoms=8, multiplier=1e-3, **options)
    for n in (1, 3, 6):
        part = pursue_patches(patches, atoms, max_atoms=n, multiplier=1e-3, **options)
        taken = np.minimum(whole.codes.n_atoms, n)
        assert (part.codes.n_atoms == taken).all()
        np.testing.assert_allclose(part.residual, whole.path[np.arange(100), taken], rtol=1e-6)
    for multiplier in (2e-3, 1e-2):
        dearer = pursue_patches(patches, atoms, max_atoms=8, multiplier=multiplier, **options)
        agreed = dearer.codes.n_atoms == whole.atoms_at(multiplier)
        assert agreed.mean() > (0.999 if pursuit == "ormp" else 0.9)  # where a beam then has other nodes, it may go on


def test_beam__the_wider_the_less_is_left():
    rng = np.random.default_rng(7)
    atoms, patches, levels = alike_atoms(rng, 256, 192), smooth_patches(rng, 300), levels_of_ranks(rng)
    for options in ({}, {"weight_levels": levels}):
        lost = [
            pursue_patches(patches, atoms, max_atoms=6, pursuit=pursuit, **options).residual.sum()
            for pursuit in ("omp", "2x2", "4x4", "8x4")
        ]
        assert (np.diff(lost) < -0.001 * lost[0]).all()
    one, four = (pursue_patches(patches, atoms, max_atoms=6, pursuit=p, weight_levels=levels) for p in ("ormp", "1x4"))
    assert four.residual.sum() < 0.995 * one.residual.sum()


def test_beam__with_exact_weights_more_candidates_of_one_support_change_nothing():
    rng = np.random.default_rng(8)
    atoms, patches = alike_atoms(rng, 64, 192), smooth_patches(rng, 100)
    one, four = (sparse_encode(patches, atoms, max_atoms=6, pursuit=p) for p in ("ormp", "1x4"))
    assert (one.atom_index == four.atom_index).all()


def test_beam__stops_at_the_tolerance_and_where_an_atom_is_not_worth_its_price():
    rng = np.random.default_rng(9)
    atoms, patches = alike_atoms(rng, 96, 192), smooth_patches(rng, 200)
    codes, _, path = pursue_patches(patches, atoms, max_atoms=8, tolerance=0.1, pursuit="2x2")
    rows = np.arange(200)
    assert (path[rows, codes.n_atoms][codes.n_atoms < 8] <= 0.1).all()
    assert (path[rows, np.maximum(codes.n_atoms - 1, 0)][codes.n_atoms > 0] > 0.1).all()
    found = pursue_patches(patches, atoms, max_atoms=8, multiplier=0.02, pursuit="2x2")
    falls = -np.diff(found.path, axis=1)[np.arange(8) < found.codes.n_atoms[:, None]]
    assert falls.min() > 0.02 and 0 < found.codes.n_atoms.mean() < 8


def test_beam__a_patch_does_not_depend_on_its_neighbours_nor_on_threads():
    rng = np.random.default_rng(10)
    atoms, patches = alike_atoms(rng, 64, 192), smooth_patches(rng, 1100)
    options = {"max_atoms": 5, "weight_levels": levels_of_ranks(rng), "pursuit": "4x4"}
    together = sparse_encode(patches, atoms, n_threads=1, **options)
    beside = sparse_encode(patches, atoms, n_threads=4, **options)
    alone = [sparse_encode(patches[i : i + 1], atoms, **options) for i in range(510, 530)]
    assert (together.atom_index == beside.atom_index).all() and (together.weight == beside.weight).all()
    assert (together.atom_index[510:530] == np.concatenate([a.atom_index for a in alone])).all()


def test_beam__without_a_gram_matrix_memory_is_the_same_for_any_number_of_atoms():
    for n_dictionary in (1 << 15, 1 << 17, 1 << 19):
        for width in (1, 4, 16):
            rows = by_steps.rows_at_a_time(n_dictionary, width)
            held = 4 * n_dictionary * rows * (1 + 5 * width)
            assert rows == 1 or by_steps.MOST_BYTES / 2 < held <= by_steps.MOST_BYTES or rows == 512
    assert by_steps.rows_at_a_time(1 << 16, 2) > 16


def test_beam__words_for_a_pursuit():
    assert beam_of("omp") is None and beam_of("ormp") == beam_of("1x1") == Beam(1, 1) and beam_of("16x3") == Beam(16, 3)
    assert [canonical_pursuit(word) for word in ("omp", "1x1", "ormp", "04x2")] == ["omp", "ormp", "ormp", "4x2"]
    for word in ("", "0x2", "2x0", "17x1", "1x17", "2", "2x2x2", "-1x2", "OMP", "100x1"):
        with pytest.raises(ValueError, match="allowed: omp, ormp, or a beam WxC"):
            beam_of(word)
        with pytest.raises(ValueError, match="allowed: omp, ormp"):
            sparse_encode(np.zeros((1, 4)), np.eye(4, dtype=np.float32), max_atoms=1, pursuit=word)
