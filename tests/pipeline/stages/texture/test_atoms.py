"""How the atoms of a stored dictionary are searched."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.search import choice
from pipeline.coding.search.choice import SEARCHES
from pipeline.coding.search.coarse import CoarseDictionary
from pipeline.coding.search.stepwise import StepwiseDictionary
from pipeline.stages.texture import atoms as module
from pipeline.stages.texture.atoms import load_atoms, store_atoms

N_ATOMS, DIM = 1200, 600


def few_components(n: int, rank: int = 40) -> np.ndarray:
    """Unit rows (n, DIM) in one space of `rank` dimensions."""
    rows = np.random.default_rng(n).standard_normal((n, rank)) @ np.random.default_rng(3).standard_normal((rank, DIM))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.fixture(params=[CoarseDictionary, StepwiseDictionary], ids=["gram", "in step"])
def split(request, tmp_path, monkeypatch):
    """As a dictionary with a Gram matrix is searched, and as one too large for it."""
    if request.param is StepwiseDictionary:
        for owner in (module, choice):
            monkeypatch.setattr(owner, "MOST_WITH_GRAM", N_ATOMS - 1)
    store_atoms(tmp_path, few_components(N_ATOMS).astype(np.float32))
    atoms = load_atoms(tmp_path)
    assert isinstance(atoms.searched, request.param)
    return atoms


def pursued(atoms, search: str):
    patches = (few_components(64) + 0.01 * np.random.default_rng(4).standard_normal((64, DIM))).astype(np.float32)
    return atoms.pursue(patches, 5, 1e-3, search=search)


def test_atoms__certified_search_takes_the_atoms_of_exact_search(split):
    exact, certified = (pursued(split, s) for s in ("exact", "certified"))
    assert exact.codes.n_atoms.mean() > 1
    assert (exact.codes.atom_index == certified.codes.atom_index).all()


@pytest.mark.parametrize("search", SEARCHES)
def test_atoms__each_search_is_the_one_that_is_asked_for(split, search, monkeypatch):
    asked, pursue = [], module.pursue_patches
    monkeypatch.setattr(module, "pursue_patches", lambda *a, **k: asked.append((k["search"], a[1])) or pursue(*a, **k))
    found = pursued(split, search)
    assert asked == [(search, split.searched)]
    assert found.residual.mean() < 0.5


def test_atoms__of_a_small_dictionary_every_search_is_exact(tmp_path):
    store_atoms(tmp_path, few_components(100).astype(np.float32))
    small = load_atoms(tmp_path)
    first, *others = (pursued(small, search) for search in SEARCHES)
    assert all((first.codes.atom_index == other.codes.atom_index).all() for other in others)
