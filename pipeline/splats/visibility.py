"""Who sees what, for scans that do not say: a depth map a camera, and a test against it.

The map is coarse, so that a splat covers a few of its cells: holes between points must not let the far side through.
"""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel
from storage.packed.schema import Camera

CELLS_A_RADIUS = 1.5  # how many cells the radius spans at the median depth
# How far behind the nearest surface a point still counts as part of it, in radii, and how much more for each unit of
# slope: the map holds squares, so a surface seen at a slant hides itself. On fountain_p11, whose visibility lists are
# known, the test then finds 96 % of the listed pairs, and leaves 0.4 % of the points unseen.
SLACK_RADII = 3.0
SLACK_BY_SLOPE = 2.0
STEEPEST_SLOPE = 10.0


def map_scale(camera: Camera, depth: float, radius: float) -> float:
    """Cells a photo pixel, at most 1, for points at this depth."""
    return float(min(1.0, CELLS_A_RADIUS * depth / (radius * max(camera.fx_px, camera.fy_px))))


def empty_map(camera: Camera, scale: float) -> np.ndarray:
    """A depth map (height, width) float32 with nothing in it."""
    return np.full((max(1, int(camera.height_px * scale)), max(1, int(camera.width_px * scale))), np.inf, np.float32)


def draw_points(depth_map: np.ndarray, camera: Camera, position: np.ndarray, radius: float | np.ndarray) -> None:
    """Lower the map to the depths of squares of `radius`, one for all or each its own (n,), around the points (n, 3),
    absolute."""
    x, y, depth, reach = _on_map(depth_map, camera, position, radius)
    _draw(depth_map, x, y, depth, reach)


def seen_points(
    depth_map: np.ndarray, camera: Camera, position: np.ndarray, normal: np.ndarray, radius: float | np.ndarray
) -> np.ndarray:
    """(n,) bool: the points that lie on the map and not behind what it holds. `normal` (n, 3) unit, either way
    round."""
    x, y, depth, reach = _on_map(depth_map, camera, position, radius)
    height, width = depth_map.shape
    on_map = (depth > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = (np.where(on_map, a, 0).astype(np.int64) for a in (x, y))
    extent = radius / np.minimum(1.0, np.maximum(reach, np.finfo(float).tiny))  # a radius, but at least a cell
    slack = (SLACK_RADII + SLACK_BY_SLOPE * _slope(camera, position, normal)) * extent
    return on_map & (depth <= depth_map[row, column] + slack)


def _slope(camera: Camera, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The tangent of the angle between the view and the normal, at most STEEPEST_SLOPE."""
    ray = position - np.asarray(camera.centre)
    along = np.abs((ray * normal).sum(axis=1))
    across = np.linalg.norm(np.cross(ray, normal), axis=1)
    return np.minimum(across / np.maximum(along, across / STEEPEST_SLOPE + np.finfo(float).tiny), STEEPEST_SLOPE)


def _on_map(depth_map: np.ndarray, camera: Camera, position: np.ndarray, radius: float | np.ndarray):
    local = (position - np.asarray(camera.centre)) @ np.asarray(camera.rotation).T
    depth = local[:, 2]
    scale_x, scale_y = depth_map.shape[1] / camera.width_px, depth_map.shape[0] / camera.height_px
    safe = np.where(depth > 0, depth, 1.0)
    x = np.where(depth > 0, (local[:, 0] / safe * camera.fx_px + camera.cx_px) * scale_x, -1.0)
    y = np.where(depth > 0, (local[:, 1] / safe * camera.fy_px + camera.cy_px) * scale_y, -1.0)
    return x, y, depth, radius * camera.fx_px * scale_x / safe


@kernel()
def _draw(depth_map, x, y, depth, reach):
    height, width = depth_map.shape
    for i in range(x.shape[0]):
        if depth[i] <= 0 or x[i] < 0 or y[i] < 0 or x[i] >= width or y[i] >= height:
            continue
        extent = min(reach[i], 64.0)
        for row in range(max(0, int(y[i] - extent)), min(height, int(y[i] + extent) + 1)):
            for column in range(max(0, int(x[i] - extent)), min(width, int(x[i] + extent) + 1)):
                depth_map[row, column] = min(depth_map[row, column], np.float32(depth[i]))
