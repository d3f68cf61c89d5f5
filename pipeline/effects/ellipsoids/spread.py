"""How members of a neighbourhood spread: its own eigenvalues, which decide most splats without a list of members.

Offsets are counted in whole units of reach / UNITS, so that sums in float32 are exact for up to MOST members, whatever
their order: the compiler may add eight at once, and no bit depends on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.effects.ellipsoids.neighbourhoods import MOST, Around, rows_of_cells
from pipeline.execution.compiled import FAST, kernel, part

UNITS = 320  # of a reach: MOST squares of it are below 2^24, and rounding is 0.002 of a reach at most
AT_FIRST = 1 << 9  # candidates about a cell; more are made room for


@dataclass(frozen=True)
class Spread:
    """Of each point. Counted are the members within the reach, and the point itself where thinning took it out."""

    count: np.ndarray  # (n,) int64; above MOST nothing else is told
    is_wide: np.ndarray  # (n,) bool: the second deviation is above what was asked for
    deviation: np.ndarray  # (n, 3) float64, longest first; zeros where it is


def spread_of(point: np.ndarray, around: Around, reach: float, second: float) -> Spread:
    """How the neighbours of `point` (n, 3) within `reach` spread, as `around` holds them; one is wide with a second
    deviation above `second`.

    Guarantees: as of all members within a unit of their places; the same bits for the same points, in whatever company.
    """
    n = len(point)
    count, is_wide, deviation = np.zeros(n, np.int64), np.zeros(n, bool), np.zeros((n, 3))
    if around.is_grid and len(point):
        cell = around.cells(point)
        order = np.argsort(cell)
        steps = math.ceil(reach / around.edge * (1 - 1e-9))
        known = (around.position, around.cell, around.size, around.low, around.edge)
        _spread(point, cell, order, *known, steps, UNITS / reach, second, count, is_wide, deviation)
    return Spread(count, is_wide, deviation)


@kernel(error_model="numpy")
def _spread(
    point, of_point, order, around, of_around, size, low, edge, steps, scale, second, count, is_wide, deviation
):
    n_rows = (2 * steps + 1) ** 2
    first, last = np.zeros(n_rows, np.int64), np.zeros(n_rows, np.int64)
    members, sums = np.empty((3, AT_FIRST), np.float32), np.empty(10, np.float32)
    middle, p = np.empty(3), np.empty(3, np.float32)
    known, n = np.int64(-1), 0
    for i in order:
        if of_point[i] != known:
            known = of_point[i]
            rows_of_cells(known, of_around, size, steps, first, last)
            n = 0
            for r in range(n_rows):
                n += last[r] - first[r]
            if n > members.shape[1]:
                members = np.empty((3, 2 * n), np.float32)
            slab = known
            for axis in (2, 1, 0):
                middle[axis] = low[axis] + (slab % size[axis] + 0.5) * edge
                slab //= size[axis]
            n = 0
            for r in range(n_rows):
                for j in range(first[r], last[r]):
                    for axis in range(3):
                        members[axis, n] = np.rint((around[j, axis] - middle[axis]) * scale)
                    n += 1
        for axis in range(3):
            p[axis] = np.rint((point[i, axis] - middle[axis]) * scale)
        _sums(members[0], members[1], members[2], n, p[0], p[1], p[2], sums)
        count[i] = np.int64(sums[0])
        if not _has_at(members, n, p):
            count[i] += 1
        if count[i] < 2 or count[i] > MOST:
            continue
        k, x, y, z = np.float64(count[i]), np.float64(sums[1]), np.float64(sums[2]), np.float64(sums[3])
        d = k - 1
        xx, xy, xz = (sums[4] - x * x / k) / d, (sums[5] - x * y / k) / d, (sums[6] - x * z / k) / d
        yy, yz, zz = (sums[7] - y * y / k) / d, (sums[8] - y * z / k) / d, (sums[9] - z * z / k) / d
        is_wide[i] = _two_above(xx, xy, xz, yy, yz, zz, (second * scale) ** 2)
        if not is_wide[i]:
            for a, value in enumerate(_eigenvalues(xx, xy, xz, yy, yz, zz)):
                deviation[i, a] = math.sqrt(max(value, 0.0)) / scale


@part(fastmath=FAST)
def _sums(xs, ys, zs, n, px, py, pz, sums):
    limit, one, none = np.float32(UNITS * UNITS), np.float32(1), np.float32(0)
    k = x = y = z = xx = xy = xz = yy = yz = zz = none
    for j in range(n):
        dx, dy, dz = xs[j] - px, ys[j] - py, zs[j] - pz
        w = one if dx * dx + dy * dy + dz * dz <= limit else none
        wx, wy, wz = w * dx, w * dy, w * dz
        k, x, y, z = k + w, x + wx, y + wy, z + wz
        xx, xy, xz = xx + wx * dx, xy + wx * dy, xz + wx * dz
        yy, yz, zz = yy + wy * dy, yz + wy * dz, zz + wz * dz
    sums[0], sums[1], sums[2], sums[3] = k, x, y, z
    sums[4], sums[5], sums[6], sums[7], sums[8], sums[9] = xx, xy, xz, yy, yz, zz


@part()
def _has_at(members, n, p):
    found = False
    for j in range(n):
        found |= (members[0, j] == p[0]) & (members[1, j] == p[1]) & (members[2, j] == p[2])
    return found


@part(error_model="numpy")
def _two_above(xx, xy, xz, yy, yz, zz, t):
    """Whether two eigenvalues of a symmetric matrix or more are above `t`: by the signs of the pivots of A - t
    (Sylvester)."""
    a = xx - t
    if a == 0:
        a = 1e-300
    b = yy - t - xy * xy / a
    if b == 0:
        b = 1e-300
    off = yz - xy * xz / a
    c = zz - t - xz * xz / a - off * off / b
    return (a > 0) + (b > 0) + (c > 0) >= 2


@part(error_model="numpy")
def _eigenvalues(xx, xy, xz, yy, yz, zz):
    """Of a symmetric matrix, largest first, in closed form (O. K. Smith, Eigenvalues of a symmetric 3 x 3 matrix,
    1961)."""
    off = xy * xy + xz * xz + yz * yz
    mean = (xx + yy + zz) / 3
    spread = math.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off) / 6)
    if spread == 0:
        return mean, mean, mean
    a, b, c = (xx - mean) / spread, (yy - mean) / spread, (zz - mean) / spread
    p, q, r = xy / spread, xz / spread, yz / spread
    half = (a * (b * c - r * r) - p * (p * c - r * q) + q * (p * r - b * q)) / 2
    angle = math.acos(min(1.0, max(-1.0, half))) / 3
    largest = mean + 2 * spread * math.cos(angle)
    smallest = mean + 2 * spread * math.cos(angle + 2 * math.pi / 3)
    return largest, 3 * mean - largest - smallest, smallest
