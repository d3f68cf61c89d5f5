"""Gaps between splats: how large a splat must be to meet its neighbours' discs.

The distance to the 4th neighbour covers a lattice; of a plane of random points it leaves 2 to 3 % bare. What covers is
the distance to the farthest vertex of a point's Voronoi cell in its tangent plane. A vertex counts only where points
surround it: beyond a rim there is nothing to cover. Leaves and twigs, whose neighbours lie off the plane, have no cell.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipeline.execution.compiled import kernel, part

N_NEIGHBOURS = (
    24  # that cut a cell: where rows of a scanner lie four times as far apart as points along them, both next rows
)
# Times the size. Holes of a plane of random points: 2.8 % of sizes alone, 0.19 % with gaps closed, for 12 % more area.
MOST = 2.0
OFF_PLANE = 0.5  # of the size: what lies further off a splat's plane belongs to another surface
N_NEAREST = 8  # all of a splat's nearest so many lie in its plane, or it is no surface's: with one off it a spruce is drawn 1.16 times as often
MOST_ANGLE = np.radians(150.0)  # between directions to points about a vertex that surround it
AROUND = 2.0  # times its distance: points about a vertex
_MOST_CORNERS = 64  # a cell has at most 4 more than neighbours


@kernel()
def _furthest_vertices(position, near, normal, size, most):
    n, k = near.shape
    found = np.zeros(n)
    x, y = np.empty(k), np.empty(k)
    cell, spare = np.empty((_MOST_CORNERS, 2)), np.empty((_MOST_CORNERS, 2))
    edge, spare_edge = np.empty(_MOST_CORNERS, np.int64), np.empty(_MOST_CORNERS, np.int64)
    for i in range(n):
        n_near = _in_plane(position, normal, near, size, i, x, y)
        if n_near == 0:
            continue
        reach, furthest = 2 * most * size[i], most * size[i]
        cell[0, 0], cell[0, 1], cell[1, 0], cell[1, 1] = -reach, -reach, reach, -reach
        cell[2, 0], cell[2, 1], cell[3, 0], cell[3, 1] = reach, reach, -reach, reach
        edge[:4] = -1
        n_corners = 4
        for j in range(n_near):
            limit = (x[j] * x[j] + y[j] * y[j]) / 2
            m = 0
            for c in range(n_corners):
                e = c + 1 if c + 1 < n_corners else 0
                here = limit - cell[c, 0] * x[j] - cell[c, 1] * y[j]
                there = limit - cell[e, 0] * x[j] - cell[e, 1] * y[j]
                if here >= 0:
                    spare[m, 0], spare[m, 1], spare_edge[m] = cell[c, 0], cell[c, 1], edge[c]
                    m += 1
                if (here >= 0) != (there >= 0):
                    share = here / (here - there)
                    spare[m, 0] = cell[c, 0] + (cell[e, 0] - cell[c, 0]) * share
                    spare[m, 1] = cell[c, 1] + (cell[e, 1] - cell[c, 1]) * share
                    spare_edge[m] = j if here >= 0 else edge[c]
                    m += 1
            n_corners = m
            cell, spare, edge, spare_edge = spare, cell, spare_edge, edge
        for c in range(n_corners):
            if edge[c] < 0 or edge[c - 1 if c else n_corners - 1] < 0:
                continue
            away = np.sqrt(cell[c, 0] ** 2 + cell[c, 1] ** 2)
            if found[i] < away <= furthest and (
                away <= size[i] or _is_surrounded(cell[c, 0], cell[c, 1], x, y, n_near, away)
            ):
                found[i] = away
    return found


@part()
def _in_plane(position, normal, near, size, i, x, y):
    """Write the neighbours of splat `i` that lie in its plane as `x` and `y` on it; how many, 0 where it is no
    surface's."""
    n0, n1, n2 = normal[i, 0], normal[i, 1], normal[i, 2]
    if abs(n0) < 0.6:  # a tangent: across the normal and the x axis, or the y axis
        a0, a1, a2 = 0.0, n2, -n1
    else:
        a0, a1, a2 = -n2, 0.0, n0
    length = np.sqrt(a0 * a0 + a1 * a1 + a2 * a2)
    a0, a1, a2 = a0 / length, a1 / length, a2 / length
    b0, b1, b2 = n1 * a2 - n2 * a1, n2 * a0 - n0 * a2, n0 * a1 - n1 * a0
    n_near, n_flat, n_asked = 0, 0, 0
    for j in near[i]:
        d0, d1, d2 = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1], position[j, 2] - position[i, 2]
        if d0 * d0 + d1 * d1 + d2 * d2 <= 1e-12 * size[i] ** 2:
            continue
        flat = abs(d0 * n0 + d1 * n1 + d2 * n2) <= OFF_PLANE * size[i]
        if n_asked < N_NEAREST:
            n_asked += 1
            n_flat += flat
        if flat:
            x[n_near], y[n_near] = d0 * a0 + d1 * a1 + d2 * a2, d0 * b0 + d1 * b1 + d2 * b2
            n_near += 1
    return n_near if n_flat == n_asked else 0


@part()
def _is_surrounded(at_x, at_y, x, y, n_near, away):
    angles = np.empty(n_near + 1)
    angles[0] = np.arctan2(-at_y, -at_x)  # the splat itself
    m = 1
    for j in range(n_near):
        to_x, to_y = x[j] - at_x, y[j] - at_y
        if to_x * to_x + to_y * to_y <= (AROUND * away) ** 2:
            angle, place = np.arctan2(to_y, to_x), m
            while place > 0 and angles[place - 1] > angle:
                angles[place] = angles[place - 1]
                place -= 1
            angles[place] = angle
            m += 1
    widest = angles[0] + 2 * np.pi - angles[m - 1]
    for j in range(1, m):
        widest = max(widest, angles[j] - angles[j - 1])
    return widest <= MOST_ANGLE


def neighbours_in_reach(position: np.ndarray, around: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All positions (n + m, 3), those of the splats (n, 3) first, and the rows of N_NEIGHBOURS and itself nearest to
    each splat, (n, k)."""
    there = np.concatenate([position, around])
    n_asked = min(N_NEIGHBOURS + 1, len(there))
    near = cKDTree(there, balanced_tree=False).query(position, k=n_asked)[1]
    return there, near.reshape(len(position), n_asked)


def gap_radii(
    position: np.ndarray, near: np.ndarray, normal: np.ndarray, size: np.ndarray, most: float = MOST
) -> np.ndarray:
    """The distance (n,) float64 from each splat, the first n of `position` (n + m, 3), to the farthest vertex of its
    cell in the plane across its unit `normal` (n, 3), of those no further than `most` times its `size` (n,) that points
    surround; 0 where there is none. `near` (n, k) are rows of its neighbours, nearest first.

    Guarantees: finite, at most `most * size`; 0 for lines, copies and points whose nearest lie off their plane.
    """
    return _furthest_vertices(*(np.ascontiguousarray(a) for a in (position, near, normal, size)), most)
