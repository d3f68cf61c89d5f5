"""What a dictionary that patches are searched in has to offer, whatever way it finds the best atom.

Variants, a file each: `whole` (all products by one GEMM), `symmetric` (atoms in the eight symmetries of the square),
`coarse` (certified by few coefficients, with a Gram matrix), `stepwise` (without a k x k matrix). `choice` picks one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from pipeline.coding.beam.form import Beam

NO_LEVELS = np.empty((0, 0))


@dataclass(frozen=True)
class Rules:
    """When a patch has enough atoms, what weights may be, and which atom is the best."""

    tolerance: np.ndarray  # (n,) float64: squared residual norm at which a patch is done
    multiplier: float  # Lagrange multiplier: by how much more than this an atom must lower the squared residual norm
    levels: np.ndarray  # (r, w) float64, ascending rows: weights of rank j are of row j; w = 0 for exact weights
    certify: bool  # whether approximate products are made exact wherever they may decide
    beam: Beam | None  # None for plain OMP


class Found(NamedTuple):
    """What a pursuit of n patches fills in; zeros beyond n_atoms."""

    atom: np.ndarray  # (n, r) int32: rows of the dictionary
    weight: np.ndarray  # (n, r) float64
    code: np.ndarray  # (n, r) int32: indices into the levels
    n_atoms: np.ndarray  # (n,) int32
    path: np.ndarray  # (n, r + 1) float64: squared residual norm with no atom, one, and so on

    @classmethod
    def nothing(cls, n: int, most: int) -> Found:
        """For n patches of at most `most` atoms."""
        return cls(
            np.zeros((n, most), np.int32),
            np.zeros((n, most)),
            np.zeros((n, most), np.int32),
            np.zeros(n, np.int32),
            np.zeros((n, most + 1)),
        )


class SearchedDictionary(Protocol):
    """A dictionary with what its search needs; as good for any number of patches, never changed by them."""

    @property
    def dictionary(self) -> np.ndarray:
        """(k, d) float32, unit rows: what indices name."""

    @property
    def n_bytes(self) -> int:
        """Of all that is held."""

    def exact(self) -> SearchedDictionary:
        """The same atoms, with nothing approximate."""

    def rows_at_a_time(self, beam: Beam | None) -> int:
        """Patches of a block that the caches hold best."""

    def pursue(self, patches: np.ndarray, energy: np.ndarray, rules: Rules, found: Found) -> None:
        """Pursue patches (n, d) float32, contiguous, finite, of squared norms `energy` (n,) float64; fills `found`.

        Guarantees those of `omp.sparse_encode`; one thread.
        """
