"""Which open pixels a splat should cover, by the scan's points alone: those with points on all sides, and those beyond
what was scanned.

Nothing here knows how large splats are. Spacing is what points have among themselves: the median over a point's
neighbours of the distance to the 4th nearest. A pixel's place is *surrounded* where points about its ray, none further
from it than REACH spacings of its own and all at one depth as near, leave no gap of more than MOST_ANGLE between their
directions. Elsewhere a splat would stick out beyond a rim, hang in a scanner's shadow, or bridge two surfaces that lie
one behind the other.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.execution.compiled import kernel, part
from pipeline.splats.decoded import scene_positions
from pipeline.splats.sizes import needed_sizes
from storage.packed.packed import PackedScene
from storage.packed.schema import Camera

REACH = 2.0  # spacings: as far as splats grow to close gaps (pipeline/splats/gaps.py), and twice what covers a lattice
MOST_ANGLE = np.radians(150)  # between directions to points that surround a place; at a straight rim it is 180
_NEAREST = 1e-9


def scanned_points(scene: PackedScene) -> tuple[np.ndarray, np.ndarray]:
    """The points of a packed scene, of levels the finest's, (n, 3) float64 absolute, and their spacing (n,)."""
    position = scene_positions(scene)[-scene.header.n_finest :]
    distance = cKDTree(np.unique(position, axis=0)).query(position, k=5)[0][:, 4]
    return position + np.array(scene.header.origin), needed_sizes(position, distance, scene.header.radius)


def surrounded(view: Camera, wanted: np.ndarray, position: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Which of the `wanted` pixels (height, width) bool of a view have points at absolute `position` (n, 3) on all
    sides, by their `spacing` (n,) positive.

    Guarantees: none but wanted pixels; those outside the convex hull of the points' pictures never.
    """
    local = np.ascontiguousarray((position - view.centre) @ np.array(view.rotation).T)
    lens = np.array([view.fx_px, view.fy_px, view.cx_px, view.cy_px])
    reach = REACH * np.asarray(spacing, np.float64)
    first = np.zeros(wanted.size + 1, np.int64)
    _about(local, reach, lens, wanted, first, np.empty((0, 4)))
    first[1:] = np.cumsum(first[:-1])
    first[0] = 0
    found = np.empty((int(first[-1]), 4))
    _about(local, reach, lens, wanted, first[:-1].copy(), found)
    return _are_surrounded(first, found).reshape(wanted.shape)


@kernel()
def _about(local, reach, lens, wanted, place, found):
    """Of each wanted pixel the points within their reach of its ray, as rows of `found` from its `place` on: x and y
    beside the ray, how far along it, reach. Without rows their number is added to the places."""
    height, width = wanted.shape
    fx, fy, cx, cy = lens
    for i in range(local.shape[0]):
        x, y, z, r = local[i, 0], local[i, 1], local[i, 2], reach[i]
        if z <= 2 * r:
            continue
        px, py = fx * x / z + cx, fy * y / z + cy
        wide, tall = fx * r / (z - r) * (1 + abs(x / z)) + 1, fy * r / (z - r) * (1 + abs(y / z)) + 1
        for row in range(max(0, int(py - tall)), min(height, int(py + tall) + 1)):
            for column in range(max(0, int(px - wide)), min(width, int(px + wide) + 1)):
                if not wanted[row, column]:
                    continue
                ray_x, ray_y = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
                along = (x * ray_x + y * ray_y + z) / (ray_x * ray_x + ray_y * ray_y + 1)
                side_x, side_y, side_z = x - along * ray_x, y - along * ray_y, z - along
                if side_x * side_x + side_y * side_y + side_z * side_z > r * r:
                    continue
                pixel = row * width + column
                if len(found):
                    k = place[pixel]
                    found[k, 0], found[k, 1], found[k, 2], found[k, 3] = side_x, side_y, along, r
                place[pixel] += 1


@kernel()
def _are_surrounded(first, found):
    n = len(first) - 1
    result = np.zeros(n, np.bool_)
    for pixel in range(n):
        begin, end = first[pixel], first[pixel + 1]
        for seed in range(begin, end):
            if _is_surrounded(found[begin:end], found[seed, 2], found[seed, 3]):
                result[pixel] = True
                break
    return result


@part()
def _is_surrounded(points, depth, reach):
    angles = np.empty(len(points))
    m = 0
    for j in range(len(points)):
        if abs(points[j, 2] - depth) > min(reach, points[j, 3]):
            continue
        if abs(points[j, 0]) + abs(points[j, 1]) < _NEAREST * reach:
            return True  # a point lies on the ray
        angle, place = np.arctan2(points[j, 1], points[j, 0]), m
        while place > 0 and angles[place - 1] > angle:
            angles[place] = angles[place - 1]
            place -= 1
        angles[place] = angle
        m += 1
    if m < 3:
        return False
    widest = angles[0] + 2 * np.pi - angles[m - 1]
    for j in range(1, m):
        widest = max(widest, angles[j] - angles[j - 1])
    return widest <= MOST_ANGLE
