"""Certified OMP without a Gram matrix: the atoms of exact OMP, found by products that are 24 to 48 times shorter than a
patch.

Atoms and patches are split into a few principal components and a rest. Short products and the norms of the rests bound
every correlation; the few atoms that may be the best are settled by products of full width (`certified_kernels`).
Dictionaries learned from patches lie almost wholly in a few components: on `fountain_p11` (32x32 RGB) with 4,096 atoms
and 128 components, 1.1 atoms are settled at the first step of a patch and 4 at the eighth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.coding.beam import by_steps
from pipeline.coding.beam.form import Beam
from pipeline.coding.omp_kernels import squared_norms
from pipeline.coding.search.protocol import Found, Rules
from pipeline.coding.search.stepwise_kernels import advance
from pipeline.coding.search.symmetric import SymmetricDictionary
from pipeline.execution.threads import one_blas_thread

COMPONENTS = 128  # of 64, 128, 192 and 256 the fastest for 4,096 atoms of 3,072 texels
LEAST_WIDTH = 4 * COMPONENTS  # of rows that components are shorter than
SAMPLE = 2048  # atoms that the components are found from
# Share of a unit atom outside the components above which certified search settles too many atoms to pay: of
# fountain_p11 and monstree it is 0.006 to 0.011; of 3,000 points of fountain_p11, whose patches lie in no few
# components, 0.3, and there certified search took 7 to 9 ms a patch where exact search takes 0.3.
MOST_REST = 0.1
PRODUCT_BYTES = 4 << 20  # of short products at a time, near the second-level cache


@dataclass(frozen=True)
class StepwiseDictionary:
    """A dictionary with what short products need; as good for any number of patches."""

    dictionary: np.ndarray  # (k, d) float32, unit rows
    basis: np.ndarray  # (d, p) float32, orthonormal columns
    short: np.ndarray  # (k, p) float32: dictionary @ basis
    rest: np.ndarray  # (k,) float32: norm of what the components leave of each atom, rounded up
    symmetric: SymmetricDictionary | None = None  # the same atoms, where they are fewer in all symmetries

    @property
    def n_bytes(self) -> int:
        return self.dictionary.nbytes

    def exact(self) -> StepwiseDictionary:
        return unshortened(self.dictionary, self.symmetric)

    def rows_at_a_time(self, beam: Beam | None) -> int:
        if beam:
            return by_steps.rows_at_a_time(len(self.dictionary), beam.width)
        return max(32, min(512, PRODUCT_BYTES // (4 * len(self.dictionary))))

    def pursue(self, patches: np.ndarray, energy: np.ndarray, rules: Rules, found: Found) -> None:
        stop = (rules.tolerance, rules.multiplier, rules.levels)
        if rules.beam:
            by_steps.pursue_beam_rows(
                patches,
                energy,
                self.dictionary,
                self._all_products,
                *stop,
                rules.beam.width,
                rules.beam.candidates,
                *found,
            )
        else:
            pursue_rows(patches, energy, self, rules.certify and len(self.basis) > 0, *stop, *found)

    def _all_products(self, rows: np.ndarray) -> np.ndarray:
        """(n, k) float32 of rows (n, d)."""
        return rows @ self.dictionary.T if self.symmetric is None else self.symmetric.products_in_order(rows)


def shorten(dictionary: np.ndarray, components: int | None = None) -> StepwiseDictionary | None:
    """Split a dictionary (k, d) float32 with unit rows; None where that does not pay: its rows are short, or its atoms
    do not lie in few components. A number of `components` says to split it all the same.
    """
    n_atoms, dim = dictionary.shape
    if components is None and dim < LEAST_WIDTH:
        return None
    with one_blas_thread():
        basis = principal_components(sampled(dictionary), components or COMPONENTS)
    short, rest = dictionary @ basis, np.empty(n_atoms, np.float32)
    for start in range(0, n_atoms, 1024):
        rows = slice(start, start + 1024)
        rest[rows] = np.sqrt(squared_norms(dictionary[rows] - short[rows] @ basis.T)) + 1e-5
    if components is None and np.median(rest) > MOST_REST:
        return None
    return StepwiseDictionary(dictionary, basis, short, rest)


def unshortened(dictionary: np.ndarray, symmetric: SymmetricDictionary | None = None) -> StepwiseDictionary:
    """The dictionary in its own components, which leave no rest: for exact search beyond MOST_WITH_GRAM atoms."""
    return StepwiseDictionary(
        dictionary, np.empty((0, 0), np.float32), dictionary, np.zeros(len(dictionary), np.float32), symmetric
    )


def sampled(dictionary: np.ndarray) -> np.ndarray:
    """Atoms that components are found from, SAMPLE at most."""
    return dictionary[:: -(-len(dictionary) // SAMPLE)]


def principal_components(rows: np.ndarray, n: int) -> np.ndarray:
    """Orthonormal columns (d, n) float32 that span nearly what the first n principal components of rows (m, d) do.

    Two rounds of subspace iteration from a fixed random start (Halko et al. 2011).
    """
    rng = np.random.default_rng(0)
    start = min(rows.shape[1], n + 16)
    span = rng.standard_normal((rows.shape[1], start)).astype(np.float32)
    for _ in range(2):
        span = np.linalg.qr(rows.T @ (rows @ span))[0]
    # Of the few columns too many, those go that hold least.
    _, order = np.linalg.eigh((rows @ span).T.astype(np.float64) @ (rows @ span))
    return np.ascontiguousarray(np.linalg.qr(span.astype(np.float64) @ order[:, ::-1][:, :n])[0], np.float32)


def pursue_rows(
    rows, energy, split: StepwiseDictionary, certify, tolerance, multiplier, levels, atom, weight, code, n_atoms, path
):
    """`pursue` for a block of patches (n, d), in place. Returns how many products of full width with patches it took.

    All patches take their first atom, then their second: each step is one GEMM of the residuals' components.
    """
    components = rows @ split.basis if len(split.basis) else rows.copy()
    rounding = 2.0**-23 * (split.short.shape[1] + 32)
    n, most = atom.shape
    n_atoms[:], path[:, 0] = 0, energy
    active = np.flatnonzero(energy > tolerance)
    n_active, total = len(active), 0
    components = np.ascontiguousarray(components[active])
    target, forward = np.empty((n, most)), np.empty((n, most))
    gram_support, chol = np.empty((n, most, most)), np.empty((n, most, most))
    while n_active:
        current = components[:n_active]
        product = current @ split.short.T if split.symmetric is None else split.symmetric.products_in_order(current)
        n_active, n_settled = advance(
            rows,
            energy,
            split.dictionary,
            components,
            split.short,
            product,
            split.rest,
            rounding,
            certify,
            tolerance,
            multiplier,
            levels,
            atom,
            weight,
            code,
            n_atoms,
            path,
            target,
            forward,
            gram_support,
            chol,
            active,
            n_active,
        )
        total += n_settled
    return total
