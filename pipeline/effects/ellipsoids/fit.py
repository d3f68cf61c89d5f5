"""The ellipsoid of a neighbourhood: principal axes, three standard deviations long. Paper: 2020, section 3.1."""

from __future__ import annotations

import numpy as np

SIGMAS = 3.0


def moments(offset: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (n, 3) and covariances (n, 3, 3), over one less than their number, of the first `count` (n,) of `offset`
    (n, k, 3); zeros for fewer than 2."""
    member = np.arange(offset.shape[1]) < count[:, None]
    number = np.maximum(count, 1)[:, None]
    mean = (offset * member[..., None]).sum(axis=1) / number
    centred = np.where(member[..., None], offset - mean[:, None], 0)
    covariance = centred.transpose(0, 2, 1) @ centred / np.maximum(number - 1, 1)[..., None]
    return mean, covariance


def principal_axes(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deviations (n, 3), longest first, and their unit directions as rows of (n, 3, 3), right-handed."""
    variance, direction = np.linalg.eigh(covariance)
    rows = direction.transpose(0, 2, 1)[:, ::-1].copy()
    rows[:, 2] = np.cross(rows[:, 0], rows[:, 1])
    return np.sqrt(np.maximum(variance[:, ::-1], 0)), rows
