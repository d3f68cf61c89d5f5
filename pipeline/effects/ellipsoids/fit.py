"""The ellipsoid of a neighbourhood: principal axes, three standard deviations long. Paper: 2020, section 3.1."""

from __future__ import annotations

import numpy as np

from pipeline.effects.ellipsoids.neighbourhoods import Around, gather
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


def fit(point: np.ndarray, around: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the ellipsoid's centre lies from its point, (n, 3), and its half axes as rows (n, 3, 3), longest first.

    `point` (n, 3), `around` distinct points that hold all neighbours. Neighbours beyond the reach count only where all
    are strung on a line, as along a wire: others that lie so far away have gaps between them. Guarantees: axes at
    right angles, right-handed, LEAST_RADII or more, across the longest no more than the disc's radius; a point that has
    no neighbourhood is a ball of LEAST_RADII.
    """
    members = gather(point, Around(around, REACH_RADII * radius / 2), REACH_RADII * radius)
    count = members.count
    deviation, _ = principal_axes(moments(members.offset, count)[1])
    near = (np.linalg.norm(members.offset, axis=2) <= REACH_RADII * radius) & (
        np.arange(members.offset.shape[1]) < count[:, None]
    )
    count = np.where(deviation[:, 1] <= LINE_SHARE * deviation[:, 0], count, near.sum(axis=1))
    mean, covariance = moments(members.offset, count)
    deviation, direction = principal_axes(covariance)
    off = np.abs((members.offset - mean[:, None]) @ direction.transpose(0, 2, 1))
    off[np.arange(off.shape[1]) >= count[:, None]] = 0
    length = np.minimum(SIGMAS * deviation, MOST_EXTENTS * off.max(axis=1))
    length[:, 1:] = np.minimum(length[:, 1:], radius)
    return mean, direction * np.maximum(length, LEAST_RADII * radius)[..., None]


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
    variance, direction = np.linalg.eigh(covariance)
    rows = direction.transpose(0, 2, 1)[:, ::-1].copy()
    rows[:, 2] = np.cross(rows[:, 0], rows[:, 1])
    return np.sqrt(np.maximum(variance[:, ::-1], 0)), rows
