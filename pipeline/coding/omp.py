"""Sparse coding by orthogonal matching pursuit in batch form: one GEMM for all correlations, then a kernel a patch.

Papers: HPG 2021, sections 3.3 (pursuit, cut-off, least squares) and 3.4 (quantised weights in the loop); batch form
and progressive Cholesky after Rubinstein et al. 2008.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.coding.certified import (
    MOST_WITH_GRAM, ShortDictionary, pursue_rows, rows_at_a_time, shorten, unshortened,
)
from pipeline.coding.coarse import ROWS as COARSE_ROWS, CoarseDictionary, coarse_products, coarsen
from pipeline.coding.omp_kernels import add_atoms, pursue, squared_norms
from pipeline.threads import available_cores, run_all

ROWS = 512  # patches a GEMM: 512 x 4096 correlations are 8 MiB, near the second-level cache
NO_LEVELS = np.empty((0, 0))
SEARCHES = ("exact", "certified", "approximate")


class Codes(NamedTuple):
    """Codes of n patches with up to r atoms; entries beyond n_atoms are zero."""

    atom_index: np.ndarray  # (n, r) int32
    weight: np.ndarray  # (n, r) float32
    n_atoms: np.ndarray  # (n,) int32


class Pursuit(NamedTuple):
    """Codes, the levels their weights were quantised to, and what is left of the patches."""

    codes: Codes
    weight_code: np.ndarray  # (n, r) int32, index into the weight levels of the rank; zeros where weights are exact
    residual: np.ndarray  # (n,) float64 squared norm


def sparse_encode(
    patches: np.ndarray,  # (n, patch_dim)
    dictionary: np.ndarray,  # (n_dictionary, patch_dim), unit rows
    *,
    max_atoms: int,
    tolerance: float | np.ndarray = 0.0,
    price: float = 0.0,
    weight_levels: np.ndarray | None = None,  # (max_atoms or more, n_levels), ascending rows
    search: str = "exact",
    n_threads: int | None = None,
) -> Codes:
    """Code each patch by at most `max_atoms` atoms; returns `(atom_index, weight, n_atoms)`.

    A patch is done when its squared residual norm is at most `tolerance` (one number, or one a patch; in the units of
    the patches squared, as scikit-learn's `tol` and SPAMS' `eps`), or when a further atom would lower it by no more than
    `price`: one price for all patches spends atoms where they mend most. With `weight_levels` every weight of rank j is one
    of row j, chosen inside the loop: the next atom sees what the rounding left.

    `search` is how the atom of largest correlation is found: "exact" by all products; "certified" by short products
    that prove most atoms smaller, and products of full width with the few others: the same atoms, but where two
    correlations differ by less than float32's rounding; "approximate" by short products alone: an atom may be taken
    whose correlation is below the largest by twice the share of the residual outside the components times that of the
    atom, while weights stay those of the full patches. `n_threads` None takes all cores.

    Guarantees: no atom twice in a support; the residual never rises with an atom; exact weights are the least squares
    of their support; scaling a patch (and its tolerance, by the square) scales its weights; the result of a patch
    does not depend on threads, nor, but for the rounding of BLAS products of another size, on the other patches. Inputs
    may be read-only, strided or float64. Beyond 16,384 atoms no k x k matrix is made.

    Raises ValueError: shapes that do not fit, more atoms asked than exist, rows that are not unit vectors, values that
    are not finite, a search there is not.

    >>> atoms = np.eye(4, dtype=np.float32)
    >>> codes = sparse_encode(np.array([[0, 3, 0, -1]]), atoms, max_atoms=2)
    >>> codes.atom_index.tolist(), codes.weight.tolist()
    ([[1, 3]], [[3.0, -1.0]])
    """
    return pursue_patches(
        patches, dictionary, max_atoms=max_atoms, tolerance=tolerance, price=price, weight_levels=weight_levels, search=search,
        n_threads=available_cores() if n_threads is None else n_threads,
    ).codes


def pursue_patches(
    patches: np.ndarray,
    dictionary: np.ndarray | ShortDictionary | CoarseDictionary,  # split already, where many calls share one
    *,
    max_atoms: int,
    tolerance: float | np.ndarray = 0.0,
    price: float = 0.0,
    weight_levels: np.ndarray | None = None,
    gram: np.ndarray | None = None,  # (n_dictionary, n_dictionary) float32, where it is at hand
    search: str = "exact",
    n_threads: int = 1,
) -> Pursuit:
    """`sparse_encode`, with all that the pursuit found out."""
    if search not in SEARCHES:
        raise ValueError(f"search is {search!r}; allowed: {', '.join(SEARCHES)}")
    split = None if isinstance(dictionary, np.ndarray) else dictionary
    patches, dictionary = _checked(patches, split.dictionary if split else dictionary, max_atoms)
    if search == "exact":
        split = None
    elif split is None:
        split = shorten(dictionary) or coarsen(dictionary, gram)
    if split is None and len(dictionary) > MOST_WITH_GRAM:
        split = unshortened(dictionary)
    coarse, short = (split if isinstance(split, kind) else None for kind in (CoarseDictionary, ShortDictionary))
    certify = search == "certified" and short is not None and len(short.basis) > 0
    if coarse is not None:
        gram = coarse.gram
    elif short is None and gram is None:
        gram = dictionary @ dictionary.T
    rest = np.zeros(len(dictionary), np.float32) if coarse is None else coarse.rest
    levels = NO_LEVELS if weight_levels is None else np.ascontiguousarray(weight_levels, np.float64)
    n = len(patches)
    codes = Codes(np.zeros((n, max_atoms), np.int32), np.zeros((n, max_atoms), np.float32), np.zeros(n, np.int32))
    weight_code, residual = np.zeros((n, max_atoms), np.int32), np.zeros(n)
    tolerance = np.broadcast_to(np.asarray(tolerance, np.float64), (n,))
    step = rows_at_a_time(short) if short else COARSE_ROWS if coarse else ROWS

    def pursue_block(start: int) -> None:
        part = slice(start, start + step)
        rows = patches[part]
        energy = squared_norms(rows)
        if not np.isfinite(energy).all():
            raise ValueError(f"patch {start + int(np.argmin(np.isfinite(energy)))} is not finite")
        residual[part] = energy
        todo = start + np.flatnonzero(energy > np.maximum(tolerance[part], price))
        if not len(todo):
            return
        if len(todo) < len(rows):  # of fountain_p11 at 40 dB, a third: they need no products
            rows, energy = rows[todo - start], energy[todo - start]
        found = (np.zeros((len(todo), max_atoms), np.int32), np.zeros((len(todo), max_atoms)),
                 np.zeros((len(todo), max_atoms), np.int32), np.zeros(len(todo), np.int32), np.zeros(len(todo)))
        if short is not None:
            pursue_rows(rows, energy, short, certify, tolerance[todo], price, levels, *found)
        else:
            initial, spread = coarse_products(rows, energy, coarse) if coarse else _exact_products(rows, dictionary)
            pursue(rows, dictionary, initial, spread, rest, energy, gram, tolerance[todo], price, levels, *found)
        for whole, rows_found in zip((codes.atom_index, codes.weight, weight_code, codes.n_atoms, residual), found):
            whole[todo] = rows_found

    run_all(pursue_block, range(0, n, step), n_threads)
    return Pursuit(codes, weight_code, residual)


def reconstruct(codes: Codes, dictionary: np.ndarray) -> np.ndarray:
    """What the codes stand for, (n, patch_dim) float32."""
    result = np.zeros((len(codes.n_atoms), dictionary.shape[1]), np.float32)
    add_atoms(result, dictionary, codes.atom_index, codes.weight, codes.n_atoms)
    return result


def _exact_products(patches: np.ndarray, dictionary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return patches @ dictionary.T, np.zeros(len(patches), np.float32)


def _checked(patches: np.ndarray, dictionary: np.ndarray, max_atoms: int) -> tuple[np.ndarray, np.ndarray]:
    patches = np.ascontiguousarray(patches, np.float32)
    dictionary = np.ascontiguousarray(dictionary, np.float32)
    if patches.ndim != 2 or dictionary.ndim != 2 or patches.shape[1] != dictionary.shape[1]:
        raise ValueError(f"patches {patches.shape} and dictionary {dictionary.shape} must be (n, d) and (k, d)")
    if not 1 <= max_atoms <= len(dictionary):
        raise ValueError(f"max_atoms is {max_atoms}; the dictionary allows 1 to {len(dictionary)}")
    norms = np.sqrt(squared_norms(dictionary))
    if not (np.abs(norms - 1) < 1e-3).all():
        worst = int(np.nanargmax(np.where(np.isfinite(norms), np.abs(norms - 1), np.inf)))
        raise ValueError(f"atom {worst} has norm {norms[worst]:g}; every atom must be a unit vector")
    return patches, dictionary
