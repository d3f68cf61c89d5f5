"""The clipline of a splat: the line, of all that 12 bits can say, that best parts its own surface from another one.

A splat's disc is looked at in points of a grid. In each, the nearest point that the eye saw is either near the splat's
plane, and the disc is right to be there, or far in front of or behind it: then the splat is either hidden there, and
shows the colours of what hides it, or sticks out over its own edge. HPG 2021, section 3.5.2, has cliplines
"pre-computed for splats with strong depth discontinuities"; it does not say how.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from pipeline.geometry.cliplines import PEAK, decode_cliplines

GRID = 9  # points across the disc: 69 inside
DIRECTIONS = 32


@cache
def disc_points() -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 2) of the unit disc, and their blending weights 1 - d^2, which add up to 1."""
    at = (np.arange(GRID) + 0.5) * 2 / GRID - 1
    points = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    weight = 1 - (points**2).sum(axis=1)
    return points[weight > 0], weight[weight > 0] / weight[weight > 0].sum()


@cache
def candidates() -> tuple[np.ndarray, np.ndarray]:
    """Codes (k,) uint32 of lines that keep the splat's centre, and what each keeps of `disc_points`, (k, m) float32."""
    angle = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    step = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    step = np.round(step * PEAK).astype(np.int64) + PEAK
    codes = (step[:, 0] | step[:, 1] << 4)[:, None] | (np.arange(PEAK) + PEAK) << 8
    codes = np.unique(codes).astype(np.uint32)
    line, (points, _) = decode_cliplines(codes), disc_points()
    return codes, (line[:, :2] @ points.T + line[:, 2:] >= 0).astype(np.float32)


def best_lines(foreign: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The best clipline of each splat, (n,) uint32 codes, and what it gains, (n,) float32.

    `foreign` (n, m) bool: which of `disc_points` belong to another surface. The gain is the blending weight of foreign
    points that the line clips, less that of own points that it clips too, as a share of the disc's.
    """
    codes, kept = candidates()
    _, weight = disc_points()
    signed = (np.where(foreign, weight, -weight)).astype(np.float32)  # what clipping each point is worth
    gain = signed @ (1 - kept).T
    best = gain.argmax(axis=1)
    return codes[best], gain[np.arange(len(best)), best]
