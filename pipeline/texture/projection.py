"""Splat squares into photographs: one homography a splat and camera.

Paper: HPG 2021, section 3.2. Pixel coordinates have the centre of the first pixel at (0.5, 0.5).
"""

from __future__ import annotations

import numpy as np

from storage.packed.schema import Camera

# A corner nearer to the camera plane than this share of the splat's centre distance cannot be textured: its
# projection moves by more than a splat for every rounding of the plane.
NEAREST_SHARE = 0.05
# A homography whose determinant is below this share of its largest entry cubed is singular as far as float64 can
# tell: its columns, one of them the eye's distance, are then known to fewer digits than the determinant has left.
FLATTEST_SHARE = 1e-15


def homographies(
    camera: Camera,
    origin: tuple[float, float, float],
    centre: np.ndarray,  # (n, 3) float64 against the origin
    u: np.ndarray,  # (n, 3)
    v: np.ndarray,  # (n, 3)
    radius: float | np.ndarray,  # (n,), or one for all
) -> np.ndarray:
    """(n, 3, 3) float64: pixel = h @ (x, y, 1) with x, y in [-1, 1] over the splat's square; divide by the third."""
    rotation = np.asarray(camera.rotation)
    eye = np.asarray(camera.centre) - np.asarray(origin)
    calibration = np.array(
        [
            [camera.fx_px, 0.0, camera.cx_px],
            [0.0, camera.fy_px, camera.cy_px],
            [0.0, 0.0, 1.0],
        ]
    )
    reach = np.reshape(radius, (-1, 1))
    columns = np.stack([reach * u, reach * v, centre - eye], axis=2)  # (n, 3, 3)
    return calibration @ rotation @ columns


def corner_depths(homography: np.ndarray) -> np.ndarray:
    """Depths (n, 4) of the square's corners, in the scan's unit."""
    signs = np.array([[-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, 1]])
    return homography[:, 2] @ signs.T


def is_in_front(homography: np.ndarray) -> np.ndarray:
    """(n,) bool: the whole square lies well in front of the camera."""
    return corner_depths(homography).min(axis=1) > NEAREST_SHARE * np.abs(homography[:, 2, 2])


def is_whole(homography: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """(n,) bool: the camera sees the whole square: in front of it, inside the photo, and as a square, not a line.

    False too for what is not finite, as a camera with a singular matrix makes it.
    """
    corners = project_corners(homography)
    with np.errstate(invalid="ignore"):
        inside = ((corners >= 0) & (corners <= [width_px, height_px])).all(axis=(1, 2))
    flat = np.abs(np.linalg.det(homography)) <= FLATTEST_SHARE * np.abs(homography).max(axis=(1, 2)) ** 3
    return inside & is_in_front(homography) & ~flat


def project_corners(homography: np.ndarray) -> np.ndarray:
    """Pixel positions (n, 4, 2) of the square's corners; meaningful where `is_in_front`."""
    signs = np.array([[-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, 1]])
    points = np.einsum("nij,cj->nci", homography, signs)
    with np.errstate(divide="ignore", invalid="ignore"):
        return points[..., :2] / points[..., 2:]
