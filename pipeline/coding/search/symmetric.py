"""Atoms in the eight symmetries of the square (the group D4): products with patches for a quarter of the
multiplications.

In coefficients (`grid`) a mirrored atom has the signs of its odd ones changed. So the products with an atom in its four
mirrors are sums and differences of four partial products, of the coefficients that are even or odd along either
axis; those with the four symmetries that exchange its axes are the same of the patch with its axes exchanged.

Symmetries are orthogonal: <turn(a, t), turn(b, s)> = <a, turn(b, s after the inverse of t)>. So an eighth of the Gram
matrix is enough, and the rest of it need not come out of memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from pipeline.coding.beam.form import Beam
from pipeline.coding.grid import SYMMETRIES, in_all_symmetries, transformed_texels
from pipeline.coding.search.by_gram import pursue_by_gram
from pipeline.coding.search.protocol import Found, Rules
from pipeline.execution.compiled import kernel

ROWS = 128  # patches at a time: their partial products and products stay in the second-level cache


@dataclass(frozen=True)
class SymmetricDictionary:
    """A dictionary in all symmetries, with what its products need."""

    # (8 k, 3 size^2) float32, unit rows, symmetry t of atom a in row 8 a + t; all below has it in t k + a
    dictionary: np.ndarray
    parts: tuple[np.ndarray, ...]  # of the straight atoms, by `_parities`: four of (k, 3 size^2 / 4) float32
    size: int
    gram: np.ndarray  # (k, 8 k) float32: straight atoms with all; (0, 0) where none is wanted

    @property
    def n_bytes(self) -> int:
        return self.dictionary.nbytes + self.gram.nbytes

    def exact(self) -> SymmetricDictionary:
        return self

    def rows_at_a_time(self, beam: Beam | None) -> int:
        return ROWS

    def pursue(self, patches: np.ndarray, energy: np.ndarray, rules: Rules, found: Found) -> None:
        product, spread = self.products(patches), np.zeros(len(patches), np.float32)
        rest = np.zeros(len(self.dictionary), np.float32)
        pursue_by_gram(patches, energy, self.dictionary, product, spread, rest, self.gram, quotients(), rules, found)
        found.atom[:] = self.numbers(found.atom)

    def numbers(self, found: np.ndarray) -> np.ndarray:
        """Columns of `products` as rows of `dictionary`."""
        k = len(self.parts[0])
        return found % k * SYMMETRIES + found // k

    def products(self, patches: np.ndarray) -> np.ndarray:
        """Correlations (n, 8 k) float32 of patches (n, 3 size^2)."""
        n = len(patches)
        both = np.empty((4, 2 * n, patches.shape[1] // 4), np.float32)
        _by_parity(patches, self.size, both)
        partial = np.empty((4, 2 * n, len(self.parts[0])), np.float32)
        for into, rows, part in zip(partial, both, self.parts):
            np.matmul(rows, part.T, out=into)
        product = np.empty((n, len(self.dictionary)), np.float32)
        _sums_and_differences(partial, product)
        return product

    def products_in_order(self, patches: np.ndarray) -> np.ndarray:
        """The correlations, in the order of `dictionary`."""
        product = self.products(patches)
        return np.ascontiguousarray(product.reshape(len(patches), SYMMETRIES, -1).swapaxes(1, 2)).reshape(product.shape)


def with_symmetries(
    straight: np.ndarray, size: int, dictionary: np.ndarray | None = None, with_gram: bool = True
) -> SymmetricDictionary:
    """Atoms (k, 3 size^2), coefficients, in all symmetries; `dictionary` is what `in_all_symmetries` makes of them,
    where it is at hand."""
    dictionary = in_all_symmetries(straight, size) if dictionary is None else dictionary
    parts = tuple(np.ascontiguousarray(straight[:, columns]) for columns in _parities(size))
    made = SymmetricDictionary(dictionary, parts, size, np.empty((0, 0), np.float32))
    if not with_gram:
        return made
    gram = np.empty((len(straight), len(dictionary)), np.float32)
    for start in range(0, len(straight), ROWS):
        gram[start : start + ROWS] = made.products(straight[start : start + ROWS])
    return SymmetricDictionary(dictionary, parts, size, gram)


@cache
def _parities(size: int) -> tuple[np.ndarray, ...]:
    """Which of 3 size^2 coefficients are even and odd along rows and columns: even even, even odd, odd even, odd
    odd."""
    odd = np.arange(size) % 2
    parity = np.repeat(2 * odd[:, None] + odd, 3)
    return tuple(np.flatnonzero(parity == p) for p in range(4))


@cache
def quotients() -> np.ndarray:
    """(8, 8) int64, q[t, s] with <turn(a, t), turn(b, s)> = <a, turn(b, q[t, s])>: s after the inverse of t."""
    marked = np.arange(9.0).reshape(3, 3, 1)
    seen = {transformed_texels(marked, turn).tobytes(): turn for turn in range(SYMMETRIES)}
    of = [
        [seen[transformed_texels(transformed_texels(marked, u), t).tobytes()] for u in range(SYMMETRIES)]
        for t in range(SYMMETRIES)
    ]  # first u, then t
    return np.argsort(of, axis=1)


@kernel()
def _by_parity(patches, size, both):
    """both (4, 2 n, 3 size^2 / 4): coefficients of patches (n, 3 size^2) by `_parities`, and of the patches with their
    axes exchanged."""
    n, half = patches.shape[0], size // 2
    for i in range(n):
        for row in range(size):
            for column in range(size):
                straight, exchanged = 2 * (row % 2) + column % 2, 2 * (column % 2) + row % 2
                at, to = (row // 2 * half + column // 2) * 3, (column // 2 * half + row // 2) * 3
                for k in range(3):
                    value = patches[i, (row * size + column) * 3 + k]
                    both[straight, i, at + k] = value
                    both[exchanged, n + i, to + k] = value


@kernel(fastmath={"nnan", "nsz", "contract"})
def _sums_and_differences(partial, product):
    """product (n, 8 k) of partial (4, 2 n, k): rows of the patches, then rows of the patches with their axes
    exchanged."""
    n, k = product.shape[0], np.uintp(partial.shape[2])
    for i in range(n):
        for exchanged in range(2):
            row, at = i + exchanged * n, np.uintp(4 * exchanged) * k
            for a in range(k):
                even, odd = partial[0, row, a] + partial[1, row, a], partial[0, row, a] - partial[1, row, a]
                below, odd_below = partial[2, row, a] + partial[3, row, a], partial[2, row, a] - partial[3, row, a]
                product[i, at + a] = even + below
                product[i, at + k + a] = odd + odd_below
                product[i, at + np.uintp(2) * k + a] = even - below
                product[i, at + np.uintp(3) * k + a] = odd - odd_below
