"""Numbers of a splat by those of the splats around it that are known: what is meant, and what tells how sure that is.

Of up to NEAREST splats of the chunk told before it each counts by how near it is. Two planes through what they say,
one that bends as it likes and one that is held level, are the mean of what is meant. What is asked for the models:
how far the neighbours are apart, how far each of them was itself off, how far off others were lately, how far the
nearest is, and how far the two planes are apart.
"""

from __future__ import annotations

import numpy as np

from storage.packed.archive.coder import SIGNED, compiled, length_of, within
from storage.packed.archive.mixing import MOST_PLACES, SIGNED_SETS, mixed_signed

NEAREST = 8
SPREADS, OFFS, LATELY, APART, FAR, BEFORE = 16, 17, 16, 16, 8, 8  # of what is asked, how many answers
TURNS = 4  # of a splat's place in its chunk, in pairs of octaves
_SETS = (OFFS * TURNS, SPREADS * BEFORE, SPREADS * FAR, LATELY * OFFS, APART * SPREADS, OFFS * BEFORE)
N_VALUE_MODELS = sum(_SETS) * SIGNED  # of a field
N_VALUE_SETS = SIGNED_SETS
_SECOND, _THIRD, _FOURTH, _FIFTH, _SIXTH = (SIGNED * sum(_SETS[:k]) for k in range(1, 6))
assert len(_SETS) == MOST_PLACES
_SMOOTH, _FREE, _HELD = 0.3, 0.3, 3.0  # of a chunk's area a splat; how much level counts for both planes
_LONGEST = 2.0**40


@compiled
def octaves(x):
    """Twice the length of the whole part of x, and one more in its upper half; of 0 0."""
    whole = np.int64(min(x, _LONGEST))
    length = length_of(whole)
    return 2 * length + ((whole >> (length - 2)) & 1 if length > 1 else 0)


@compiled
def nearest(fields, order, i, steps, found, off):
    """The NEAREST splats to `order[i]` of those before it on the plane of columns 0 and 1, in `found`, of equals the
    last first, and the squares of their distances in `off`; how many there are. Where there are one or two the last
    stands again, so that three may be asked."""
    n, u, v = 0, fields[order[i], 0], fields[order[i], 1]
    for j in range(i - 1, -1, -1):
        splat = order[j]
        distance = ((u - fields[splat, 0]) * steps[0]) ** 2 + ((v - fields[splat, 1]) * steps[1]) ** 2
        if n == NEAREST and distance >= off[n - 1]:
            continue
        k = min(n, NEAREST - 1)
        while k > 0 and off[k - 1] > distance:
            off[k], found[k] = off[k - 1], found[k - 1]
            k -= 1
        off[k], found[k] = distance, splat
        n = min(n + 1, NEAREST)
    for k in range(n, 3):
        found[k] = found[n - 1] if n else 0
    return n


@compiled
def weigh(off, n, area, weight):
    """What each of the neighbours counts, 1 / (square of its distance + _SMOOTH area), and in the last place all of
    them; returns how far the nearest is, in octaves of the area, 0..FAR - 1."""
    total = 0.0
    for k in range(n):
        weight[k] = 1 / (off[k] + _SMOOTH * area + 1e-6)
        total += weight[k]
    weight[NEAREST] = total
    far, reach = 0, area / 32
    while n and far < FAR - 1 and off[0] > reach:
        far += 1
        reach *= 2
    return far


@compiled
def _plane(fields, splat, found, n, steps, weight, said, mean, level):
    """What the plane through what neighbours say has at the splat; `level` holds its slopes."""
    sx = sy = sz = sxx = sxy = syy = sxz = syz = 0.0
    for k in range(n):
        x = (fields[found[k], 0] - fields[splat, 0]) * steps[0]
        y = (fields[found[k], 1] - fields[splat, 1]) * steps[1]
        z, w = said[k] - mean, weight[k]
        sx, sy, sz = sx + w * x, sy + w * y, sz + w * z
        sxx, sxy, syy = sxx + w * x * x, sxy + w * x * y, syy + w * y * y
        sxz, syz = sxz + w * x * z, syz + w * y * z
    total = weight[NEAREST]
    xx, yy, xy = sxx - sx * sx / total + level, syy - sy * sy / total + level, sxy - sx * sy / total
    xz, yz = sxz - sx * sz / total, syz - sy * sz / total
    det = xx * yy - xy * xy
    return mean + (sz - sx * (xz * yy - yz * xy) / det - sy * (yz * xx - xz * xy) / det) / total


@compiled
def code_value(
    state,
    data,
    models,
    weights,
    base,
    which,
    fields,
    column,
    n_values,
    splat,
    found,
    n,
    steps,
    weight,
    said,
    asked,
    off,
    bases,
):
    """Writes or reads a field of 0..n_values - 1. `said` are those of the neighbours; `asked` (4,) what else is known:
    what is added to what is meant, how far the nearest is, the place in the chunk, how far the field before was off;
    `off` (n + 1, fields) how far each splat's was, and in its last row that of late;
    `bases` are the coder's. Returns how far it was off."""
    usual, spread, were, apart = n_values >> 1, 0, 0, 0
    if n:
        total, sum_, sum_off, sum_squares = weight[NEAREST], 0.0, 0.0, 0.0
        for k in range(n):
            sum_ += weight[k] * said[k]
            sum_off += weight[k] * off[found[k], column]
        mean = sum_ / total
        for k in range(n):
            sum_squares += weight[k] * (said[k] - mean) * (said[k] - mean)
        free = _plane(fields, splat, found, n, steps, weight, said, mean, _FREE)
        meant = (free + _plane(fields, splat, found, n, steps, weight, said, mean, _HELD)) / 2
        usual = np.int64(np.floor(min(max(meant, 0.0), n_values - 1.0) + 0.5)) + asked[0]
        usual = min(max(usual, 0), n_values - 1)
        spread = 1 + min(length_of(np.int64(min(4 * sum_squares / total, _LONGEST))), SPREADS - 2)
        were = 1 + min(octaves(4 * sum_off / total), OFFS - 2)
        bend = free - meant
        apart = 2 * min(length_of(np.int64(min(2 * abs(bend), _LONGEST))), APART // 2 - 1) + (1 if bend < 0 else 0)
    before, lately = asked[3], min(octaves(4 * off[-1, column]), LATELY - 1)
    signs = 2 * min(abs(before), BEFORE // 2 - 1) + (1 if before < 0 else 0)
    bases[0] = base + (were * TURNS + asked[2]) * SIGNED
    bases[1] = base + _SECOND + (spread * BEFORE + signs) * SIGNED
    bases[2] = base + _THIRD + (spread * FAR + asked[1]) * SIGNED
    bases[3] = base + _FOURTH + (lately * OFFS + were) * SIGNED
    bases[4] = base + _FIFTH + (apart * SPREADS + spread) * SIGNED
    bases[5] = base + _SIXTH + (were * BEFORE + min(length_of(abs(before)), BEFORE - 1)) * SIGNED
    found_off = mixed_signed(state, data, models, weights, bases, MOST_PLACES, which, fields[splat, column] - usual)
    fields[splat, column] = within(state, usual + found_off, n_values)
    size = min(abs(found_off), n_values)
    off[splat, column] = size
    off[-1, column] += (size - off[-1, column]) / 16
    return fields[splat, column] - usual
