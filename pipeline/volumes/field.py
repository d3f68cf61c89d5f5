"""The value and slope of a volume between its voxels: trilinear, or by a radial kernel of three lobes.

DuoDecim (2006), section 2.1, resamples by a spherical kernel and prints it without its sinc. Used here is what a ball of
frequencies transforms to in space, windowed by its own main lobe: with j(x) = 3 (sin x - x cos x) / x^3 and z its first zero,

    w(r) = j(pi r) j(z r / 3) for r < 3, else 0, r in voxels,

divided by the sum of the weights. It overshoots beside sharp edges; so the result is held between the least and the most of the 8
voxels about it. A point is known where it lies between voxels and none that counts is not finite.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.execution.compiled import part

LOBES = 3
FIRST_ZERO = 4.493409457909064  # of tan x = x
TABLE = 1024  # entries a unit of squared distance
CENTRAL = 1.0  # voxels either way, of differences

TRILINEAR, RADIAL = 0, 1
METHODS = {"trilinear": TRILINEAR, "radial": RADIAL}
SUPPORT = 2 * LOBES + 1  # slices that must be there about a point, differences included


def _ball(x: np.ndarray) -> np.ndarray:
    x = np.maximum(x, 1e-3)  # where 1 - x^2 / 10 is 1 in float32
    return 3 * (np.sin(x) - x * np.cos(x)) / x**3


def _weights() -> np.ndarray:
    r = np.sqrt(np.arange(LOBES * LOBES * TABLE + 2) / TABLE)
    return np.where(r < LOBES, _ball(np.pi * r) * _ball(FIRST_ZERO * r / LOBES), 0.0).astype(np.float32)


WEIGHTS = _weights()


@part()
def trilinear(voxels, k0, x, y, z):
    """Value at (i, j, k) = (x, y, z) of voxels (n_k, n_j, n_i) whose first slice is k0; NaN where it is not known."""
    n_k, n_j, n_i = voxels.shape
    z -= k0
    if not (0 <= x <= n_i - 1 and 0 <= y <= n_j - 1 and 0 <= z <= n_k - 1):
        return math.nan
    i, j, k = min(int(x), n_i - 2), min(int(y), n_j - 2), min(int(z), n_k - 2)
    u, v, w = x - i, y - j, z - k
    low = (voxels[k, j, i] * (1 - u) + voxels[k, j, i + 1] * u) * (1 - v) + (
        voxels[k, j + 1, i] * (1 - u) + voxels[k, j + 1, i + 1] * u
    ) * v
    k += 1
    high = (voxels[k, j, i] * (1 - u) + voxels[k, j, i + 1] * u) * (1 - v) + (
        voxels[k, j + 1, i] * (1 - u) + voxels[k, j + 1, i + 1] * u
    ) * v
    return low * (1 - w) + high * w


@part()
def radial(voxels, k0, x, y, z, weights):
    """The same by the radial kernel."""
    n_k, n_j, n_i = voxels.shape
    z -= k0
    if not (0 <= x <= n_i - 1 and 0 <= y <= n_j - 1 and 0 <= z <= n_k - 1):
        return math.nan
    i, j, k = min(int(x), n_i - 2), min(int(y), n_j - 2), min(int(z), n_k - 2)
    least, most = math.inf, -math.inf
    for c in range(k, k + 2):
        for b in range(j, j + 2):
            for a in range(i, i + 2):
                value = voxels[c, b, a]
                if math.isnan(value):
                    return math.nan
                least, most = min(least, value), max(most, value)
    total, weight = 0.0, 0.0
    for c in range(max(0, k - LOBES + 1), min(n_k, k + LOBES + 1)):
        for b in range(max(0, j - LOBES + 1), min(n_j, j + LOBES + 1)):
            beside = (c - z) ** 2 + (b - y) ** 2
            if beside >= LOBES * LOBES:
                continue
            for a in range(max(0, i - LOBES + 1), min(n_i, i + LOBES + 1)):
                far = (beside + (a - x) ** 2) * TABLE
                if far < LOBES * LOBES * TABLE:
                    value = voxels[c, b, a]
                    if not math.isnan(value):
                        at = int(far)
                        w = weights[at] + (weights[at + 1] - weights[at]) * (far - at)
                        total += w * value
                        weight += w
    return min(max(total / weight, least), most)


@part()
def value_at(voxels, k0, x, y, z, method, weights):
    """The value at a point between voxels, NaN where it is not known."""
    if method == TRILINEAR:
        return trilinear(voxels, k0, x, y, z)
    return radial(voxels, k0, x, y, z, weights)


@part()
def _slope(low, mid, high, below, above):
    """Of three values, the outer ones `below` and `above` away from the middle; of two where one is not known."""
    if not math.isnan(low) and not math.isnan(high):
        return (high - low) / (below + above)
    if not math.isnan(high):
        return (high - mid) / above
    if not math.isnan(low):
        return (mid - low) / below
    return 0.0


@part()
def gradient_at(voxels, k0, x, y, z, method, weights):
    """The slopes along i, j, k by central differences over a voxel either way, less at borders; 0 where nothing is known."""
    n_k, n_j, n_i = voxels.shape
    mid = value_at(voxels, k0, x, y, z, method, weights)
    below, above = min(CENTRAL, x), min(CENTRAL, n_i - 1 - x)
    gx = (
        _slope(
            value_at(voxels, k0, x - below, y, z, method, weights),
            mid,
            value_at(voxels, k0, x + above, y, z, method, weights),
            below,
            above,
        )
        if below + above > 0
        else 0.0
    )
    below, above = min(CENTRAL, y), min(CENTRAL, n_j - 1 - y)
    gy = (
        _slope(
            value_at(voxels, k0, x, y - below, z, method, weights),
            mid,
            value_at(voxels, k0, x, y + above, z, method, weights),
            below,
            above,
        )
        if below + above > 0
        else 0.0
    )
    below, above = min(CENTRAL, z - k0), min(CENTRAL, n_k - 1 + k0 - z)
    gz = (
        _slope(
            value_at(voxels, k0, x, y, z - below, method, weights),
            mid,
            value_at(voxels, k0, x, y, z + above, method, weights),
            below,
            above,
        )
        if below + above > 0
        else 0.0
    )
    return gx, gy, gz
