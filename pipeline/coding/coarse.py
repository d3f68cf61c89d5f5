"""Certified OMP of whole patches with few atoms: first products by the coarse coefficients in which the atoms are strong.

With some hundred atoms the products of patches with principal components would take as long as those with all atoms. What
12 x 12 texels show (`grid`) of a patch, its colours turned into one of light and two of difference, is found in an eighth of
that; the KEPT coefficients in which the dictionary has most are little more than a shorter product would be wide, and the
norms of what they leave of a patch and of an atom bound how far a product is off (Cauchy-Schwarz). The few atoms that may
be the best are settled at full width, once a patch: the Gram matrix, which is exact, takes a settled product from step to
step. With 256 atoms and 8 of them a patch, 10 are on `fountain_p11` and 12 on `monstree`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coding.certified_kernels import ENERGY_ROUNDING
from pipeline.coding.grid import axis_columns
from pipeline.coding.omp_kernels import NO_TURNS, squared_norms
from pipeline.texture.resample import PATCH_DIM
from pipeline.threads import one_blas_thread
from storage.schema import PATCH_SIZE

SIZE = 12  # with 8, monstree has 27 atoms settled; 16 cost more than they spare
KEPT = 128
FEWEST_ATOMS = 128  # below, all products of full width take no longer
# Share of a unit atom that may be left, in the median, above which too many products are settled to pay: of fountain_p11
# it is 0.05, of monstree 0.09.
MOST_REST = 0.2
REST_ROUNDING = 1e-3  # of a unit atom's rest; with ENERGY_ROUNDING of a patch's, their product is float32's rounding
ROWS = 128  # patches at a time: 64 cost a tenth more for calls, 512 as much for memory
COLOURS = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])  # orthonormal: light and two differences


@dataclass(frozen=True)
class Coefficients:
    """Which coefficients are kept: c columns of the grid and of colours together, of m of its rows."""

    down: np.ndarray  # (m, PATCH_SIZE) float32: a patch's rows into the grid's
    across: np.ndarray  # (3 PATCH_SIZE, c) float32: a row of a patch, (column, rgb), into columns of the grid and of colours
    kept: np.ndarray  # (KEPT,) of m c

    def of(self, patches: np.ndarray) -> np.ndarray:
        """(n, KEPT) float32 of patches (n, PATCH_DIM) float32: products with orthonormal vectors."""
        half = self.down @ patches.reshape(len(patches), PATCH_SIZE, -1)
        return np.take((half.reshape(-1, len(self.across)) @ self.across).reshape(len(patches), -1), self.kept, axis=1)


@dataclass(frozen=True)
class CoarseDictionary:
    """A dictionary of whole patches with what coarse products need; as good for any number of patches."""

    dictionary: np.ndarray  # (k, PATCH_DIM) float32, unit rows
    coefficients: Coefficients
    short: np.ndarray  # (k, KEPT) float32: those of the atoms
    rest: np.ndarray  # (k,) float32: norm of what they leave of each atom, rounded up
    gram: np.ndarray  # (k, k) float32
    rows, turns = ROWS, NO_TURNS

    def products(self, patches: np.ndarray, energy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Correlations (n, k) float32 of patches (n, PATCH_DIM), `energy` their squared norms, and a spread (n,) float32 for
        each: the correlation with atom a is no further off than it times `rest[a]`."""
        kept = self.coefficients.of(patches)
        left = np.maximum(energy - squared_norms(kept), 0) + ENERGY_ROUNDING * energy
        return kept @ self.short.T, np.sqrt(left).astype(np.float32)


def coarsen(dictionary: np.ndarray, gram: np.ndarray | None = None) -> CoarseDictionary | None:
    """A dictionary (k, d) float32 with unit rows split so; None where that would not pay: there are few
    atoms, they are not those of whole patches, or what is kept leaves too much of them."""
    if len(dictionary) < FEWEST_ATOMS or dictionary.shape[1] != PATCH_DIM:
        return None
    with one_blas_thread():  # others would go on spinning beside the threads that then code
        strongest = _strongest(dictionary)
        short = strongest.of(dictionary)
        gram = dictionary @ dictionary.T if gram is None else gram
    rest = np.sqrt(np.maximum(squared_norms(dictionary) - squared_norms(short), 0)) + REST_ROUNDING
    if np.median(rest) > MOST_REST:
        return None
    return CoarseDictionary(dictionary, strongest, short, rest.astype(np.float32), gram)


def _strongest(dictionary: np.ndarray) -> Coefficients:
    """The KEPT coefficients that hold most of the atoms' energy."""
    columns = axis_columns(SIZE)
    every = Coefficients(np.ascontiguousarray(columns.T, np.float32), np.kron(columns, COLOURS.T).astype(np.float32),
                         np.arange(3 * SIZE**2))
    strength = (every.of(dictionary).astype(np.float64) ** 2).sum(axis=0)
    kept = np.zeros((SIZE, 3 * SIZE), bool)
    kept.ravel()[np.argsort(-strength, kind="stable")[:KEPT]] = True
    rows, across = kept.any(axis=1), kept.any(axis=0)
    return Coefficients(np.ascontiguousarray(every.down[rows]), np.ascontiguousarray(every.across[:, across]),
                        np.flatnonzero(kept[rows][:, across]))
