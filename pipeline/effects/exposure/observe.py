"""The light of splats in every photograph that sees them: the mean over each one's disc."""

from __future__ import annotations

import numpy as np

from pipeline.effects.block import Block
from pipeline.numerics.srgb import LINEAR_OF_LEVEL
from storage.packed.schema import Camera

EVERY = 32  # splats of a block: 512
STEEPEST = 0.3  # cosine: beyond 73 degrees a disc is a smear of what lies about it
RINGS = ((0.0, 1), (0.5, 6), (0.9, 10))  # radius and number of lookups on the disc


def observed(block: Block) -> dict:
    """What photographs show of every n-th splat, as flat lists: splat (its place among those), photo, x, y in [-1, 1]
    across the photo, and light, three linear values each. Photographs that are held out show nothing."""
    rows = np.arange(0, len(block.centre), EVERY)
    kept = ((i, camera) for i, camera in enumerate(block.sources.cameras) if i not in block.sources.held_out)
    found = [_in_photo(block, i, camera, rows) for i, camera in kept]
    splat, photo, x, y, light = (np.concatenate(columns) for columns in zip(*found)) if found else [np.empty(0)] * 5
    twice = (
        np.bincount(splat.astype(np.int64), minlength=len(rows))[splat.astype(np.int64)] > 1
        if len(splat)
        else splat > 0
    )
    return {
        "splat": splat[twice].tolist(),
        "photo": photo[twice].tolist(),
        "x": x[twice].round(4).tolist(),
        "y": y[twice].round(4).tolist(),
        "light": light[twice].round(6).ravel().tolist(),
    }


def _in_photo(block: Block, index: int, camera: Camera, rows: np.ndarray) -> tuple[np.ndarray, ...]:
    centre, (u, v, normal) = block.centre[rows] + block.sources.origin, (axis[rows] for axis in block.frame)
    ray = centre - np.asarray(camera.centre)
    facing = -(ray * normal).sum(axis=1) > STEEPEST * np.linalg.norm(ray, axis=1)
    usable = np.flatnonzero(block.seen[rows, index] & facing)
    around = [
        r * (np.cos(a) * u[usable] + np.sin(a) * v[usable]) for r, n in RINGS for a in 2 * np.pi * np.arange(n) / n
    ]
    reach = block.radius[rows][usable, None, None]
    x, y, depth = _pixels(camera, centre[usable][:, None] + reach * np.stack(around, axis=1))
    whole = ((depth > 0) & (x >= 0) & (y >= 0) & (x < camera.width_px) & (y < camera.height_px)).all(axis=1)
    column, row = x[whole].astype(np.int64), y[whole].astype(np.int64)
    light = np.empty((len(row), 3))
    if len(row):
        left, top = int(column.min()), int(row.min())
        window = block.photo(index, left, top, int(column.max()) + 1, int(row.max()) + 1)
        light = LINEAR_OF_LEVEL[window[row - top, column - left]].mean(axis=1)
    return (
        usable[whole],
        np.full(len(row), index),
        x[whole, 0] * 2 / camera.width_px - 1,
        y[whole, 0] * 2 / camera.height_px - 1,
        light,
    )


def _pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels x, y and depths of points (..., 3), absolute; not finite behind the camera."""
    local = (points - np.asarray(camera.centre)) @ np.asarray(camera.rotation).T
    depth = np.where(local[..., 2] > 0, local[..., 2], np.nan)
    x = local[..., 0] / depth * camera.fx_px + camera.cx_px
    y = local[..., 1] / depth * camera.fy_px + camera.cy_px
    return np.nan_to_num(x, nan=-1.0), np.nan_to_num(y, nan=-1.0), np.nan_to_num(depth, nan=-1.0)
