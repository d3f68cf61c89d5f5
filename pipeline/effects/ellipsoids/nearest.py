"""Neighbourhoods by radius, else the k nearest, with the outlier rule of the 2020 paper, section 3.1."""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.neighbourhoods import (
    LEAST,
    LEAST_AFTER_OUTLIERS,
    MOST,
    OUTLIER_REACHES,
    Around,
    Neighbourhood,
    list_rows,
    rows_of_cells,
    rows_within,
)
from pipeline.execution.compiled import kernel

BINS = 256  # of squared distances, that members are put in order by


def gather(point: np.ndarray, around: Around, reach: float, unit: float = 1.0) -> Neighbourhood:
    """The neighbourhoods of `point` (n, 3) among `around`, which holds all within OUTLIER_REACHES reaches; a reach is
    at most `around.most_steps` of its cells. Offsets are in `unit`s.

    Members are those within `reach`, the nearest MOST of them; where they are fewer than LEAST, the nearest LEAST that
    are no outliers, nor more than so many cells away; where those are fewer than LEAST_AFTER_OUTLIERS, none. A point
    that thinning took out of `around` is put back.
    """
    offset, count = _nearest(point, around, reach, MOST, unit)
    few = np.flatnonzero(count < LEAST)
    if len(few):
        found = _nearest(point[few], around, min(OUTLIER_REACHES * reach, around.most_steps * around.edge), LEAST, unit)
        offset[few], count[few] = found[0], np.where(found[1] >= LEAST_AFTER_OUTLIERS, found[1], 0)
    return Neighbourhood(offset, count)


def narrowed(wide: Neighbourhood, reach: float) -> Neighbourhood:
    """`wide`, which was gathered in a longer reach but with the same cells, in `reach`: offsets are shared, beyond
    `count` they are others' then."""
    within = n_within(wide.offset, wide.count, reach)
    return Neighbourhood(wide.offset, np.where(within < LEAST, np.minimum(wide.count, LEAST), within))


@kernel()
def n_within(offset, count, reach):
    """How many of the first `count` (n,) of `offset` (n, k, 3), nearest first, lie within `reach`, (n,) int64."""
    within = np.empty_like(count)
    for i in range(len(count)):
        n = 0
        while n < count[i] and math.sqrt(offset[i, n, 0] ** 2 + offset[i, n, 1] ** 2 + offset[i, n, 2] ** 2) <= reach:
            n += 1
        within[i] = n
    return within


def _nearest(point: np.ndarray, around: Around, reach: float, most: int, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (n, MOST, 3) and count (n,) of the nearest within `reach`, the point itself and at most `most` with
    it."""
    if not around.is_grid or not len(point):
        return np.zeros((len(point), MOST, 3)), np.zeros(len(point), np.int64)
    offset, count = np.empty((len(point), MOST, 3)), np.zeros(len(point), np.int64)
    cell = around.cells(point)
    steps = math.ceil(reach / around.edge * (1 - 1e-9))
    known = (around.position, around.cell, around.rank, around.size)
    _nearest_within(point, cell, np.argsort(cell), *known, reach, around.edge, steps, most, unit, offset, count)
    return offset, count


@kernel(error_model="numpy")
def _nearest_within(
    point, of_point, order, around, of_around, rank, size, reach, edge, steps, most, unit, offset, count
):
    """Points by `order`, so that those of a cell come together; `around` in the order of its cells. Of members equally
    far away that of the lower `rank` comes first, so that no neighbourhood depends on where cells begin."""
    room, known, n_there = 1 << 9, np.int64(-1), 0
    rows = (2 * steps + 1) ** 2
    first, last, is_near = np.zeros(rows, np.int64), np.zeros(rows, np.int64), rows_within(steps, edge, reach)
    xs, ys, zs, away, number = np.empty(room), np.empty(room), np.empty(room), np.empty(room), np.empty(room, np.int64)
    found, begins = np.empty(room, np.int64), np.empty(BINS + 1, np.int64)
    member, distance = np.empty(room, np.int64), np.empty(room)
    for i in order:
        if of_point[i] != known:
            known = of_point[i]
            rows_of_cells(known, of_around, size, steps, first, last)
            n_there = ((last - first) * is_near).sum()
            if n_there > room:
                room = 2 * n_there
                xs, ys, zs, away = np.empty(room), np.empty(room), np.empty(room), np.empty(room)
                number, found = np.empty(room, np.int64), np.empty(room, np.int64)
                member, distance = np.empty(room, np.int64), np.empty(room)
            list_rows(around, first, last, is_near, xs, ys, zs, number)
        _squares(xs, ys, zs, n_there, point[i, 0], point[i, 1], point[i, 2], away)
        n = _within(away, n_there, reach, found)
        n = _in_order(away, number, rank, found, n, most, reach, begins, member, distance)
        itself = 1 if n == 0 or distance[0] > 0 else 0  # thinned out: put back
        n = min(n, most - itself)
        if itself:
            offset[i, 0] = 0
        for k in range(n):
            for axis in range(3):
                offset[i, k + itself, axis] = (around[member[k], axis] - point[i, axis]) / unit
        count[i] = n + itself
        offset[i, count[i] :] = 0


@kernel(error_model="numpy")
def _squares(xs, ys, zs, n, x, y, z, away):
    for j in range(n):
        dx, dy, dz = xs[j] - x, ys[j] - y, zs[j] - z
        away[j] = dx * dx + dy * dy + dz * dz


@kernel(error_model="numpy")
def _within(away, n_there, reach, found):
    """How many lie within `reach`, and which: `found`."""
    limit, n = _largest_square(reach), 0
    for j in range(n_there):  # with one comparison and no branch: a quarter of them lie within
        found[n] = j
        n += np.int64(away[j] <= limit)
    return n


@kernel(error_model="numpy")
def _largest_square(reach):
    """The largest number whose root is `reach` at most."""
    square = reach * reach
    while math.sqrt(square) > reach:
        square = np.nextafter(square, 0.0)
    while math.sqrt(np.nextafter(square, math.inf)) <= reach:
        square = np.nextafter(square, math.inf)
    return square


@kernel(error_model="numpy")
def _in_order(away, number, rank, found, n, most, reach, begins, member, distance):
    """The nearest `most` of the `n` that were found, or all of them: their numbers and squared distances, nearest
    first."""
    begins[:] = 0
    scale = (BINS - 1) / (reach * reach * (1 + 1e-12))
    for k in range(n):
        begins[int(away[found[k]] * scale) + 1] += 1
    last = 0
    for b in range(BINS):  # bins beyond `last` hold none of the nearest
        begins[b + 1] += begins[b]
        if begins[b] < most:
            last = b
    kept = 0
    for k in range(n):
        j = found[k]
        b = int(away[j] * scale)
        if b <= last:
            distance[begins[b]], member[begins[b]] = away[j], number[j]
            begins[b] += 1
            kept += 1
    for k in range(1, kept):
        d, m, at = distance[k], member[k], k
        while at > 0 and (distance[at - 1] > d or (distance[at - 1] == d and rank[member[at - 1]] > rank[m])):
            distance[at], member[at] = distance[at - 1], member[at - 1]
            at -= 1
        distance[at], member[at] = d, m
    return min(kept, most)
