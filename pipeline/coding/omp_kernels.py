"""The inner loop of batch OMP. Dimensions: n patches, k atoms, t atoms of a support, r ranks, w weight levels.

Correlations run in float32, k wide; everything of the size of a support runs in float64. One thread, no BLAS, no
reassociation between patches: the result of a patch does not depend on its neighbours. Inner loops count in unsigned
numbers: an index that may be negative keeps the compiler from vector code.
"""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import FAST, kernel, part

# A squared pivot below this says that the atom lies in the span of the support, as far as float32 can tell. The Gram
# matrix is exact to 1e-7, so weights to 1e-7 / pivot: on differences of coherent atoms the residual norm was 5e-4 above
# the least squares with pivots of 2e-4, and 2.4e-5 with 2e-3. On 4,000 patches of fountain_p11 with 8 of 256 atoms
# pivots stay above 0.16.
SMALLEST_PIVOT = 2e-3
# A correlation below this share of the patch's norm is float32 rounding of a GEMM over 3072 terms, not signal.
SMALLEST_CORRELATION = 1e-6


TRUSTED = np.float32(
    1e-6
)  # share of its slack that a product keeps which is not to be certified: it decides nothing, but is no zero
ONLY_IDENTITY = np.zeros((1, 1), np.int64)  # the quotients of a dictionary of one symmetry


@part(fastmath=FAST)
def dot(x, y):
    """The inner product of two float32 vectors, summed in float32, in order."""
    total = np.float32(0)
    for i in range(x.shape[0]):
        total += x[i] * y[i]
    return np.float64(total)


@part(fastmath=FAST)
def subtract_rows(row, table, support, weight, t):
    """row -= sum of weight_j * table[support_j]; four at a time, as loads and stores of `row` are what costs."""
    width, j = np.uintp(row.shape[0]), 0
    while j + 4 <= t:
        a, b, c, d = np.uintp(support[j]), np.uintp(support[j + 1]), np.uintp(support[j + 2]), np.uintp(support[j + 3])
        wa, wb = np.float32(weight[j]), np.float32(weight[j + 1])
        wc, wd = np.float32(weight[j + 2]), np.float32(weight[j + 3])
        for i in range(width):
            row[i] -= (wa * table[a, i] + wb * table[b, i]) + (wc * table[c, i] + wd * table[d, i])
        j += 4
    while j < t:
        a, wa = np.uintp(support[j]), np.float32(weight[j])
        for i in range(width):
            row[i] -= wa * table[a, i]
        j += 1


@part(fastmath=FAST)
def _subtract_gram_rows(row, gram, quotients, straight, turn, weight, t):
    """As `subtract_rows`, with rows of the Gram matrix of atoms in all symmetries, of which `gram` has those in
    symmetry 0 (`pursue`)."""
    k, n_turns, j = np.uintp(gram.shape[0]), quotients.shape[0], 0
    while j + 4 <= t:
        a, b, c, d = (
            np.uintp(straight[j]),
            np.uintp(straight[j + 1]),
            np.uintp(straight[j + 2]),
            np.uintp(straight[j + 3]),
        )
        wa, wb = np.float32(weight[j]), np.float32(weight[j + 1])
        wc, wd = np.float32(weight[j + 2]), np.float32(weight[j + 3])
        for s in range(n_turns):
            at = np.uintp(s) * k
            at_a, at_b = np.uintp(quotients[turn[j], s]) * k, np.uintp(quotients[turn[j + 1], s]) * k
            at_c, at_d = np.uintp(quotients[turn[j + 2], s]) * k, np.uintp(quotients[turn[j + 3], s]) * k
            for i in range(k):
                row[at + i] -= (wa * gram[a, at_a + i] + wb * gram[b, at_b + i]) + (
                    wc * gram[c, at_c + i] + wd * gram[d, at_d + i]
                )
        j += 4
    while j < t:
        a, wa = np.uintp(straight[j]), np.float32(weight[j])
        for s in range(n_turns):
            at, at_a = np.uintp(s) * k, np.uintp(quotients[turn[j], s]) * k
            for i in range(k):
                row[at + i] -= wa * gram[a, at_a + i]
        j += 1


@part()
def n_groups(k):
    """Groups of atoms that share a bound: about 4 sqrt(k), so that finding a group costs no more than a group."""
    n = 64
    while n * n < 16 * k:
        n *= 2
    return n


@part(fastmath=FAST)
def bound_groups(product, rest, rho, upper):
    """The largest |product| + rho * rest of each group. Group g are the atoms g, g + w, g + 2w ... of w groups: maxima
    of whole rows are 10 times as fast as a maximum along a row, which no compiler here turns into vector code."""
    n_atoms, width, start = np.uintp(product.shape[0]), np.uintp(upper.shape[0]), np.uintp(0)
    for g in range(width):
        upper[g] = 0
    while start < n_atoms:
        for g in range(min(width, n_atoms - start)):
            upper[g] = max(upper[g], abs(product[start + g]) + rho * rest[start + g])
        start += width


@part(fastmath=FAST)
def largest_of(values):
    """The largest of float32 values, and 0 where none is above it."""
    largest = np.float32(0)
    for i in range(values.shape[0]):
        largest = max(largest, values[i])
    return largest


@part()
def _of_highest_bound(correlation, slack, upper):
    """The atom of the highest bound, of equals the first of the first group that has it; -1 for none above zero."""
    top, best, highest = largest_of(upper), -1, np.float32(-1)
    if top > 0:
        g = 0
        while upper[g] < top:
            g += 1
        for a in range(g, correlation.shape[0], upper.shape[0]):
            if abs(correlation[a]) + slack[a] > highest:
                best, highest = a, abs(correlation[a]) + slack[a]
    return best


@part()
def _settle(a, patch, dictionary, initial, correlation, slack):
    """Make the correlation of atom a exact by a product of full width."""
    exact = np.float32(dot(patch, dictionary[a]))
    correlation[a] += exact - initial[a]
    initial[a] = exact
    slack[a] = 0


@part()
def _most_correlated(patch, dictionary, initial, correlation, slack, certify, upper):
    """The atom of largest exact |correlation|, -1 for none above zero; not to `certify`, that of the highest bound,
    settled.

    The atom of the highest bound is settled first: only those with bounds above its size can beat it.
    """
    bound_groups(correlation, slack, np.float32(1), upper)
    best = _of_highest_bound(correlation, slack, upper)
    if best < 0 or slack[best] == 0:
        return best
    _settle(best, patch, dictionary, initial, correlation, slack)
    if not certify:
        return best
    size = abs(correlation[best])
    for g in range(upper.shape[0]):
        if upper[g] < size:
            continue
        for a in range(g, correlation.shape[0], upper.shape[0]):
            if a == best or abs(correlation[a]) + slack[a] < size:
                continue
            if slack[a] > 0:
                _settle(a, patch, dictionary, initial, correlation, slack)
            if abs(correlation[a]) > size:
                best, size = a, abs(correlation[a])
    return best


@part()
def append_to_cholesky(chol, gram_support, t):
    """Extend the factor of the support's Gram matrix by row t; returns the squared pivot. On its diagonal `chol` has
    the reciprocals of the factor's: divisions would take as long as all else."""
    pivot = gram_support[t, t]
    for i in range(t):
        value = gram_support[t, i]
        for j in range(i):
            value -= chol[t, j] * chol[i, j]
        chol[t, i] = value * chol[i, i]
        pivot -= chol[t, i] * chol[t, i]
    if pivot > 0:
        chol[t, t] = 1 / np.sqrt(pivot)
    return pivot


@part()
def solve_cholesky(chol, target, forward, weight, t):
    """Least squares on the support, chol @ chol.T @ weight = target, t wide: chol @ forward = target is solved for row
    t - 1 alone, as those above it do not change with a further atom."""
    value = target[t - 1]
    for j in range(t - 1):
        value -= chol[t - 1, j] * forward[j]
    forward[t - 1] = value * chol[t - 1, t - 1]
    for i in range(t - 1, -1, -1):
        value = forward[i]
        for j in range(i + 1, t):
            value -= chol[j, i] * weight[j]
        weight[i] = value * chol[i, i]


@part()
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


@part()
def quantise_weights(levels, target, gram_support, weight, code, t):
    """Replace least-squares weights by levels, then let each in turn take up what the others' rounding left.

    A sweep never raises the error: each weight moves to the level nearest to its optimum given the others. Two sweeps
    settle supports of 8 (on 4,000 patches of fountain_p11 a third changes 1.3 weights in 1,000).
    """
    for j in range(t):
        code[j] = nearest_level(levels[j], weight[j])
        weight[j] = levels[j, code[j]]
    for _ in range(2):
        moved = False
        for j in range(t):
            optimum = target[j]
            for i in range(t):
                if i != j:
                    optimum -= gram_support[j, i] * weight[i]
            nearest = nearest_level(levels[j], optimum / gram_support[j, j])
            moved |= nearest != code[j]
            code[j] = nearest
            weight[j] = levels[j, nearest]
        if not moved:
            break


@part()
def residual_energy(energy, target, gram_support, weight, t):
    """|y - sum of weight_j d_j|^2 by the Gram matrix."""
    for i in range(t):
        energy -= 2 * weight[i] * target[i]
        for j in range(t):
            energy += weight[i] * weight[j] * gram_support[i, j]
    return max(energy, 0.0)


@kernel()
def pursue(
    patches,
    dictionary,
    initial,
    spread,
    rest,
    certify,
    energy,
    gram,
    quotients,
    tolerance,
    multiplier,
    levels,
    atom,
    weight,
    code,
    n_atoms,
    path,
):
    """Orthogonal matching pursuit of every row of patches (n, d), with weights from `levels` if there are any.

    dictionary (k, d); initial (n, k): correlations of patches and atoms, no further off than spread (n,) times rest
    (k,), and made exact where that may decide, in place (not to `certify`, of atoms that are taken alone); gram (k / m,
    k) of the first k / m atoms, all float32; quotients (m, m) int64, atom i being atom i mod (k / m) in symmetry i //
    (k / m): <turn(a, t), turn(b, s)> = <a, turn(b, quotients[t, s])>, so ((0,),) where there is one symmetry. energy
    (n,) float64: squared norms; tolerance (n,) float64: squared residual at which a patch is done; multiplier
    (Lagrange): by how much more than that an atom must lower it; levels (r, w) float64, w = 0 for exact weights.
    Filled: atom (n, r) int32, weight (n, r) float64, code (n, r) int32, n_atoms (n,) int32, path (n, r + 1) float64:
    the squared residual with no atom, one, and so on. It never rises with an atom: one that would not lower it ends the
    pursuit.
    """
    n, n_dictionary = initial.shape
    most = atom.shape[1]
    quantised = levels.shape[1] > 0
    correlation, slack = np.empty(n_dictionary, np.float32), np.empty(n_dictionary, np.float32)
    upper = np.empty(n_groups(n_dictionary), np.float32)
    gram_support = np.empty((most, most))
    chol = np.empty((most, most))
    target, forward, trial = np.empty(most), np.empty(most), np.empty(most)
    trial_code = np.zeros(most, np.int32)
    straight, turn, n_straight = np.empty(most, np.int64), np.empty(most, np.int64), gram.shape[0]
    felt = np.empty(most)  # weights that the correlations have felt
    moved_straight, moved_turn, moved = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    for i in range(n):
        t = 0
        error = path[i, 0] = energy[i]
        trust = np.float32(1) if certify else TRUSTED
        for a in range(n_dictionary):
            slack[a] = trust * spread[i] * rest[a]
        anew = True
        while t < most and error > tolerance[i]:
            if anew:
                correlation[:] = initial[i]
                felt[:] = 0
            n_moved = 0
            for j in range(t):
                if weight[i, j] != felt[j]:
                    moved_straight[n_moved], moved_turn[n_moved], moved[n_moved] = (
                        straight[j],
                        turn[j],
                        weight[i, j] - felt[j],
                    )
                    felt[j] = weight[i, j]
                    n_moved += 1
            _subtract_gram_rows(correlation, gram, quotients, moved_straight, moved_turn, moved, n_moved)
            for j in range(t):
                correlation[atom[i, j]] = 0
            pivot, anew = 0.0, False
            while pivot <= SMALLEST_PIVOT:
                best = _most_correlated(patches[i], dictionary, initial[i], correlation, slack, certify, upper)
                if best < 0 or np.float64(correlation[best]) ** 2 <= SMALLEST_CORRELATION**2 * energy[i]:
                    break
                straight[t], turn[t] = best % n_straight, best // n_straight
                for j in range(t + 1):
                    gram_support[t, j] = gram[straight[t], quotients[turn[t], turn[j]] * n_straight + straight[j]]
                    gram_support[j, t] = gram_support[t, j]
                target[t] = initial[i, best]
                pivot = append_to_cholesky(chol, gram_support, t)
                correlation[best] = 0
                anew = anew or pivot <= SMALLEST_PIVOT  # an atom that was passed over counts again in the next step
            if pivot <= SMALLEST_PIVOT:
                break
            solve_cholesky(chol, target, forward, trial, t + 1)
            if quantised:
                quantise_weights(levels, target, gram_support, trial, trial_code, t + 1)
                lowered = residual_energy(energy[i], target, gram_support, trial, t + 1)
            else:
                lowered = max(error - forward[t] ** 2, 0.0)
            if lowered >= error - multiplier:
                break
            atom[i, t] = best
            t += 1
            error = path[i, t] = lowered
            for j in range(t):
                weight[i, j] = trial[j]
                code[i, j] = trial_code[j]
        n_atoms[i] = t


@kernel(fastmath={"contract"})
def add_atoms(rows, dictionary, atom, weight, n_atoms):
    """Add to each row (n, d) float32 its weighted atoms: weight (n, r) float32 of dictionary (k, d) float32."""
    for i in range(rows.shape[0]):
        row = rows[i]
        for j in range(n_atoms[i]):
            x, texels = weight[i, j], dictionary[atom[i, j]]
            for d in range(row.shape[0]):
                row[d] += x * texels[d]


@kernel(fastmath={"nsz", "reassoc", "contract"})
def squared_norms(rows):
    """The squared norm of each row (n, d) float32, summed in float64; not finite where a value is not."""
    norms = np.empty(rows.shape[0])
    for i in range(rows.shape[0]):
        total = 0.0
        for d in range(np.uintp(rows.shape[1])):
            value = np.float64(rows[i, d])
            total += value * value
        norms[i] = total
    return norms
