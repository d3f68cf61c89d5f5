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
    (a, b), (c, d) = photo[np.ix_([y0, y1], [x0, x1])].astype(np.float64)
    upper, lower = (1 - f) * a + f * b, (1 - f) * c + f * d
    return (1 - g) * upper + g * lower


def patch_of(photo: np.ndarray, homography: np.ndarray, size: int = 32) -> np.ndarray:
    """A splat's patch (size, size, 3) in 0..255, one lookup a texel."""
    patch = np.empty((size, size, 3))
    for row in range(size):
        for column in range(size):
            x, y, w = homography @ [(column + 0.5) * 2 / size - 1, (row + 0.5) * 2 / size - 1, 1]
            patch[row, column] = bilinear(photo, x / w, y / w)
    return patch


# --- naive formulations: what the hard cases break --------------------------------------------------------------------


def least_squares(patch: np.ndarray, support: np.ndarray) -> np.ndarray:
    """Weights of least squares, by singular values: right for parallel atoms too."""
    return np.linalg.lstsq(support.astype(np.float64).T, patch.astype(np.float64), rcond=None)[0]


def naive_omp(patch: np.ndarray, dictionary: np.ndarray, max_atoms: int, threshold: float = 1e-6):
    """Pursuit that stops at an absolute correlation, whatever the patch's own size."""
    support, residual, weight = [], patch.astype(np.float64), np.empty(0)
    while len(support) < max_atoms:
        correlation = np.abs(dictionary.astype(np.float64) @ residual)
        correlation[support] = 0
        if correlation.max() < threshold:
            break
        support.append(int(correlation.argmax()))
        weight = least_squares(patch, dictionary[support])
        residual = patch - weight @ dictionary[support].astype(np.float64)
    return support, weight


def naive_cholesky_omp(patch: np.ndarray, dictionary: np.ndarray, max_atoms: int):
    """Pursuit by normal equations in float32, which trusts every pivot."""
    gram, initial = dictionary @ dictionary.T, dictionary @ patch
    support: list[int] = []
    correlation, weight = initial.copy(), np.empty(0, np.float32)
    while len(support) < max_atoms:
        magnitude = np.abs(correlation)
        magnitude[support] = 0
        support.append(int(magnitude.argmax()))
        with np.errstate(all="ignore"):
            try:
                weight = np.linalg.solve(gram[np.ix_(support, support)], initial[support])
            except np.linalg.LinAlgError:
                return support, np.full(len(support), np.nan)
            correlation = initial - gram[:, support] @ weight
    return support, weight.astype(np.float64)


def coded_error(patches: np.ndarray, dictionary: np.ndarray, weights: np.ndarray) -> float:
    return float(((patches - weights @ dictionary) ** 2).sum())


def side_by_side(patches: np.ndarray, dictionary: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Every atom's least squares for these weights, all from the same old dictionary."""
    residual = patches - weights @ dictionary
    return dictionary + weights.T @ residual / (weights**2).sum(axis=0)[:, None]


def in_turn(patches: np.ndarray, dictionary: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The same, each atom from what those before it have become."""
    dictionary = dictionary.copy()
    for k in range(len(dictionary)):
        residual = patches - weights @ dictionary
        dictionary[k] += weights[:, k] @ residual / (weights[:, k] ** 2).sum()
    return dictionary


def nearest_weights(weight: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Each least-squares weight at its nearest level, whatever that does to the error. `levels` (r, w)."""
    return np.array([row[np.abs(row - x).argmin()] for x, row in zip(weight, levels)])


def dead_atom_normalised(patches: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """A power iteration of one atom that divides by whatever length comes out."""
    with np.errstate(invalid="ignore", divide="ignore"):
        moved = (weight @ patches).astype(np.float64)
        return moved / np.linalg.norm(moved)


def normals_from_two_edges(neighbour: np.ndarray) -> np.ndarray:
    """Normals (n, 3) as the cross product of the edges to the first two neighbours. (n, k, 3), itself first."""
    across = np.cross(neighbour[:, 1] - neighbour[:, 0], neighbour[:, 2] - neighbour[:, 0])
    with np.errstate(invalid="ignore", divide="ignore"):
        return across / np.linalg.norm(across, axis=1, keepdims=True)


def split_at_the_median_value(points: np.ndarray, most: int) -> list[np.ndarray]:
    """Chunks by what lies below the median of the longest axis and what does not."""
    if len(points) <= most:
        return [points]
    axis = np.ptp(points, axis=0).argmax()
    below = points[:, axis] < np.median(points[:, axis])
    return split_at_the_median_value(points[below], most) + split_at_the_median_value(points[~below], most)


def cells_of_an_extent(position: np.ndarray, bits: int) -> np.ndarray:
    """Cells along each axis as shares of the box's extent."""
    low = position.min(axis=0)
    with np.errstate(invalid="ignore"):
        return (position - low) / np.ptp(position, axis=0) * (2**bits - 1)


def float32_positions(position: np.ndarray) -> np.ndarray:
    """Absolute coordinates kept in float32."""
    return position.astype(np.float32).astype(np.float64)


def normals_from_raw_moments(neighbour: np.ndarray) -> np.ndarray:
    """Normals from E[x x^T] - E[x] E[x]^T of absolute coordinates, in the type they come in. (n, k, 3)"""
    mean = neighbour.mean(axis=1)
    moment = np.einsum("nki,nkj->nij", neighbour, neighbour) / np.float32(neighbour.shape[1])
    return np.linalg.eigh(moment - mean[:, :, None] * mean[:, None])[1][:, :, 0].astype(np.float64)


def rounded_octahedral(normal: np.ndarray) -> np.ndarray:
    """Octahedral codes (n, 2) int8 by rounding each coordinate to its nearest step."""
    flat = normal / np.abs(normal).sum(axis=1, keepdims=True)
    sign = np.where(flat[:, :2] >= 0, 1, -1)
    folded = (1 - np.abs(flat[:, 1::-1])) * sign
    return np.round(np.where(flat[:, 2:] < 0, folded, flat[:, :2]) * 127).astype(np.int8)


def texel_points(
    camera, centre: np.ndarray, u: np.ndarray, v: np.ndarray, n: int = 32
) -> tuple[np.ndarray, np.ndarray]:
    """Photo coordinates (n, n) of the middles of a splat's n x n cells, by way of points in space."""
    at = (np.arange(n) + 0.5) * 2 / n - 1
    point = centre + at[None, :, None] * u + at[:, None, None] * v  # (row, column, 3)
    local = (point - np.asarray(camera.centre)) @ np.asarray(camera.rotation).T
    return (
        camera.fx_px * local[..., 0] / local[..., 2] + camera.cx_px,
        camera.fy_px * local[..., 1] / local[..., 2] + camera.cy_px,
    )


def cast_patch(camera, centre: np.ndarray, u: np.ndarray, v: np.ndarray, seen_color, finer: int = 16) -> np.ndarray:
    """A patch (32, 32, 3) in 0..255 of an analytic photo: the mean of finer x finer rays a texel."""
    color = seen_color(*texel_points(camera, centre, u, v, 32 * finer))
    return color.reshape(32, finer, 32, finer, 3).mean(axis=(1, 3))


def float32_homography(camera, centre, u, v, radius, eye) -> np.ndarray:
    """The homography (3, 3) of absolute coordinates in float32."""
    calibration = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]], np.float32)
    away = np.asarray(centre, np.float32) - np.asarray(eye, np.float32)
    return (
        calibration
        @ np.asarray(camera.rotation, np.float32)
        @ np.stack([radius * u, radius * v, away], axis=1).astype(np.float32)
    )


def half_float_mean(color: np.ndarray, weight: np.ndarray) -> float:
    """A weighted mean whose two sums are rounded to half floats at every step."""
    total, weights = np.float16(0), np.float16(0)
    for c, w in zip(color, weight):
        total, weights = np.float16(total + c * w), np.float16(weights + w)
    return float(total) / float(weights)


def srgb(linear: float) -> float:
    return float(np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055))
