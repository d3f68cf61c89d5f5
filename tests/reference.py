"""Slow float64 twins of the fast kernels, written to be read."""

from __future__ import annotations

import numpy as np


def omp(patch: np.ndarray, dictionary: np.ndarray, max_atoms: int, tolerance: float = 0.0):
    """Orthogonal matching pursuit of one patch: support, least-squares weights, squared residual."""
    patch, dictionary = patch.astype(np.float64), dictionary.astype(np.float64)
    support: list[int] = []
    weight = np.empty(0)
    residual = patch
    while len(support) < max_atoms and residual @ residual > tolerance:
        correlation = np.abs(dictionary @ residual)
        correlation[support] = 0
        support.append(int(correlation.argmax()))
        weight = np.linalg.lstsq(dictionary[support].T, patch, rcond=None)[0]
        residual = patch - weight @ dictionary[support]
    return support, weight, float(residual @ residual)


def ksvd_power_iteration(patches: np.ndarray, dictionary: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """One power iteration of every atom on its own matrix E_k of residuals; `weights` (n, k) with zeros."""
    residual = patches - weights @ dictionary
    updated = []
    for k, atom in enumerate(dictionary):
        users = weights[:, k] != 0
        matrix = residual[users] + weights[users, k, None] * atom  # (m, d): E_k transposed
        direction = (matrix @ atom) @ matrix
        updated.append(direction / np.linalg.norm(direction) if users.any() else atom)
    return np.array(updated)


def bilinear(photo: np.ndarray, x: float, y: float) -> np.ndarray:
    """Photo lookup at pixel coordinates with the first pixel's centre at (0.5, 0.5), edges clamped."""
    height, width = photo.shape[:2]
    x, y = np.clip(x - 0.5, 0, width - 1), np.clip(y - 0.5, 0, height - 1)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    f, g = x - x0, y - y0
    photo = photo.astype(np.float64)
    upper = (1 - f) * photo[y0, x0] + f * photo[y0, x1]
    lower = (1 - f) * photo[y1, x0] + f * photo[y1, x1]
    return (1 - g) * upper + g * lower


def patch_of(photo: np.ndarray, homography: np.ndarray, size: int = 32) -> np.ndarray:
    """A splat's patch (size, size, 3) in 0..255, one lookup a texel."""
    patch = np.empty((size, size, 3))
    for row in range(size):
        for column in range(size):
            x, y, w = homography @ [(column + 0.5) * 2 / size - 1, (row + 0.5) * 2 / size - 1, 1]
            patch[row, column] = bilinear(photo, x / w, y / w)
    return patch
