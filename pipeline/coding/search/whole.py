"""Exact search: the products of patches with all atoms are one GEMM, and a Gram matrix takes them from step to step.

Paper: Rubinstein et al. 2008 (batch OMP).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coding.beam.form import Beam
from pipeline.coding.omp_kernels import ONLY_IDENTITY
from pipeline.coding.search.by_gram import pursue_by_gram
from pipeline.coding.search.protocol import Found, Rules

ROWS = 512  # patches a GEMM: 512 x 4096 correlations are 8 MiB, near the second-level cache


@dataclass(frozen=True)
class WholeDictionary:
    """A dictionary whose products with patches are one GEMM."""

    dictionary: np.ndarray  # (k, d) float32, unit rows
    gram: np.ndarray  # (k, k) float32

    @property
    def n_bytes(self) -> int:
        return self.dictionary.nbytes + self.gram.nbytes

    def exact(self) -> WholeDictionary:
        return self

    def rows_at_a_time(self, beam: Beam | None) -> int:
        return ROWS

    def pursue(self, patches: np.ndarray, energy: np.ndarray, rules: Rules, found: Found) -> None:
        product, spread = patches @ self.dictionary.T, np.zeros(len(patches), np.float32)
        rest = np.zeros(len(self.dictionary), np.float32)
        pursue_by_gram(patches, energy, self.dictionary, product, spread, rest, self.gram, ONLY_IDENTITY, rules, found)


def by_whole_products(dictionary: np.ndarray) -> WholeDictionary:
    """Atoms (k, d) float32 of unit norm with their Gram matrix."""
    return WholeDictionary(dictionary, dictionary @ dictionary.T)
