"""Coefficients, interpolation and turns, against texels looked up one by one."""

import numpy as np
import pytest

from pipeline.coding import grid
from pipeline.texture.resample import PATCH_DIM
from storage.packed.schema import ATOM_SIZES

SIZES = pytest.mark.parametrize("size", ATOM_SIZES)


def some_texels(size: int, n: int = 5) -> np.ndarray:
    return np.random.default_rng(size).standard_normal((n, 3 * size * size)).astype(np.float32)


def looked_up(atom: np.ndarray, x: float, y: float) -> np.ndarray:
    """The bilinear lookup of an atom (s, s, 3) at (x, y) in [-1, 1], as a GPU does it: edges repeated."""
    size = len(atom)
    column, row = (float(np.clip((at + 1) / 2 * size - 0.5, 0, size - 1)) for at in (x, y))
    left, top = min(int(column), size - 2), min(int(row), size - 2)
    fx, fy = column - left, row - top
    upper = (1 - fx) * atom[top, left] + fx * atom[top, left + 1]
    lower = (1 - fx) * atom[top + 1, left] + fx * atom[top + 1, left + 1]
    return (1 - fy) * upper + fy * lower


@SIZES
def test_grid__shown_is_the_bilinear_lookup_of_every_texel(size):
    texels = some_texels(size, 1)
    patch = grid.shown(texels, size).reshape(32, 32, 3)
    at = (np.arange(32) + 0.5) / 16 - 1
    expected = [[looked_up(texels.reshape(size, size, 3).astype(np.float64), x, y) for x in at] for y in at]
    np.testing.assert_allclose(patch, expected, atol=1e-6)


@SIZES
def test_grid__coefficients_keep_norms_and_products_of_what_is_shown(size):
    texels = some_texels(size)
    patches = grid.shown(texels, size)
    found = grid.coefficients(patches, size)
    np.testing.assert_allclose(found @ found.T, patches @ patches.T, rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(found, grid.coefficients_of_texels(texels, size), atol=1e-4)
    np.testing.assert_allclose(grid.patches_of(found, size), patches, atol=1e-4)


@SIZES
def test_grid__texels_come_back_from_coefficients(size):
    texels = some_texels(size)
    back = grid.texels_of(grid.coefficients_of_texels(texels, size), size)
    np.testing.assert_allclose(back, texels, atol=1e-4)


@SIZES
def test_grid__what_no_atom_shows_is_orthogonal_to_the_coefficients(size):
    patches = np.random.default_rng(3).standard_normal((4, PATCH_DIM)).astype(np.float32)
    found = grid.coefficients(patches, size)
    best = grid.shown(grid.texels_of(found, size), size)
    np.testing.assert_allclose((best * (patches - best)).sum(axis=1), 0, atol=2e-2)
    np.testing.assert_allclose((found**2).sum(axis=1), (best**2).sum(axis=1), rtol=1e-4)


@SIZES
@pytest.mark.parametrize("turn", range(grid.SYMMETRIES))
def test_grid__turned_coefficients_are_those_of_turned_texels(size, turn):
    texels = some_texels(size)
    turned = grid.transformed_texels(texels.reshape(-1, size, size, 3), turn).reshape(len(texels), -1)
    rows = grid.in_all_symmetries(grid.coefficients_of_texels(texels, size), size)[turn :: grid.SYMMETRIES]
    np.testing.assert_allclose(rows, grid.coefficients_of_texels(turned, size), atol=1e-4)


def test_grid__turns_are_all_different_and_none_changes_a_norm():
    rows = grid.in_all_symmetries(some_texels(8, 1), 8)
    np.testing.assert_allclose((rows**2).sum(axis=1), (rows[0] ** 2).sum(), rtol=1e-6)
    products = rows @ rows.T - np.diag((rows**2).sum(axis=1))
    assert np.abs(products).max() < 0.5 * (rows[0] ** 2).sum()


def test_grid__turned_back_is_the_transpose_of_all_turns():
    atoms, rows = some_texels(8, 3), some_texels(8, 24)
    forward = (grid.in_all_symmetries(atoms, 8) * rows).sum()
    back = (atoms * grid.summed_back(rows, 8)).sum()
    assert forward == pytest.approx(back, rel=1e-4)
