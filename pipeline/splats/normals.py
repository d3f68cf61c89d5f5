"""Normals of scans that bring none: the flattest direction of a point's neighbourhood, turned to the viewer.

Covariances are taken against the point itself in float64, so that a scan far from the origin loses nothing.
"""

from __future__ import annotations

import numpy as np

NEIGHBOURS = 16
# A neighbourhood whose second extent is below this share of its first is a line (or less) as far as float64
# eigenvalues of squared lengths can tell: no plane, and so no normal, is defined.
LINE_SHARE = 1e-6


def estimate_normals(point: np.ndarray, neighbour: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (n, 3) float64, and a flag (n,) where the neighbourhood defines none.

    `point` (n, 3), `neighbour` (n, k, 3), in which a missing neighbour is the point itself. A neighbourhood that is a
    line gets a normal perpendicular to it, one that is a point +z; both are flagged.
    """
    offset = neighbour - point[:, None]
    scale = np.abs(offset).max(axis=(1, 2))
    offset = offset / np.where(scale > 0, scale, 1)[:, None, None]
    around = np.concatenate([offset, np.zeros((len(point), 1, 3))], axis=1)
    around -= around.mean(axis=1, keepdims=True)
    extent, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    normal = axes[:, :, 0]
    line = extent[:, 1] <= LINE_SHARE * extent[:, 2]
    normal = np.where(line[:, None], _perpendicular(axes[:, :, 2]), normal)
    nothing = scale == 0
    return np.where(nothing[:, None], [0.0, 0.0, 1.0], normal), line | nothing


def usable_normals(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Given normals as unit float64 vectors, and a flag (n,) where one was zero or not finite (it becomes +z)."""
    normal = normal.astype(np.float64)
    length = np.linalg.norm(normal, axis=1)
    bad = ~(np.isfinite(length) & (length > 0))
    return np.where(bad[:, None], [0.0, 0.0, 1.0], normal / np.where(bad, 1.0, length)[:, None]), bad


def turned_to(normal: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Normals flipped where they point away from `towards` (n, 3)."""
    return np.where((normal * towards).sum(axis=1, keepdims=True) < 0, -normal, normal)


def _perpendicular(direction: np.ndarray) -> np.ndarray:
    """A unit vector at right angles to each unit `direction` (n, 3): across its smallest component's axis."""
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin(axis=1)])
    return across / np.linalg.norm(across, axis=1, keepdims=True)
