"""Normals of scans that bring none: the flattest direction of a point's neighbourhood, turned to the viewer.

Covariances are taken against the point itself in float64, so that a scan far from the origin loses nothing.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.execution.compiled import kernel

NEIGHBOURS = 16
# A neighbourhood whose second extent is below this share of its first is a line (or less) as far as float64
# eigenvalues of squared lengths can tell: no plane, and so no normal, is defined.
LINE_SHARE = 1e-6


def estimate_normals(point: np.ndarray, neighbour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (n, 3) float64, and a flag (n,) where the neighbourhood defines none.

    `point` (n, 3), `neighbour` (n, k, 3), in which a missing neighbour is the point itself. A neighbourhood that is a
    line gets a normal perpendicular to it, one that is a point +z; both are flagged.
    """
    normal, is_undefined = np.empty((len(point), 3)), np.zeros(len(point), bool)
    _estimate(np.asarray(point, np.float64), np.asarray(neighbour, np.float64), normal, is_undefined)
    return normal, is_undefined


@kernel()
def _estimate(point, neighbour, normal, is_undefined):
    k = neighbour.shape[1]
    offset, mean = np.zeros((k + 1, 3)), np.empty(3)  # the last is the point's own
    moments, axes = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(point)):
        scale = 0.0
        for j in range(k):
            for a in range(3):
                offset[j, a] = neighbour[i, j, a] - point[i, a]
                scale = max(scale, abs(offset[j, a]))
        if scale == 0:
            normal[i], is_undefined[i] = (0.0, 0.0, 1.0), True
            continue
        for a in range(3):
            mean[a] = 0.0
            for j in range(k):
                offset[j, a] /= scale
                mean[a] += offset[j, a]
            mean[a] /= k + 1
        moments[:] = 0.0
        for j in range(k + 1):
            x, y, z = offset[j, 0] - mean[0], offset[j, 1] - mean[1], offset[j, 2] - mean[2]
            moments[0, 0] += x * x
            moments[0, 1] += x * y
            moments[0, 2] += x * z
            moments[1, 1] += y * y
            moments[1, 2] += y * z
            moments[2, 2] += z * z
        _diagonalise(moments, axes)
        low = high = 0
        for a in range(1, 3):
            low = a if moments[a, a] < moments[low, low] else low
            high = a if moments[a, a] >= moments[high, high] else high
        middle = 3 - low - high
        is_undefined[i] = moments[middle, middle] <= LINE_SHARE * moments[high, high]
        _unit_into(normal[i], axes[:, low])
        if is_undefined[i]:
            _across(normal[i], axes[:, high])


@kernel()
def _diagonalise(m, axes):
    """Turn a symmetric matrix, of which the upper half is read, into its eigenvalues on the diagonal; `axes` has its
    eigenvectors as columns (Jacobi's cyclic method: small eigenvalues keep their digits)."""
    for a in range(3):
        for b in range(3):
            axes[a, b] = 1.0 if a == b else 0.0
    for _ in range(12):
        if abs(m[0, 1]) + abs(m[0, 2]) + abs(m[1, 2]) <= 1e-17 * (m[0, 0] + m[1, 1] + m[2, 2]):
            break
        for a, b, c in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            off = m[a, b]
            if off == 0:
                continue
            half = (m[b, b] - m[a, a]) / (2 * off)
            t = (1.0 if half >= 0 else -1.0) / (abs(half) + math.sqrt(half * half + 1))
            cos = 1 / math.sqrt(t * t + 1)
            sin = t * cos
            m[a, a] -= t * off
            m[b, b] += t * off
            m[a, b] = 0.0
            ac, bc = m[min(a, c), max(a, c)], m[min(b, c), max(b, c)]
            m[min(a, c), max(a, c)], m[min(b, c), max(b, c)] = cos * ac - sin * bc, sin * ac + cos * bc
            for r in range(3):
                axes[r, a], axes[r, b] = cos * axes[r, a] - sin * axes[r, b], sin * axes[r, a] + cos * axes[r, b]


@kernel()
def _unit_into(unit, vector):
    length = math.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    for a in range(3):
        unit[a] = vector[a] / length


@kernel()
def _across(unit, direction):
    """A unit vector at right angles to a unit `direction`: across its smallest component's axis."""
    a = 0
    for other in range(1, 3):
        a = other if abs(direction[other]) < abs(direction[a]) else a
    b, c = (a + 1) % 3, (a + 2) % 3
    length = math.sqrt(direction[b] * direction[b] + direction[c] * direction[c])
    unit[a], unit[b], unit[c] = 0.0, direction[c] / length, -direction[b] / length


def usable_normals(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Given normals as unit float64 vectors, and a flag (n,) where one was zero or not finite (it becomes +z)."""
    normal = normal.astype(np.float64)
    length = np.linalg.norm(normal, axis=1)
    bad = ~(np.isfinite(length) & (length > 0))
    return np.where(bad[:, None], [0.0, 0.0, 1.0], normal / np.where(bad, 1.0, length)[:, None]), bad


def turned_to(normal: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Normals flipped where they point away from `towards` (n, 3)."""
    return np.where((normal * towards).sum(axis=1, keepdims=True) < 0, -normal, normal)
