"""The tangent frame of a splat, from its decoded normal and the scan's up axis.

Paper: HPG 2021, section 3.2: the choice is free, "but must be consistent between splat resampling and rendering",
for example from "its alignment with the global coordinate axes". Every branch here is decided in whole numbers, so
that the shader takes the same one (renderer/shaders/splat_geometry.glsl).
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.normals import octahedron_of


def tangent_frames(normal_code: np.ndarray, up_axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangent u, tangent v and normal of each splat, three (n, 3) float64, orthonormal and right-handed.

    `normal_code` (n, 2) int8, `up_axis` 0, 1 or 2. v points up on a wall; where the normal is within 26 degrees of
    the up axis (cosine above 0.9) the next axis takes its place.
    """
    point = octahedron_of(normal_code)
    along_up = point[:, up_axis]
    near_pole = 100 * along_up * along_up > 81 * (point * point).sum(axis=1)
    axis = np.where(near_pole, (up_axis + 1) % 3, up_axis)
    reference = np.eye(3)[axis]
    normal = point / np.linalg.norm(point, axis=1, keepdims=True)
    u = np.cross(reference, normal)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(normal, u), normal
