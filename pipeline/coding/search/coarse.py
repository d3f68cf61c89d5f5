"""Certified OMP with a Gram matrix: first products by few coefficients, in which the atoms are strong.

The norms of what the coefficients leave of a patch and of an atom bound how far a product is off (Cauchy-Schwarz). The
few atoms that may be the best are settled at full width, once a patch: the Gram matrix, which is exact, takes a settled
product from step to step.

Of whole patches the coefficients are those of 12 x 12 texels (`grid`), the colours as one of luma and two of
chroma: found in an eighth of the time of products with as many principal components, and the KEPT in which the
dictionary has most are little more than a shorter product would be wide. With 8 atoms a patch, 10 of 256 are settled on
`fountain_p11` and 12 on `monstree`. Of other rows, and where the grid leaves too much, they are principal components.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.coding.beam.form import Beam
from pipeline.coding.grid import axis_columns
from pipeline.coding.omp_kernels import ONLY_IDENTITY, squared_norms
from pipeline.coding.search.by_gram import pursue_by_gram
from pipeline.coding.search.protocol import Found, Rules
from pipeline.coding.search.stepwise import COMPONENTS, LEAST_WIDTH, principal_components, sampled
from pipeline.coding.search.stepwise_kernels import ENERGY_ROUNDING
from pipeline.coding.search.whole import WholeDictionary
from pipeline.execution.threads import one_blas_thread
from pipeline.texture.resample import PATCH_DIM
from storage.packed.schema import PATCH_SIZE

SIZE = 12  # with 8, monstree has 27 atoms settled; 16 cost more than they spare
KEPT = 128
FEWEST_ATOMS = 128  # below, all products of full width take no longer; of principal components, FEWEST_FOR_COMPONENTS
FEWEST_FOR_COMPONENTS = 1024
# Share of a unit atom that may be left, in the median, above which too many products are settled to pay: of
# fountain_p11 it is 0.03, of monstree 0.07.
MOST_REST = 0.2
REST_ROUNDING = 1e-3  # of a unit atom's rest; with ENERGY_ROUNDING of a patch's, their product is float32's rounding
ROWS = 128  # patches at a time: 64 cost a tenth more for calls, 512 as much for memory
COLOURS = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt(
    [[3], [2], [6]]
)  # orthonormal: luma and two axes of chroma


@dataclass(frozen=True)
class GridCoefficients:
    """Which coefficients are kept: c columns of the grid and of colours together, of m of its rows."""

    down: np.ndarray  # (m, PATCH_SIZE) float32: a patch's rows into the grid's
    across: (
        np.ndarray
    )  # (3 PATCH_SIZE, c) float32: a row of a patch, (column, rgb), into columns of the grid and of colours
    kept: np.ndarray  # (KEPT,) of m c

    def of(self, patches: np.ndarray) -> np.ndarray:
        """(n, KEPT) float32 of patches (n, PATCH_DIM) float32: products with orthonormal vectors."""
        half = self.down @ patches.reshape(len(patches), PATCH_SIZE, -1)
        return np.take((half.reshape(-1, len(self.across)) @ self.across).reshape(len(patches), -1), self.kept, axis=1)


@dataclass(frozen=True)
class PrincipalCoefficients:
    """All of them, of an orthonormal basis."""

    basis: np.ndarray  # (d, p) float32

    def of(self, patches: np.ndarray) -> np.ndarray:
        """(n, p) float32 of patches (n, d) float32."""
        return patches @ self.basis


@dataclass(frozen=True)
class CoarseDictionary:
    """A dictionary with what coarse products need; as good for any number of patches."""

    dictionary: np.ndarray  # (k, d) float32, unit rows
    coefficients: GridCoefficients | PrincipalCoefficients
    short: np.ndarray  # (k, p) float32: those of the atoms
    rest: np.ndarray  # (k,) float32: norm of what they leave of each atom, rounded up
    gram: np.ndarray  # (k, k) float32

    @property
    def n_bytes(self) -> int:
        return self.dictionary.nbytes + self.gram.nbytes

    def exact(self) -> WholeDictionary:
        return WholeDictionary(self.dictionary, self.gram)

    def rows_at_a_time(self, beam: Beam | None) -> int:
        return ROWS

    def products(self, patches: np.ndarray, energy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Correlations (n, k) float32 of patches (n, d), `energy` their squared norms, and a spread (n,) float32 for
        each: the correlation with atom a is no further off than it times `rest[a]`."""
        kept = self.coefficients.of(patches)
        left = np.maximum(energy - squared_norms(kept), 0) + ENERGY_ROUNDING * energy
        return kept @ self.short.T, np.sqrt(left).astype(np.float32)

    def pursue(self, patches: np.ndarray, energy: np.ndarray, rules: Rules, found: Found) -> None:
        product, spread = self.products(patches, energy)
        pursue_by_gram(
            patches, energy, self.dictionary, product, spread, self.rest, self.gram, ONLY_IDENTITY, rules, found
        )


def coarsen(dictionary: np.ndarray, components: int | None = None) -> CoarseDictionary | None:
    """A dictionary (k, d) float32 with unit rows split so; None where that would not pay: there are few
    atoms, or few coefficients leave too much of them. A number of principal `components` says to split it by them all
    the same."""
    with one_blas_thread():  # others would go on spinning beside the threads that then code
        for coefficients in _ways(dictionary, components):
            short = coefficients.of(dictionary)
            rest = np.sqrt(np.maximum(squared_norms(dictionary) - squared_norms(short), 0)) + REST_ROUNDING
            if components or np.median(rest) <= MOST_REST:
                return CoarseDictionary(
                    dictionary, coefficients, short, rest.astype(np.float32), dictionary @ dictionary.T
                )
    return None


def _ways(dictionary: np.ndarray, components: int | None) -> Iterator[GridCoefficients | PrincipalCoefficients]:
    n_atoms, width = dictionary.shape
    if components is None and n_atoms >= FEWEST_ATOMS and width == PATCH_DIM:
        yield _strongest(dictionary)
    if components or (n_atoms >= FEWEST_FOR_COMPONENTS and width >= LEAST_WIDTH):
        yield PrincipalCoefficients(principal_components(sampled(dictionary), components or COMPONENTS))


def _strongest(dictionary: np.ndarray) -> GridCoefficients:
    """The KEPT coefficients that hold most of the atoms' energy."""
    columns = axis_columns(SIZE)
    every = GridCoefficients(
        np.ascontiguousarray(columns.T, np.float32),
        np.kron(columns, COLOURS.T).astype(np.float32),
        np.arange(3 * SIZE**2),
    )
    strength = (every.of(dictionary).astype(np.float64) ** 2).sum(axis=0)
    kept = np.zeros((SIZE, 3 * SIZE), bool)
    kept.ravel()[np.argsort(-strength, kind="stable")[:KEPT]] = True
    rows, across = kept.any(axis=1), kept.any(axis=0)
    return GridCoefficients(
        np.ascontiguousarray(every.down[rows]),
        np.ascontiguousarray(every.across[:, across]),
        np.flatnonzero(kept[rows][:, across]),
    )
