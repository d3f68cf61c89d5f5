"""The inner loop of batch OMP. Dimensions: n patches, k atoms, t atoms of a support, r ranks, w weight levels.

Correlations run in float32, k wide; everything of the size of a support runs in float64. One thread, no BLAS, no
reassociation between patches: the result of a patch does not depend on its neighbours.
"""

from __future__ import annotations

import numba
import numpy as np

# A squared pivot below this says that the atom lies in the span of the support, as far as float32 can tell. The Gram
# matrix is exact to 1e-7, so weights to 1e-7 / pivot: on differences of near-twins the residual norm was 5e-4 above the
# least squares with pivots of 2e-4, and 2.4e-5 with 2e-3. On 4,000 patches of fountain_p11 with 8 of 256 atoms pivots
# stay above 0.16.
SMALLEST_PIVOT = 2e-3
# A correlation below this share of the patch's norm is float32 rounding of a GEMM over 3072 terms, not signal.
SMALLEST_CORRELATION = 1e-6


@numba.njit(cache=True, nogil=True, fastmath={"nnan", "nsz", "reassoc", "contract"})
def _subtract_rows(correlation, initial, gram, support, weight, n_support):
    """correlation = initial - sum of weight_j * gram[support_j], k wide; returns its largest magnitude."""
    n_dictionary = initial.shape[0]
    for a in range(n_dictionary):
        correlation[a] = initial[a]
    for j in range(n_support):
        row = gram[support[j]]
        x = np.float32(weight[j])
        for a in range(n_dictionary):
            correlation[a] -= x * row[a]
    for j in range(n_support):
        correlation[support[j]] = 0
    largest = np.float32(0)
    for a in range(n_dictionary):
        largest = max(largest, abs(correlation[a]))
    return largest


@numba.njit(cache=True, nogil=True)
def _first_of_magnitude(correlation, magnitude):
    for a in range(correlation.shape[0]):
        if abs(correlation[a]) >= magnitude:
            return a
    return -1


@numba.njit(cache=True, nogil=True)
def _append_to_cholesky(chol, gram_support, t):
    """Extend the factor of the support's Gram matrix by row t; returns the squared pivot."""
    pivot = gram_support[t, t]
    for i in range(t):
        value = gram_support[t, i]
        for j in range(i):
            value -= chol[t, j] * chol[i, j]
        chol[t, i] = value / chol[i, i]
        pivot -= chol[t, i] * chol[t, i]
    if pivot > 0:
        chol[t, t] = np.sqrt(pivot)
    return pivot


@numba.njit(cache=True, nogil=True)
def _solve_cholesky(chol, target, weight, t):
    """Least squares on the support: chol @ chol.T @ weight = target, t wide."""
    for i in range(t):
        value = target[i]
        for j in range(i):
            value -= chol[i, j] * weight[j]
        weight[i] = value / chol[i, i]
    for i in range(t - 1, -1, -1):
        value = weight[i]
        for j in range(i + 1, t):
            value -= chol[j, i] * weight[j]
        weight[i] = value / chol[i, i]


@numba.njit(cache=True, nogil=True)
def nearest_level(levels, value):
    """Index of the level next to `value`; `levels` (w,) ascending."""
    low, high = 0, levels.shape[0] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if levels[middle] <= value:
            low = middle
        else:
            high = middle
    return high if levels[high] - value < value - levels[low] else low


@numba.njit(cache=True, nogil=True)
def _quantize_weights(levels, target, gram_support, weight, code, t):
    """Replace least-squares weights by levels, then let each in turn take up what the others' rounding left.

    A sweep never raises the error: each weight moves to the level nearest to its optimum given the others. Two sweeps
    settle supports of 8 (on 4,000 patches of fountain_p11 a third changes 1.3 weights in 1,000).
    """
    for j in range(t):
        code[j] = nearest_level(levels[j], weight[j])
        weight[j] = levels[j, code[j]]
    for _ in range(2):
        for j in range(t):
            optimum = target[j]
            for i in range(t):
                if i != j:
                    optimum -= gram_support[j, i] * weight[i]
            code[j] = nearest_level(levels[j], optimum / gram_support[j, j])
            weight[j] = levels[j, code[j]]


@numba.njit(cache=True, nogil=True)
def _residual_energy(energy, target, gram_support, weight, t):
    """|y - sum of weight_j d_j|^2 by the Gram matrix."""
    for i in range(t):
        energy -= 2 * weight[i] * target[i]
        for j in range(t):
            energy += weight[i] * weight[j] * gram_support[i, j]
    return max(energy, 0.0)


@numba.njit(cache=True, nogil=True)
def pursue(initial, energy, gram, tolerance, price, levels, atom, weight, code, n_atoms, residual):
    """Orthogonal matching pursuit of every row of `initial`, with weights from `levels` if there are any.

    initial (n, k) float32: correlations of patches and atoms; energy (n,) float64: squared norms; gram (k, k)
    float32; tolerance (n,) float64: squared residual at which a patch is done; price: by how much
    more than that an atom must lower it; levels (r, w) float64, w = 0 for exact
    weights. Filled: atom (n, r) int32, weight (n, r) float64, code (n, r) int32, n_atoms (n,) int32, residual (n,)
    float64. The residual never rises with an atom: one that would not lower it ends the pursuit.
    """
    n, n_dictionary = initial.shape
    most = atom.shape[1]
    quantized = levels.shape[1] > 0
    correlation = np.empty(n_dictionary, np.float32)
    gram_support = np.empty((most, most))
    chol = np.empty((most, most))
    target = np.empty(most)
    trial = np.empty(most)
    trial_code = np.zeros(most, np.int32)
    for i in range(n):
        t = 0
        error = energy[i]
        while t < most and error > tolerance[i]:
            largest = _subtract_rows(correlation, initial[i], gram, atom[i], weight[i], t)
            pivot = 0.0
            while np.float64(largest) ** 2 > SMALLEST_CORRELATION**2 * energy[i]:
                candidate = _first_of_magnitude(correlation, largest)
                for j in range(t):
                    gram_support[t, j] = gram[candidate, atom[i, j]]
                    gram_support[j, t] = gram_support[t, j]
                gram_support[t, t] = gram[candidate, candidate]
                target[t] = initial[i, candidate]
                pivot = _append_to_cholesky(chol, gram_support, t)
                if pivot > SMALLEST_PIVOT:
                    break
                correlation[candidate] = 0
                largest = np.float32(0)
                for a in range(n_dictionary):
                    largest = max(largest, abs(correlation[a]))
            if pivot <= SMALLEST_PIVOT:
                break
            _solve_cholesky(chol, target, trial, t + 1)
            if quantized:
                _quantize_weights(levels, target, gram_support, trial, trial_code, t + 1)
            lowered = _residual_energy(energy[i], target, gram_support, trial, t + 1)
            if lowered >= error - price:
                break
            atom[i, t] = candidate
            t += 1
            error = lowered
            for j in range(t):
                weight[i, j] = trial[j]
                code[i, j] = trial_code[j]
        n_atoms[i] = t
        residual[i] = error


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def add_atoms(rows, dictionary, atom, weight, n_atoms):
    """Add to each row (n, d) float32 its weighted atoms: weight (n, r) float32 of dictionary (k, d) float32."""
    for i in range(rows.shape[0]):
        row = rows[i]
        for j in range(n_atoms[i]):
            x, texels = weight[i, j], dictionary[atom[i, j]]
            for d in range(row.shape[0]):
                row[d] += x * texels[d]


@numba.njit(cache=True, nogil=True)
def squared_norms(rows):
    """The squared norm of each row (n, d) float32, summed in float64, 8 partial sums wide in a fixed order."""
    norms = np.empty(rows.shape[0])
    partial = np.empty(8)
    for i in range(rows.shape[0]):
        partial[:] = 0.0
        whole = rows.shape[1] // 8 * 8
        for d in range(0, whole, 8):
            for lane in range(8):
                value = np.float64(rows[i, d + lane])
                partial[lane] += value * value
        total = partial.sum()
        for d in range(whole, rows.shape[1]):
            total += np.float64(rows[i, d]) ** 2
        norms[i] = total
    return norms
