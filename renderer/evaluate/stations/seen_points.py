"""Which points of a scan a view sees, and how well a picture shows their colours: a truth that nothing drew.

A point is seen where no other lies clearly before it in its square of BLOCK_PX pixels. On slanted surfaces some are left
out that are seen; the same ones for all pictures that are compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from renderer.evaluate.compare import psnr_of_error
from storage.packed.schema import Camera

BLOCK_PX = 4
DEEPER = 1.03  # times the depth of the nearest point of its square that a point may have


@dataclass(frozen=True)
class SeenPoints:
    """Points that a view sees: which, and the pixels that they fall into."""

    rows: np.ndarray  # (m,) int64
    pixel: np.ndarray  # (m, 2) int64, row and column

    def psnr_db(self, rgb: np.ndarray, colors: np.ndarray, covered: np.ndarray) -> tuple[float | None, int]:
        """Of a picture (h, w, 3) uint8 against the colours (n, 3) uint8 of all points, at the seen ones whose pixels are
        `covered` (h, w); and their number. None where there are none, or nothing was lost."""
        row, column = self.pixel.T
        kept = covered[row, column]
        if not kept.any():
            return None, 0
        off = rgb[row[kept], column[kept]].astype(np.float64) - colors[self.rows[kept]]
        return psnr_of_error(float((off**2).mean())), int(kept.sum())


def seen_points(view: Camera, points: np.ndarray) -> SeenPoints:
    """Of `points` (n, 3), absolute, those that `view` sees."""
    at = (points - np.asarray(view.centre)) @ np.asarray(view.rotation).T
    before = np.flatnonzero(at[:, 2] > 1e-6)
    x, y, depth = at[before].T
    column, row = view.fx_px * x / depth + view.cx_px, view.fy_px * y / depth + view.cy_px
    inside = (column >= 0) & (column < view.width_px) & (row >= 0) & (row < view.height_px)
    rows, depth = before[inside], depth[inside]
    pixel = np.stack([row[inside], column[inside]], axis=1).astype(np.int64)
    across = -(-view.width_px // BLOCK_PX)
    square = pixel[:, 0] // BLOCK_PX * across + pixel[:, 1] // BLOCK_PX
    nearest = np.full(across * -(-view.height_px // BLOCK_PX), np.inf)
    np.minimum.at(nearest, square, depth)
    seen = depth <= DEEPER * nearest[square]
    return SeenPoints(rows[seen], pixel[seen])
