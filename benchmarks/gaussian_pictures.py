"""Pictures of Gaussians as programs for 3D Gaussian splatting draw them: sorted by depth, laid over each other in sRGB.

Slow and plain: one Gaussian after the other, front to back, in all pixels that it reaches.
Reference: Kerbl et al. 2023, section 6 and its program: 0.3 px^2 of low-pass, three sigmas, alpha below 1/255 left out.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from pipeline.exports.gaussians import Gaussians
from storage.packed.schema import Camera

LOW_PASS_PX2, LEAST_ALPHA, LEAST_LIGHT = 0.3, 1 / 255, 1e-4


def picture(gaussians: Gaussians, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) uint8 sRGB over black, and how much of each pixel is covered (h, w)."""
    rotation = np.array(view.rotation)
    seen = (gaussians.position + np.subtract(gaussians.origin, view.centre)) @ rotation.T
    order = np.argsort(seen[:, 2], kind="stable")
    order = order[seen[order, 2] > 0.01]
    axes = rotation @ Rotation.from_quat(gaussians.rotation[order]).as_matrix() * gaussians.sigma[order, None]
    x, y, z = seen[order].T
    jacobian = np.zeros((len(order), 2, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 2] = view.fx_px / z, -view.fx_px * x / z**2
    jacobian[:, 1, 1], jacobian[:, 1, 2] = view.fy_px / z, -view.fy_px * y / z**2
    flat = jacobian @ axes
    covariance = flat @ flat.swapaxes(1, 2) + LOW_PASS_PX2 * np.eye(2)
    middle = np.column_stack([view.fx_px * x / z + view.cx_px, view.fy_px * y / z + view.cy_px])
    light, left = np.zeros((view.height_px, view.width_px, 3)), np.ones((view.height_px, view.width_px))
    _lay(light, left, middle, covariance, gaussians.color[order], gaussians.opacity)
    return np.round(255 * light.clip(0, 1)).astype(np.uint8), 1 - left


@njit(cache=True)
def _lay(light, left, middle, covariance, color, opacity):
    height, width = left.shape
    for i in range(len(middle)):
        a, b, c = covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]
        determinant = a * c - b * b
        reach_x, reach_y = 3 * np.sqrt(a), 3 * np.sqrt(c)
        x, y = middle[i]
        if x + reach_x < 0 or x - reach_x > width or y + reach_y < 0 or y - reach_y > height:
            continue
        for row in range(max(0, int(y - reach_y)), min(height, int(y + reach_y) + 1)):
            for column in range(max(0, int(x - reach_x)), min(width, int(x + reach_x) + 1)):
                if left[row, column] < LEAST_LIGHT:
                    continue
                dx, dy = column + 0.5 - x, row + 0.5 - y
                alpha = min(0.99, opacity * np.exp(-0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / determinant))
                if alpha >= LEAST_ALPHA:
                    for k in range(3):
                        light[row, column, k] += left[row, column] * alpha * color[i, k]
                    left[row, column] *= 1 - alpha
