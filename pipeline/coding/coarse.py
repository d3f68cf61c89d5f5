"""Certified OMP of whole patches with few atoms: first products by what 8 x 8 texels show of patches and atoms.

With some hundred atoms the products of patches with principal components would take as long as those with all atoms. What a
grid of 8 x 8 texels shows (`grid`) is found in a twelfth of that, and the norms of what it leaves of a patch and of an atom
bound how far a product is off (Cauchy-Schwarz). The few atoms that may be the best are settled at full width, once a
patch: the Gram matrix, which is exact, takes a settled product from step to step. On `fountain_p11` with 256 atoms and 8 of
them a patch, 15 are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coding.certified_kernels import ENERGY_ROUNDING
from pipeline.coding.grid import coefficients
from pipeline.coding.omp_kernels import NO_TURNS, squared_norms
from pipeline.texture.resample import PATCH_DIM
from pipeline.threads import one_blas_thread

SIZE = 8
FEWEST_ATOMS = 128  # below, all products of full width take no longer
# Share of a unit atom that the grid may leave, in the median, above which too many products are settled to pay: of fountain_p11
# it is 0.06, of monstree 0.13.
MOST_REST = 0.2
REST_ROUNDING = 1e-3  # of a unit atom's rest; with ENERGY_ROUNDING of a patch's, their product is float32's rounding
ROWS = 128  # patches at a time: 64 cost a tenth more for calls, 512 as much for memory


@dataclass(frozen=True)
class CoarseDictionary:
    """A dictionary of whole patches with what coarse products need; as good for any number of patches."""

    dictionary: np.ndarray  # (k, PATCH_DIM) float32, unit rows
    shown: np.ndarray  # (k, 3 SIZE^2) float32: what the grid shows of each atom
    rest: np.ndarray  # (k,) float32: norm of what it leaves, rounded up
    gram: np.ndarray  # (k, k) float32
    rows, turns = ROWS, NO_TURNS

    def products(self, patches: np.ndarray, energy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Correlations (n, k) float32 of patches (n, PATCH_DIM), `energy` their squared norms, and a spread (n,) float32 for
        each: the correlation with atom a is no further off than it times `rest[a]`."""
        shown = coefficients(patches, SIZE)
        left = np.maximum(energy - squared_norms(shown), 0) + ENERGY_ROUNDING * energy
        return shown @ self.shown.T, np.sqrt(left).astype(np.float32)


def coarsen(dictionary: np.ndarray, gram: np.ndarray | None = None) -> CoarseDictionary | None:
    """A dictionary (k, d) float32 with unit rows split so; None where that would not pay: there are few
    atoms, they are not those of whole patches, or the grid leaves too much of them."""
    if len(dictionary) < FEWEST_ATOMS or dictionary.shape[1] != PATCH_DIM:
        return None
    with one_blas_thread():  # others would go on spinning beside the threads that then code
        shown = coefficients(dictionary, SIZE)
        gram = dictionary @ dictionary.T if gram is None else gram
    rest = np.sqrt(np.maximum(squared_norms(dictionary) - squared_norms(shown), 0)) + REST_ROUNDING
    if np.median(rest) > MOST_REST:
        return None
    return CoarseDictionary(dictionary, shown, rest.astype(np.float32), gram)

