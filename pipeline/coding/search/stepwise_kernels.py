"""The inner loop of certified OMP. Dimensions: n patches, k atoms, p components, d texels, t atoms of a support.

A residual r and an atom a, both split by an orthonormal basis P into p components and a rest, obey

    |<r, a>|  <=  |<Pr, Pa>| + |r - P'Pr| |a - P'Pa|

so that p-wide products leave only a few atoms that can be the best, and those are settled by products of full width.
Papers: Rubinstein et al. 2008 for the batch form; the bound is the Cauchy-Schwarz inequality in the rest.
"""

from __future__ import annotations

import numpy as np

from pipeline.coding.omp_kernels import (
    SMALLEST_CORRELATION,
    SMALLEST_PIVOT,
    append_to_cholesky,
    bound_groups,
    dot,
    n_groups,
    quantise_weights,
    residual_energy,
    solve_cholesky,
    subtract_rows,
)
from pipeline.execution.compiled import FAST, kernel, part

MOST_DEPENDENT = 64  # atoms in the span of the support that one step may pass over
# Rounding of the squared norm of a residual that is a sum of float32 products, as a share of the patch's.
ENERGY_ROUNDING = 4e-6


@part(fastmath=FAST)
def _four_dots(x, a, b, c, d):
    sa, sb, sc, sd = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
    for i in range(x.shape[0]):
        sa += x[i] * a[i]
        sb += x[i] * b[i]
        sc += x[i] * c[i]
        sd += x[i] * d[i]
    return np.float64(sa), np.float64(sb), np.float64(sc), np.float64(sd)


@part()
def _silence(product, support, t):
    """Atoms of the support raise no bound of their group: with quantised weights the residual may still lean on
    them."""
    for j in range(t):
        product[support[j]] = 0


@part()
def _is_in(values, n, value):
    for i in range(n):
        if values[i] == value:
            return True
    return False


@part()
def _products_with_support(atom, support, t, dictionary, into):
    """<atom, support_j> for every j < t, and for j = t with itself."""
    row = dictionary[atom]
    j = 0
    while j + 4 <= t:
        into[j], into[j + 1], into[j + 2], into[j + 3] = _four_dots(
            row,
            dictionary[support[j]],
            dictionary[support[j + 1]],
            dictionary[support[j + 2]],
            dictionary[support[j + 3]],
        )
        j += 4
    while j < t:
        into[j] = dot(row, dictionary[support[j]])
        j += 1
    into[t] = dot(row, row)


@part()
def _highest_of_group(product, rest, rho, g, width, support, t, passed, n_passed, best, best_bound):
    for a in range(g, product.shape[0], width):
        bound = abs(product[a]) + rho * rest[a]
        if bound > best_bound and not _is_in(support, t, a) and not _is_in(passed, n_passed, a):
            best, best_bound = a, bound
    return best, best_bound


@part()
def _highest_bound(product, rest, rho, upper, support, t, passed, n_passed):
    """The atom outside support and `passed` whose bound is highest; -1 for none."""
    width, top = upper.shape[0], 0
    for g in range(width):
        if upper[g] > upper[top]:
            top = g
    # The top group first: hardly another is looked into then.
    best, best_bound = _highest_of_group(
        product, rest, rho, top, width, support, t, passed, n_passed, -1, np.float32(-1)
    )
    for g in range(width):
        if upper[g] > best_bound and g != top:
            best, best_bound = _highest_of_group(
                product, rest, rho, g, width, support, t, passed, n_passed, best, best_bound
            )
    return best


@part()
def _best_atom(left, dictionary, product, rest, rho, margin, certify, upper, support, t, passed, n_passed):
    """The atom of largest |<r, a>| outside support and `passed`, of equals the first: its index (-1 for none), that
    size, and how many atoms were settled.

    The atom of the highest bound is settled first: only atoms with bounds above its size can beat it.
    """
    first = _highest_bound(product, rest, rho, upper, support, t, passed, n_passed)
    if first < 0:
        return -1, 0.0, 0
    best, best_size, n_settled = first, abs(dot(left, dictionary[first])), 1
    if not certify:
        return best, best_size, n_settled
    for g in range(upper.shape[0]):
        if upper[g] + margin < best_size:
            continue
        for a in range(g, product.shape[0], upper.shape[0]):
            if abs(product[a]) + rho * rest[a] + margin < best_size or a == first:
                continue
            if _is_in(support, t, a) or _is_in(passed, n_passed, a):
                continue
            size = abs(dot(left, dictionary[a]))
            n_settled += 1
            if size > best_size or (size == best_size and a < best):
                best, best_size = a, size
    return best, best_size, n_settled


@part()
def _add_atom(
    patch,
    left,
    energy,
    dictionary,
    product,
    rest,
    rho,
    margin,
    certify,
    upper,
    levels,
    t,
    error,
    atom,
    weight,
    code,
    target,
    forward,
    gram_support,
    chol,
    trial,
    trial_code,
    passed,
):
    """One step of a pursuit: the new squared residual, or -1 where no atom lowers it; and how many atoms were
    settled."""
    n_passed, n_settled = 0, 0
    while n_passed < MOST_DEPENDENT:
        best, size, n = _best_atom(
            left, dictionary, product, rest, rho, margin, certify, upper, atom, t, passed, n_passed
        )
        n_settled += n
        if best < 0 or size * size <= SMALLEST_CORRELATION**2 * energy:
            return -1.0, n_settled
        _products_with_support(best, atom, t, dictionary, gram_support[t])
        for j in range(t):
            gram_support[j, t] = gram_support[t, j]
        if append_to_cholesky(chol, gram_support, t) > SMALLEST_PIVOT:
            target[t] = dot(patch, dictionary[best])
            solve_cholesky(chol, target, forward, trial, t + 1)
            if levels.shape[1] > 0:
                quantise_weights(levels, target, gram_support, trial, trial_code, t + 1)
            lowered = residual_energy(energy, target, gram_support, trial, t + 1)
            if lowered >= error:
                return -1.0, n_settled
            atom[t] = best
            for j in range(t + 1):
                weight[j] = trial[j]
                code[j] = trial_code[j]
            return lowered, n_settled
        passed[n_passed] = best
        n_passed += 1
    return -1.0, n_settled


@part()
def _what_is_left(patch, dictionary, atom, weight, t, left):
    """The residual, in `left` once there is a support."""
    if t == 0:
        return patch
    left[:] = patch
    subtract_rows(left, dictionary, atom, weight, t)
    return left


@part()
def _rest_norm(error, short_residual, energy):
    """The norm of what the components leave of a residual, rounded up."""
    inside = 0.0
    for c in range(short_residual.shape[0]):
        inside += np.float64(short_residual[c]) * short_residual[c]
    return np.float32(np.sqrt(max(error - inside, 0.0) + ENERGY_ROUNDING * energy) * (1 + 1e-6))


@part()
def _margin(rounding, energy, weight, t):
    """How far float32 may take a short product from its value: its terms have this norm at most."""
    total = np.sqrt(energy)
    for j in range(t):
        total += abs(weight[j])
    return rounding * total


@kernel()
def advance(
    patches,
    energy,
    dictionary,
    components,
    short,
    product,
    rest,
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
):
    """One step for each of the patches active[:n_active], whose current short products are the rows of `product`.

    `components` become those of the residuals; patches that are done leave `active`. Per patch: target and
    forward (n, r), gram_support and chol (n, r, r). Returns how many stay active, and how many products of full width
    it took.
    """
    most = atom.shape[1]
    upper, passed = np.empty(n_groups(product.shape[1]), np.float32), np.empty(MOST_DEPENDENT, np.int64)
    trial, trial_code = np.empty(most), np.zeros(most, np.int32)
    left = np.empty(patches.shape[1], np.float32)
    n_left, total = 0, 0
    start = np.empty(components.shape[1], np.float32)
    for m in range(n_active):
        i, t = active[m], n_atoms[active[m]]
        rho, margin = np.float32(0), 0.0
        if certify:
            rho = _rest_norm(path[i, t], components[m], energy[i])
            margin = _margin(rounding, energy[i], weight[i], t)
        _silence(product[m], atom[i], t)
        bound_groups(product[m], rest, rho, upper)
        start[:] = components[m]
        subtract_rows(
            start, short, atom[i], -weight[i], t
        )  # back to the patch's own components: weights of all ranks may change
        residue = _what_is_left(patches[i], dictionary, atom[i], weight[i], t, left)
        lowered, n_settled = _add_atom(
            patches[i],
            residue,
            energy[i],
            dictionary,
            product[m],
            rest,
            rho,
            margin,
            certify,
            upper,
            levels,
            t,
            path[i, t] - multiplier,
            atom[i],
            weight[i],
            code[i],
            target[i],
            forward[i],
            gram_support[i],
            chol[i],
            trial,
            trial_code,
            passed,
        )
        total += n_settled
        if lowered < 0:
            continue
        path[i, t + 1] = lowered
        n_atoms[i] = t + 1
        if t + 1 < most and lowered > tolerance[i]:
            subtract_rows(start, short, atom[i], weight[i], t + 1)
            components[n_left] = start
            active[n_left] = i
            n_left += 1
    return n_left, total
