"""The ellipsoid of a neighbourhood: principal axes, three standard deviations long. Paper: 2020, section 3.1."""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.hypotheses import cross
from pipeline.effects.ellipsoids.nearest import gather, n_within
from pipeline.effects.ellipsoids.neighbourhoods import Around
from pipeline.execution.compiled import kernel

# Set by how well outlines match the true ones (intersection over union, thin things of the room of tests/thin_scene.py
# from four new viewpoints, seeds 1 and 2): discs 0.51; the paper's three deviations 0.51, as they reach far beyond
# points that lie on a surface and have no tails; the same limited to 1.0 and 1.25 times where members reach 0.62, 0.64.
# Reaches of 1.0, 1.5, 2.0 and 2.5 radii: 0.62, 0.63, 0.62, 0.61.
REACH_RADII = 1.5
SIGMAS = 3.0
MOST_EXTENTS = 1.25
LINE_SHARE = 0.3  # of the second deviation in the first: half a disc has 0.53
LEAST_RADII = 0.25  # of the half axes: of a thing seen from one side, or by one row of points, less is known

MOST_SWEEPS = 12


def fit(point: np.ndarray, around: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the ellipsoid's centre lies from its point, (n, 3), and its half axes as rows (n, 3, 3), longest first.

    `point` (n, 3), `around` distinct points that hold all neighbours. Neighbours beyond the reach count only where all
    are strung on a line, as along a wire: others that lie so far away have gaps between them. Guarantees: axes at
    right angles, right-handed, LEAST_RADII or more, across the longest no more than the disc's radius; a point that has
    no neighbourhood is a ball of LEAST_RADII.
    """
    members = gather(point, Around(around, REACH_RADII * radius / 2), REACH_RADII * radius)
    count = members.count
    near = n_within(members.offset, count, REACH_RADII * radius)
    mean, covariance = moments(members.offset, count)
    deviation, direction = principal_axes(covariance)
    others = np.flatnonzero((deviation[:, 1] > LINE_SHARE * deviation[:, 0]) & (near < count))
    count[others] = near[others]
    mean[others], covariance[others] = moments(members.offset[others], count[others])
    deviation[others], direction[others] = principal_axes(covariance[others])
    length = np.minimum(SIGMAS * deviation, MOST_EXTENTS * _furthest(members.offset, count, mean, direction))
    length[:, 1:] = np.minimum(length[:, 1:], radius)
    return mean, direction * np.maximum(length, LEAST_RADII * radius)[..., None]


@kernel()
def _furthest(offset, count, mean, direction):  # (n, 3): how far from the mean members lie along each direction
    found = np.zeros((len(offset), 3))
    for i in range(len(offset)):
        for j in range(count[i]):
            for axis in range(3):
                along = 0.0
                for k in range(3):
                    along += (offset[i, j, k] - mean[i, k]) * direction[i, axis, k]
                found[i, axis] = max(found[i, axis], abs(along))
    return found


def moments(offset: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (n, 3) and covariances (n, 3, 3), over one less than their number, of the first `count` (n,) of `offset`
    (n, k, 3); zeros for fewer than 2."""
    mean, covariance = np.zeros((len(offset), 3)), np.zeros((len(offset), 3, 3))
    _moments(np.ascontiguousarray(offset), count, mean, covariance)
    return mean, covariance


@kernel()
def _moments(offset, count, mean, covariance):
    for i in range(len(offset)):
        n = count[i]
        for j in range(n):
            for k in range(3):
                mean[i, k] += offset[i, j, k]
        for k in range(3):
            mean[i, k] /= max(n, 1)
        for j in range(n):
            for k in range(3):
                for m in range(k, 3):
                    covariance[i, k, m] += (offset[i, j, k] - mean[i, k]) * (offset[i, j, m] - mean[i, m])
        for k in range(3):
            for m in range(k, 3):
                covariance[i, k, m] /= max(n - 1, 1)
                covariance[i, m, k] = covariance[i, k, m]


def principal_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deviations (n, 3), longest first, and their unit directions as rows of (n, 3, 3), right-handed."""
    deviation, rows = np.empty((len(covariance), 3)), np.empty((len(covariance), 3, 3))
    _principal_axes(covariance, deviation, rows)
    return deviation, rows


@kernel(error_model="numpy")
def _principal_axes(covariance, deviation, rows):
    """By turns in the planes of two axes (C. G. J. Jacobi, 1846)."""
    a, v = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(covariance)):
        for row in range(3):
            for column in range(3):
                a[row, column], v[row, column] = covariance[i, row, column], 1.0 if row == column else 0.0
        for _ in range(MOST_SWEEPS):
            off = abs(a[0, 1]) + abs(a[0, 2]) + abs(a[1, 2])
            if off <= 1e-18 * (abs(a[0, 0]) + abs(a[1, 1]) + abs(a[2, 2])):
                break
            _turn(a, v, 0, 1, 2)
            _turn(a, v, 0, 2, 1)
            _turn(a, v, 1, 2, 0)
        first, last = 0, 0
        for axis in range(1, 3):
            first = axis if a[axis, axis] > a[first, first] else first
            last = axis if a[axis, axis] <= a[last, last] else last
        second = 3 - first - last if first != last else (first + 1) % 3
        for at, axis in enumerate((first, second, last)):
            deviation[i, at] = math.sqrt(max(a[axis, axis], 0.0))
            for k in range(3):
                rows[i, at, k] = v[k, axis]
        x, y = rows[i, 0], rows[i, 1]
        rows[i, 2, 0], rows[i, 2, 1], rows[i, 2, 2] = cross(x[0], x[1], x[2], y[0], y[1], y[2])


@kernel(error_model="numpy")
def _turn(a, v, p, q, r):
    """Turn axes `p` and `q` of the symmetric `a` (3, 3) so that a[p, q] is 0; `r` is the third, `v` gathers turns."""
    if a[p, q] == 0:
        return
    theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
    t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1))
    c = 1 / math.sqrt(t * t + 1)
    s = t * c
    a[p, p], a[q, q] = a[p, p] - t * a[p, q], a[q, q] + t * a[p, q]
    a[p, q] = a[q, p] = 0.0
    rp, rq = a[r, p], a[r, q]
    a[r, p] = a[p, r] = c * rp - s * rq
    a[r, q] = a[q, r] = s * rp + c * rq
    for k in range(3):
        vp, vq = v[k, p], v[k, q]
        v[k, p], v[k, q] = c * vp - s * vq, s * vp + c * vq
