"""Where so many points lie about one that no neighbourhood holds more."""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.neighbourhoods import MOST, Around, list_rows, rows_of_cells, rows_within
from pipeline.execution.compiled import kernel


def is_full(point: np.ndarray, around: Around, reach: float) -> np.ndarray:
    """Where MOST of `around` or more lie within `reach` of `point` (n, 3), (n,) bool; a reach is at most
    `around.most_steps` cells."""
    full = np.zeros(len(point), bool)
    if around.is_grid and len(point):
        cell = around.cells(point)
        steps = math.ceil(reach / around.edge * (1 - 1e-9))
        known = (around.position, around.cell, around.size)
        _fill(point, cell, np.argsort(cell), *known, reach, around.edge, steps, full)
    return full


@kernel(error_model="numpy")
def _fill(point, of_point, order, around, of_around, size, reach, edge, steps, full):
    room, known, n_there = 1 << 9, np.int64(-1), 0
    rows = (2 * steps + 1) ** 2
    first, last, is_near = np.zeros(rows, np.int64), np.zeros(rows, np.int64), rows_within(steps, edge, reach)
    xs, ys, zs, number = np.empty(room), np.empty(room), np.empty(room), np.empty(room, np.int64)
    for i in order:
        if of_point[i] != known:
            known = of_point[i]
            rows_of_cells(known, of_around, size, steps, first, last)
            n_there = ((last - first) * is_near).sum()
            if n_there > room:
                room = 2 * n_there
                xs, ys, zs, number = np.empty(room), np.empty(room), np.empty(room), np.empty(room, np.int64)
            list_rows(around, first, last, is_near, xs, ys, zs, number)
        full[i] = (
            n_there >= MOST and _n_within(xs, ys, zs, n_there, point[i, 0], point[i, 1], point[i, 2], reach) >= MOST
        )


@kernel(error_model="numpy")
def _n_within(xs, ys, zs, n, x, y, z, reach):
    within = np.int64(0)
    for j in range(n):
        dx, dy, dz = xs[j] - x, ys[j] - y, zs[j] - z
        within += np.int64(dx * dx + dy * dy + dz * dz <= reach * reach)
    return within
