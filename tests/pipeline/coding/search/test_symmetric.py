"""Products with atoms in all turns are those with the atoms that `in_all_symmetries` makes, and so is the pursuit."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.coding.grid import in_all_symmetries
from pipeline.coding.omp import pursue_patches
from pipeline.coding.search.symmetric import quotients, with_symmetries
from tests.pipeline.coding.test_omp import unit_rows


@pytest.mark.parametrize("size", [8, 16, 32])
def test_symmetric__products_are_those_of_every_turn(size):
    rng = np.random.default_rng(size)
    straight, patches = unit_rows(rng, 20, 3 * size**2), rng.standard_normal((33, 3 * size**2)).astype(np.float32)
    made, expected = with_symmetries(straight, size), patches @ in_all_symmetries(straight, size).T
    np.testing.assert_allclose(made.products_in_order(patches), expected, atol=2e-5 * size)
    product = made.products(patches)
    np.testing.assert_allclose(product, expected[:, made.numbers(np.arange(160))], atol=2e-5 * size)


def test_symmetric__an_eighth_of_the_gram_matrix_tells_the_rest():
    straight = unit_rows(np.random.default_rng(1), 20, 192)
    turned = in_all_symmetries(straight, 8)
    made = with_symmetries(straight, 8, turned)
    assert made.gram.shape == (20, 160)
    order = made.numbers(np.arange(160))
    turn, atom = np.divmod(np.arange(160), 20)
    told = made.gram[atom[:, None], quotients()[turn[:, None], turn] * 20 + atom]
    np.testing.assert_allclose(told, (turned @ turned.T)[order][:, order], atol=1e-5)
    assert with_symmetries(straight, 8, turned, with_gram=False).gram.shape == (0, 0)


@pytest.mark.parametrize("search", ["exact", "certified", "approximate"])
def test_symmetric__pursuit_is_that_of_the_dictionary_written_out(search):
    rng = np.random.default_rng(2)
    straight, patches = unit_rows(rng, 40, 192), rng.standard_normal((200, 192)).astype(np.float32)
    options = {
        "max_atoms": 6,
        "tolerance": 120.0,
        "weight_levels": np.tile(np.linspace(-8, 8, 64), (6, 1)),
        "search": search,
    }
    found = pursue_patches(patches, with_symmetries(straight, 8), **options)
    plain = pursue_patches(patches, in_all_symmetries(straight, 8), **options)
    assert 1 < found.codes.n_atoms.mean() < 6
    assert (found.codes.atom_index == plain.codes.atom_index).all(axis=1).mean() > 0.98
    assert found.residual.sum() == pytest.approx(plain.residual.sum(), rel=1e-3)
