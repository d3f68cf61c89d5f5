"""The demo's scan: the Middlebury motorcycle stereo pair that scikit-image carries, as a COLMAP workspace.

Real photographs and ground-truth disparities (Scharstein et al., GCPR 2014); calibration from scikit-image's
documentation of `skimage.data.stereo_motorcycle`. One oriented point a pixel of the left photograph.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

FOCAL_PX = 994.978
CENTRE_PX = (311.193, 254.877)
CENTRE_SHIFT_PX = 31.086  # of the right photograph's principal point
BASELINE_M = 0.193001
SAME_SURFACE = 0.02  # relative depth step between neighbours that still counts as one surface


def write_motorcycle(folder: Path) -> Path:
    """Write the workspace into `folder`; returns it."""
    from skimage.data import stereo_motorcycle
    from skimage.io import imsave

    left, right, disparity = stereo_motorcycle()
    position, normal, color, in_right = _oriented_points(left, disparity)
    for name in ("images", "sparse"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    imsave(folder / "images" / "left.png", left, check_contrast=False)
    imsave(folder / "images" / "right.png", right, check_contrast=False)
    _write_sparse(folder / "sparse", left.shape[1], left.shape[0])
    _write_fused(folder, position, normal, color, in_right)
    return folder


def _oriented_points(left: np.ndarray, disparity: np.ndarray):
    """Points (n, 3) in the left camera's frame, their normals and colours, and whether the right photo sees them."""
    height, width = disparity.shape
    depth = np.where(np.isfinite(disparity), FOCAL_PX * BASELINE_M / (disparity + CENTRE_SHIFT_PX), np.nan)
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    points = np.stack(
        [(column - CENTRE_PX[0]) / FOCAL_PX * depth, (row - CENTRE_PX[1]) / FOCAL_PX * depth, depth], axis=2
    )
    along_row, along_column = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(along_column, along_row)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    inside = points[1:-1, 1:-1]
    step = np.maximum(np.abs(along_row[..., 2]), np.abs(along_column[..., 2])) / (2 * inside[..., 2])
    facing = -(normal * inside).sum(axis=2) / np.linalg.norm(inside, axis=2)
    good = np.isfinite(normal).all(axis=2) & (step < SAME_SURFACE) & (facing > 0.2)
    return inside[good], normal[good], left[1:-1, 1:-1][good], _seen_in_right(disparity)[1:-1, 1:-1][good]


def _seen_in_right(disparity: np.ndarray) -> np.ndarray:
    """Which left pixels nothing nearer hides in the right photograph: the largest disparity wins each right pixel."""
    height, width = disparity.shape
    row, column = np.nonzero(np.isfinite(disparity))
    target = np.round(column - disparity[row, column]).astype(int)
    inside = target >= 0
    nearest = np.full((height, width), -np.inf)
    np.maximum.at(nearest, (row[inside], target[inside]), disparity[row, column][inside])
    seen = np.zeros((height, width), bool)
    seen[row[inside], column[inside]] = disparity[row, column][inside] >= nearest[row[inside], target[inside]] - 1
    return seen


def _write_sparse(folder: Path, width: int, height: int) -> None:
    cx, cy = CENTRE_PX
    (folder / "cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {FOCAL_PX} {FOCAL_PX} {cx} {cy}\n"
        f"2 PINHOLE {width} {height} {FOCAL_PX} {FOCAL_PX} {cx + CENTRE_SHIFT_PX} {cy}\n"
    )
    (folder / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 left.png\n\n2 1 0 0 0 {-BASELINE_M} 0 0 2 right.png\n\n")
    (folder / "points3D.txt").write_text("")


def _write_fused(
    folder: Path, position: np.ndarray, normal: np.ndarray, color: np.ndarray, in_right: np.ndarray
) -> None:
    record = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 3)])
    rows = np.empty(len(position), record)
    rows["position"], rows["normal"], rows["color"] = position, normal, color
    properties = "".join(f"property float {p}\n" for p in ("x", "y", "z", "nx", "ny", "nz"))
    properties += "".join(f"property uchar {p}\n" for p in ("red", "green", "blue"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    (folder / "fused.ply").write_bytes(header.encode() + rows.tobytes())
    both, one = struct.pack("<III", 2, 0, 1), struct.pack("<II", 1, 0)
    seen = b"".join(both if r else one for r in in_right)
    (folder / "fused.ply.vis").write_bytes(struct.pack("<Q", len(rows)) + seen)
