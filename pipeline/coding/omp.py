"""Sparse coding by orthogonal matching pursuit in batch form: one GEMM for all correlations, then a kernel a patch.

Papers: HPG 2021, sections 3.3 (pursuit, cut-off, least squares) and 3.4 (quantised weights in the loop); batch form
and progressive Cholesky after Rubinstein et al. 2008.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.beam.form import beam_of
from pipeline.coding.omp_kernels import add_atoms, squared_norms
from pipeline.coding.search.choice import SEARCHES, ready_for
from pipeline.coding.search.protocol import NO_LEVELS, Found, Rules, SearchedDictionary
from pipeline.execution.threads import available_cores, run_all


class Codes(NamedTuple):
    """Codes of n patches with up to r atoms; entries beyond n_atoms are zero."""

    atom_index: np.ndarray  # (n, r) int32
    weight: np.ndarray  # (n, r) float32
    n_atoms: np.ndarray  # (n,) int32


class Pursuit(NamedTuple):
    """Codes, the levels their weights were quantised to, and what is left of the patches."""

    codes: Codes
    weight_code: np.ndarray  # (n, r) int32, index into the weight levels of the rank; zeros where weights are exact
    # (n, r + 1) float64: the squared norm of what is left with no atom, one, and so on; zeros beyond n_atoms. Of a
    # beam, what the best support of as many atoms leaves, which need not be the first of the codes'.
    path: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """(n,) float64: the squared norm of what all atoms leave."""
        return self.path[np.arange(len(self.path)), self.codes.n_atoms]

    def beside(self, rest: np.ndarray) -> Pursuit:
        """The same, of patches that have squared norms `rest` (n,) beside what was coded of them."""
        return self._replace(path=self.path + rest[:, None])

    def atoms_at(self, multiplier: float) -> np.ndarray:
        """How many of its atoms (n,) each patch takes at a Lagrange multiplier no lower than that of this pursuit."""
        worth = (self.path[:, :-1] - self.path[:, 1:] > multiplier) & (
            np.arange(self.path.shape[1] - 1) < self.codes.n_atoms[:, None]
        )
        return np.logical_and.accumulate(worth, axis=1).sum(axis=1)


def sparse_encode(
    patches: np.ndarray,  # (n, patch_dim)
    dictionary: np.ndarray,  # (n_dictionary, patch_dim), unit rows
    *,
    max_atoms: int,
    tolerance: float | np.ndarray = 0.0,
    multiplier: float = 0.0,
    weight_levels: np.ndarray | None = None,  # (max_atoms or more, n_levels), ascending rows
    search: str = "exact",
    pursuit: str = "omp",
    n_threads: int | None = None,
) -> Codes:
    """Code each patch by at most `max_atoms` atoms; returns `(atom_index, weight, n_atoms)`.

    A patch is done when its squared residual norm is at most `tolerance` (one number, or one a patch; in the units of
    the patches squared, as scikit-learn's `tol` and SPAMS' `eps`), or when a further atom would lower it by no more
    than `multiplier`, the Lagrange multiplier of `error + multiplier * atoms`: one for all patches spends atoms where
    they mend most. With `weight_levels` every weight of rank j is one of row j, chosen inside the loop: the next atom
    sees what the rounding left.

    `search` is how the atom of largest correlation is found: "exact" by all products; "certified" by short products
    that prove most atoms smaller, and products of full width with the few others: the same atoms, but where two
    correlations differ by less than float32's rounding; "approximate" by short products alone: an atom may be taken
    whose correlation is below the largest by the share of the patch (beyond 16,384 atoms, of the residual) outside the
    components times those of both atoms, while weights stay those of the full patches. `n_threads` None takes all
    cores.

    `pursuit` is which atom is the best: "omp", that of largest correlation with the residual; "ormp" (order-recursive,
    as SPAMS' `omp`), the one that leaves least once all weights are fitted again; a beam "WxC" follows W supports at a
    time, tries each with the C best atoms by that rule, and keeps those that leave least with their weights as they are
    quantised. With levels, "ormp" alone is the worse: it does not see what rounding left. Beyond 16,384 atoms only
    "omp" takes short products.

    Guarantees: no atom twice in a support; the residual never rises with an atom; exact weights are the least squares
    of their support; scaling a patch (and its tolerance, by the square) scales its weights; the result of a patch
    does not depend on threads, nor, but for the rounding of BLAS products of another size, on the other patches. Inputs
    may be read-only, strided or float64. Beyond 16,384 atoms no k x k matrix is made.

    Raises ValueError: shapes that do not fit, more atoms asked than exist, rows that are not unit vectors, values that
    are not finite, a search or a pursuit there is not.

    >>> atoms = np.eye(4, dtype=np.float32)
    >>> codes = sparse_encode(np.array([[0, 3, 0, -1]]), atoms, max_atoms=2)
    >>> codes.atom_index.tolist(), codes.weight.tolist()
    ([[1, 3]], [[3.0, -1.0]])
    """
    return pursue_patches(
        patches,
        dictionary,
        max_atoms=max_atoms,
        tolerance=tolerance,
        multiplier=multiplier,
        weight_levels=weight_levels,
        search=search,
        pursuit=pursuit,
        n_threads=available_cores() if n_threads is None else n_threads,
    ).codes


def pursue_patches(
    patches: np.ndarray,
    dictionary: np.ndarray | SearchedDictionary,  # made ready already, where many calls share one
    *,
    max_atoms: int,
    tolerance: float | np.ndarray = 0.0,
    multiplier: float = 0.0,
    weight_levels: np.ndarray | None = None,
    search: str = "exact",
    pursuit: str = "omp",
    n_threads: int = 1,
) -> Pursuit:
    """`sparse_encode`, with all that the pursuit found out."""
    if search not in SEARCHES:
        raise ValueError(f"search is {search!r}; allowed: {', '.join(SEARCHES)}")
    searched = ready_for(search, _checked(dictionary)) if isinstance(dictionary, np.ndarray) else dictionary
    if search == "exact":
        searched = searched.exact()
    patches, beam = _fitting(patches, searched.dictionary, max_atoms), beam_of(pursuit)
    levels = NO_LEVELS if weight_levels is None else np.ascontiguousarray(weight_levels, np.float64)
    n, step = len(patches), searched.rows_at_a_time(beam)
    codes = Codes(np.zeros((n, max_atoms), np.int32), np.zeros((n, max_atoms), np.float32), np.zeros(n, np.int32))
    weight_code, path = np.zeros((n, max_atoms), np.int32), np.zeros((n, max_atoms + 1))
    tolerance = np.broadcast_to(np.asarray(tolerance, np.float64), (n,))

    def pursue_block(start: int) -> None:
        block = slice(start, start + step)
        rows = patches[block]
        energy = squared_norms(rows)
        if not np.isfinite(energy).all():
            raise ValueError(f"patch {start + int(np.argmin(np.isfinite(energy)))} is not finite")
        path[block, 0] = energy
        todo = start + np.flatnonzero(energy > np.maximum(tolerance[block], multiplier))
        if not len(todo):
            return
        if len(todo) < len(rows):  # of fountain_p11 at 40 dB, a third: they need no products
            rows, energy = rows[todo - start], energy[todo - start]
        found = Found.nothing(len(todo), max_atoms)
        searched.pursue(rows, energy, Rules(tolerance[todo], multiplier, levels, search == "certified", beam), found)
        kept: tuple[np.ndarray, ...] = (codes.atom_index, codes.weight, weight_code, codes.n_atoms, path)
        for whole, rows_found in zip(kept, found):
            whole[todo] = rows_found

    run_all(pursue_block, range(0, n, step), n_threads)
    return Pursuit(codes, weight_code, path)


def reconstruct(codes: Codes, dictionary: np.ndarray) -> np.ndarray:
    """What the codes stand for, (n, patch_dim) float32."""
    result = np.zeros((len(codes.n_atoms), dictionary.shape[1]), np.float32)
    add_atoms(result, dictionary, codes.atom_index, codes.weight, codes.n_atoms)
    return result


def _fitting(patches: np.ndarray, dictionary: np.ndarray, max_atoms: int) -> np.ndarray:
    patches = np.ascontiguousarray(patches, np.float32)
    if patches.ndim != 2 or patches.shape[1] != dictionary.shape[1]:
        raise ValueError(f"patches {patches.shape} and dictionary {dictionary.shape} must be (n, d) and (k, d)")
    if not 1 <= max_atoms <= len(dictionary):
        raise ValueError(f"max_atoms is {max_atoms}; the dictionary allows 1 to {len(dictionary)}")
    return patches


def _checked(dictionary: np.ndarray) -> np.ndarray:
    dictionary = np.ascontiguousarray(dictionary, np.float32)
    if dictionary.ndim != 2:
        raise ValueError(f"dictionary {dictionary.shape} must be (k, d)")
    norms = np.sqrt(squared_norms(dictionary))
    if not (np.abs(norms - 1) < 1e-3).all():
        worst = int(np.nanargmax(np.where(np.isfinite(norms), np.abs(norms - 1), np.inf)))
        raise ValueError(f"atom {worst} has norm {norms[worst]:g}; every atom must be a unit vector")
    return dictionary
