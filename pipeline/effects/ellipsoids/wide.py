"""What a neighbourhood's own eigenvalues decide alone: splats amid a surface, which are most, and are discs without further ado.

The moments of all members within the reach, by a kernel that walks the cells of a grid: the same members and covariance as
`gather` and `moments` have, without a list of them.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.neighbourhoods import LEAST, MOST, Around, rows_of_cells
from pipeline.execution.compiled import kernel


def are_wide(point: np.ndarray, around: Around, reach: float, second: float) -> np.ndarray:
    """Which neighbourhoods have a second deviation above `second`, (n,) bool; `point` (n, 3), `around` as `gather` takes them.

    Guarantees: false where the members within the reach are fewer than LEAST or more than MOST, where `gather` takes others.
    """
    wide = np.zeros(len(point), bool)
    if not around.is_grid or not len(point):
        return wide
    cell = around.cells(point)
    order = np.argsort(cell, kind="stable")
    steps = math.ceil(reach / around.edge * (1 - 1e-9))
    _decide(point, cell, order, around.position, around.cell, around.size, steps, reach, second, wide)
    return wide


@kernel()
def _decide(point, of_point, order, around, of_around, size, steps, reach, second, wide):
    n_rows = (2 * steps + 1) ** 2
    first, last = np.empty(n_rows, np.int64), np.empty(n_rows, np.int64)
    known = np.int64(-1)
    for i in order:
        if of_point[i] != known:
            known = of_point[i]
            rows_of_cells(known, of_around, size, steps, first, last)
        wide[i] = _second_above(point[i], around, first, last, reach, second)


@kernel()
def _second_above(point, around, first, last, reach, second):
    n, at_itself = 0, False
    x = y = z = xx = xy = xz = yy = yz = zz = 0.0
    for r in range(len(first)):
        for j in range(first[r], last[r]):
            dx, dy, dz = around[j, 0] - point[0], around[j, 1] - point[1], around[j, 2] - point[2]
            away = dx * dx + dy * dy + dz * dz
            if away > reach * reach:
                continue
            n += 1
            at_itself = at_itself or away == 0
            x, y, z = x + dx, y + dy, z + dz
            xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
            yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
    n += not at_itself
    if n < LEAST or n > MOST:
        return False
    d = n - 1.0
    return (
        _second_eigenvalue(
            (xx - x * x / n) / d,
            (xy - x * y / n) / d,
            (xz - x * z / n) / d,
            (yy - y * y / n) / d,
            (yz - y * z / n) / d,
            (zz - z * z / n) / d,
        )
        > second * second
    )


@kernel()
def _second_eigenvalue(xx, xy, xz, yy, yz, zz):
    """Of a symmetric matrix, in closed form (O. K. Smith, Eigenvalues of a symmetric 3 x 3 matrix, 1961)."""
    off = xy * xy + xz * xz + yz * yz
    mean = (xx + yy + zz) / 3
    spread = math.sqrt(((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off) / 6)
    if spread == 0:
        return mean
    a, b, c = (xx - mean) / spread, (yy - mean) / spread, (zz - mean) / spread
    p, q, r = xy / spread, xz / spread, yz / spread
    half = (a * (b * c - r * r) - p * (p * c - r * q) + q * (p * r - b * q)) / 2
    angle = math.acos(min(1.0, max(-1.0, half))) / 3
    largest = mean + 2 * spread * math.cos(angle)
    smallest = mean + 2 * spread * math.cos(angle + 2 * math.pi / 3)
    return 3 * mean - largest - smallest
