"""Points near an iso-surface, moved onto it; and the slope there."""

from __future__ import annotations

import math

from pipeline.execution.compiled import kernel, part
from pipeline.geometry.hcp import N_NEIGHBOURS, REACH, centre_of, index_of, neighbour
from pipeline.volumes.field import gradient_at, value_at

ROUNDS, WIDENINGS, NARROWINGS = 4, 8, 24  # steps down the slope to beyond the surface, and back
CLOSE, FAR = 1e-3, 1e-2  # of a cell: near enough to stop, and too far to be left there


@part()
def _along(voxels, k0, x, y, z, ux, uy, uz, way, iso, off, first, most, near, to_voxels, method, weights):
    """How far to go from a point along (ux, uy, uz), at most `most`, to be nearest to the surface; and where it was crossed, or 0.

    `off`, below 0, is `way` times the value there less iso. The first crossing is looked for in growing steps, and then closed in on by
    false position and halving in turn."""
    best_t, best = 0.0, abs(off)
    low_t, low, high_t, high = 0.0, off, 0.0, 0.0
    step = min(first, most / 2)
    for _ in range(WIDENINGS):
        t = min(low_t + step, most)
        if t == low_t:
            break
        there = way * (_value(voxels, k0, x + t * ux, y + t * uy, z + t * uz, to_voxels, method, weights) - iso)
        if math.isnan(there):
            break
        if abs(there) < best:
            best_t, best = t, abs(there)
        if there >= 0:
            high_t, high = t, there
            break
        low_t, low, step = t, there, 1.5 * step
    for turn in range(NARROWINGS):
        if high_t == 0.0 or best <= near or high_t - low_t <= 1e-4 * most:
            break
        t = low_t - low * (high_t - low_t) / (high - low) if turn % 2 == 0 else (low_t + high_t) / 2
        there = way * (_value(voxels, k0, x + t * ux, y + t * uy, z + t * uz, to_voxels, method, weights) - iso)
        if abs(there) < best:
            best_t, best = t, abs(there)
        if there >= 0:
            high_t, high = t, there
        else:
            low_t, low = t, there
    return best_t, high_t


@kernel()
def settle(voxels, k0, key, position, iso, size, stretch, to_voxels, method, weights, gradient, off):
    """Move points onto the surface, no further than a cell, and never to where they are further off: down the slope; where it is flat, or
    that leads nowhere, towards the neighbouring cell on the other side that is reached first."""
    for n in range(len(position)):
        x, y, z = position[n]
        value, gx, gy, gz = _look(voxels, k0, x, y, z, to_voxels, method, weights)
        steep = math.sqrt(gx * gx + gy * gy + gz * gz)
        left = REACH * size
        for _ in range(ROUNDS):
            near = CLOSE * size * steep
            if not steep > 0 or abs(value - iso) <= near:
                break
            way = 1.0 if value < iso else -1.0
            ux, uy, uz = way * gx / steep, way * gy / steep, way * gz / steep
            first = abs(value - iso) / steep
            t, _ = _along(
                voxels,
                k0,
                x,
                y,
                z,
                ux,
                uy,
                uz,
                way,
                iso,
                way * (value - iso),
                first,
                left,
                near,
                to_voxels,
                method,
                weights,
            )
            if t == 0.0:
                break
            x, y, z = _held(voxels, k0, x + t * ux, y + t * uy, z + t * uz, stretch, to_voxels)
            left -= t
            value, gx, gy, gz = _look(voxels, k0, x, y, z, to_voxels, method, weights)
            steep = math.sqrt(gx * gx + gy * gy + gz * gz)
        if value != iso and not abs(value - iso) <= FAR * size * steep:
            cx, cy, cz = position[n]
            start = _value(voxels, k0, cx, cy, cz, to_voxels, method, weights)
            way = 1.0 if start < iso else -1.0
            column, row, slice_ = index_of(key[n])
            ox, oy, oz = centre_of(column, row, slice_, size)
            best = math.inf
            for k in range(N_NEIGHBOURS):
                n_column, n_row, n_slice = neighbour(column, row, slice_, k)
                ux, uy, uz = centre_of(n_column, n_row, n_slice, size)
                ux, uy, uz = (ux - ox) / size, (uy - oy) / size, (uz - oz) / size
                t, crossed = _along(
                    voxels,
                    k0,
                    cx,
                    cy,
                    cz,
                    ux,
                    uy,
                    uz,
                    way,
                    iso,
                    way * (start - iso),
                    size / 4,
                    size,
                    0.0,
                    to_voxels,
                    method,
                    weights,
                )
                t = t if t > 0 else crossed  # a value that jumps over iso is nearest to it on one side
                tx, ty, tz = _held(voxels, k0, cx + t * ux, cy + t * uy, cz + t * uz, stretch, to_voxels)
                there, hx, hy, hz = _look(voxels, k0, tx, ty, tz, to_voxels, method, weights)
                its = math.sqrt(hx * hx + hy * hy + hz * hz)
                if crossed > 0 and its > 0 and t < best:
                    best = t
                    x, y, z, value, gx, gy, gz, steep = tx, ty, tz, there, hx, hy, hz, its
        position[n, 0], position[n, 1], position[n, 2] = x, y, z
        gradient[n, 0], gradient[n, 1], gradient[n, 2] = gx, gy, gz
        off[n] = abs(value - iso) / steep if steep > 0 else math.nan


@part()
def _held(voxels, k0, x, y, z, stretch, to_voxels):
    """A local point held in the volume."""
    n_k, n_j, n_i = voxels.shape
    i = to_voxels[0, 0] * x + to_voxels[0, 1] * y + to_voxels[0, 2] * z
    j = to_voxels[1, 1] * y + to_voxels[1, 2] * z
    k = to_voxels[2, 2] * z
    if 0 <= i <= n_i - 1 and 0 <= j <= n_j - 1 and k0 <= k <= k0 + n_k - 1:
        return x, y, z
    i, j, k = min(max(i, 0.0), n_i - 1.0), min(max(j, 0.0), n_j - 1.0), min(max(k, float(k0)), k0 + n_k - 1.0)
    return (
        stretch[0, 0] * i + stretch[0, 1] * j + stretch[0, 2] * k,
        stretch[1, 1] * j + stretch[1, 2] * k,
        stretch[2, 2] * k,
    )


@part()
def _value(voxels, k0, x, y, z, to_voxels, method, weights):
    """Value at a local point, of one beyond the volume at the nearest voxels' ends."""
    n_k, n_j, n_i = voxels.shape
    i = to_voxels[0, 0] * x + to_voxels[0, 1] * y + to_voxels[0, 2] * z
    j = to_voxels[1, 1] * y + to_voxels[1, 2] * z
    k = to_voxels[2, 2] * z
    i, j, k = min(max(i, 0.0), n_i - 1.0), min(max(j, 0.0), n_j - 1.0), min(max(k, float(k0)), k0 + n_k - 1.0)
    return value_at(voxels, k0, i, j, k, method, weights)


@part()
def _look(voxels, k0, x, y, z, to_voxels, method, weights):
    """Value and local slope at a local point, of one beyond the volume at the nearest voxels' ends."""
    n_k, n_j, n_i = voxels.shape
    i = to_voxels[0, 0] * x + to_voxels[0, 1] * y + to_voxels[0, 2] * z
    j = to_voxels[1, 1] * y + to_voxels[1, 2] * z
    k = to_voxels[2, 2] * z
    i, j, k = min(max(i, 0.0), n_i - 1.0), min(max(j, 0.0), n_j - 1.0), min(max(k, float(k0)), k0 + n_k - 1.0)
    value = value_at(voxels, k0, i, j, k, method, weights)
    if math.isnan(value):
        return value, 0.0, 0.0, 0.0
    gi, gj, gk = gradient_at(voxels, k0, i, j, k, method, weights)
    gx = to_voxels[0, 0] * gi
    gy = to_voxels[0, 1] * gi + to_voxels[1, 1] * gj
    gz = to_voxels[0, 2] * gi + to_voxels[1, 2] * gj + to_voxels[2, 2] * gk
    return value, gx, gy, gz
