"""Patches from a station's map: each texel of a splat's square is looked up in the direction that it lies in.

A lookup is bilinear among the map's texels that show the splat's own surface, as their distances tell: what hides the
splat, or lies behind its rim, has no part in it. Texels of a patch that find nothing take after those around them, so
that the patch is as smooth there as it can be, and costs the coder little.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor

import numpy as np

from pipeline.cameras.polar_capped import BAND, chart_of, in_chart
from pipeline.execution.compiled import kernel, part
from pipeline.maps.station_map import NOTHING, StationMap
from storage.packed.schema import PATCH_SIZE

# How far from a splat's plane its surface may lie on the map: a share of the distance, for registration; of the splat's
# radius, for what its plane leaves out of a curved surface; and of a texel, for a slope.
SHARE_OF_DISTANCE = 0.005
SHARE_OF_RADIUS = 0.5
TEXELS = 1.0
MOST_OF_DISTANCE = 0.5  # a splat whose slack is more surrounds the station: its map has nothing to say of it
STEEPEST_SLOPE = 10.0
MOST_LOOKUPS = 8  # of a texel of a patch, along each axis
LEAST_VALID = 0.25  # of a lookup's bilinear weights, that it counts
ALL_LEVELS = np.arange(256.0).repeat(3).reshape(256, 3)  # light as it was taken


@dataclass(frozen=True)
class Squares:
    """Splats as squares with a frame. Rows correspond; lengths are in the scan's unit."""

    centre: np.ndarray  # (n, 3) float64 against the station
    u: np.ndarray  # (n, 3) tangents, at right angles to each other, in radii
    v: np.ndarray  # (n, 3)
    radius: np.ndarray  # (n,)

    def only(self, rows: np.ndarray) -> Squares:
        return Squares(self.centre[rows], self.u[rows], self.v[rows], self.radius[rows])

    @property
    def normal(self) -> np.ndarray:  # (n, 3) unit
        normal = np.cross(self.u, self.v)
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def slack(squares: Squares, step: float) -> np.ndarray:
    """How far from its own a distance on a map of this step may be for it to be the splat's surface, (n,)."""
    distance = np.linalg.norm(squares.centre, axis=1)
    along = np.abs((squares.centre * squares.normal).sum(axis=1))
    slope = np.sqrt(np.maximum(distance**2 - along**2, 0)) / np.maximum(along, 1e-30)
    texel = TEXELS * step * distance * np.minimum(slope, STEEPEST_SLOPE)
    return SHARE_OF_DISTANCE * distance + SHARE_OF_RADIUS * squares.radius + texel


def texels_spanned(squares: Squares, step: float) -> np.ndarray:
    """How many texels of a map of this step lie side by side in each, (n,), seen from the station."""
    return np.maximum(2 * squares.radius / np.maximum(np.linalg.norm(squares.centre, axis=1), 1e-30) / step, 1e-30)


def seen_at_centre(station_map: StationMap, squares: Squares) -> np.ndarray:
    """(n,) bool: the map shows the splat's surface where its centre lies."""
    frame = station_map.frame
    distance = np.linalg.norm(squares.centre, axis=1)
    share = slack(squares, frame.projection.step) / np.maximum(distance, 1e-30)
    off = share * frame.codes_an_e_fold
    return _seen(station_map.depth, squares.centre, _code(distance, frame), off) & (share <= MOST_OF_DISTANCE)


def foreign_points(station_map: StationMap, squares: Squares, points: np.ndarray) -> np.ndarray:
    """(n, m) bool: which of `points` (m, 2) of a splat's unit disc the map shows nothing of, or another surface in
    place of it."""
    frame = station_map.frame
    foreign = np.zeros((len(squares.radius), len(points)), bool)
    _mark_foreign(
        station_map.depth,
        1.0 / frame.nearest,
        frame.codes_an_e_fold,
        squares.centre,
        squares.u,
        squares.v,
        squares.radius,
        slack(squares, frame.projection.step),
        points,
        foreign,
    )
    return foreign


def sample_patches(
    station_map: StationMap, squares: Squares, levels: np.ndarray = ALL_LEVELS
) -> tuple[np.ndarray, np.ndarray]:
    """Patches (n, PATCH_SIZE, PATCH_SIZE, 3) uint8 of splats, and the share (n,) of their texels that the map shows;
    those of no share are zeros. `levels` (256, 3) uint8 are what its levels are made to be, channel by channel."""
    n = len(squares.radius)
    patches, share = np.zeros((n, PATCH_SIZE, PATCH_SIZE, 3), np.uint8), np.zeros(n)
    frame = station_map.frame
    _sample(
        station_map.color,
        station_map.depth,
        np.ascontiguousarray(levels, np.float64),
        1.0 / frame.nearest,
        frame.codes_an_e_fold,
        frame.projection.step,
        squares.centre,
        squares.u,
        squares.v,
        squares.radius,
        slack(squares, frame.projection.step),
        patches,
        share,
    )
    return patches, share


def _code(distance: np.ndarray, frame) -> np.ndarray:
    return np.log(np.maximum(distance, 1e-30) / frame.nearest) * frame.codes_an_e_fold


@kernel()
def _seen(depth, centre, code, off):
    height = depth.shape[0]
    found = np.zeros(len(centre), np.bool_)
    for i in range(len(centre)):
        x, y, z = centre[i]
        if x * x + y * y + z * z > 0:
            column, row = in_chart(chart_of(x, y, z), x, y, z, height)
            there = depth[min(int(row), height - 1), min(int(column), 6 * height - 1)]
            found[i] = there != NOTHING and abs(there - code[i]) <= off[i]
    return found


@kernel(error_model="numpy")
def _mark_foreign(depth, per_nearest, codes, centre, u, v, radius, slack, points, foreign):
    height = depth.shape[0]
    for i in range(len(radius)):
        for j in range(len(points)):
            a, b = radius[i] * points[j, 0], radius[i] * points[j, 1]
            x = centre[i, 0] + a * u[i, 0] + b * v[i, 0]
            y = centre[i, 1] + a * u[i, 1] + b * v[i, 1]
            z = centre[i, 2] + a * u[i, 2] + b * v[i, 2]
            away = np.sqrt(x * x + y * y + z * z)
            if slack[i] <= MOST_OF_DISTANCE * away:
                column, row = in_chart(chart_of(x, y, z), x, y, z, height)
                there = depth[min(int(row), height - 1), min(int(column), 6 * height - 1)]
                foreign[i, j] = (
                    there == NOTHING or abs(there - np.log(away * per_nearest) * codes) > slack[i] / away * codes
                )


@part(error_model="numpy")
def _look_up(color, depth, levels, x, y, z, code, off, total):
    """Add the lookup in a direction to total (3,), over the texels whose distance codes are within `off` of `code`.
    Returns whether there are enough."""
    height = depth.shape[0]
    chart = chart_of(x, y, z)
    column, row = in_chart(chart, x, y, z, height)
    left, top = floor(column - 0.5), floor(row - 0.5)
    right_share, down_share = column - 0.5 - left, row - 0.5 - top
    weights, red, green, blue = 0.0, 0.0, 0.0, 0.0
    for j in range(2):
        r = min(max(int(top) + j, 0), height - 1)
        for i in range(2):
            c = int(left) + i
            if chart == BAND:
                c = (c - 2 * height) % (4 * height) + 2 * height
            else:
                c = min(max(c, chart * height), (chart + 1) * height - 1)
            there = depth[r, c]
            if there == NOTHING or abs(there - code) > off:
                continue
            weight = (right_share if i else 1 - right_share) * (down_share if j else 1 - down_share)
            weights += weight
            red += weight * levels[color[r, c, 0], 0]
            green += weight * levels[color[r, c, 1], 1]
            blue += weight * levels[color[r, c, 2], 2]
    if weights < LEAST_VALID:
        return False
    total[0] += red / weights
    total[1] += green / weights
    total[2] += blue / weights
    return True


@kernel(error_model="numpy")
def _sample(color, depth, levels, per_nearest, codes, step, centre, u, v, radius, slack, patches, share):
    size = PATCH_SIZE
    filled, known = np.empty((size, size, 3)), np.empty((size, size), np.bool_)
    total = np.empty(3)
    for i in range(len(radius)):
        c, distance = centre[i], np.sqrt(centre[i, 0] ** 2 + centre[i, 1] ** 2 + centre[i, 2] ** 2)
        n = int(min(max(1, ceil(2 * radius[i] / size / (step * distance) - 1e-9)), MOST_LOOKUPS)) if distance > 0 else 1
        n_known = 0
        for row in range(size):
            for column in range(size):
                total[:] = 0.0
                hits = 0
                for k in range(n * n):
                    a = radius[i] * ((column + (k % n + 0.5) / n) * (2.0 / size) - 1.0)
                    b = radius[i] * ((row + (k // n + 0.5) / n) * (2.0 / size) - 1.0)
                    x = c[0] + a * u[i, 0] + b * v[i, 0]
                    y = c[1] + a * u[i, 1] + b * v[i, 1]
                    z = c[2] + a * u[i, 2] + b * v[i, 2]
                    away = np.sqrt(x * x + y * y + z * z)
                    if slack[i] <= MOST_OF_DISTANCE * away:
                        off = slack[i] / away * codes
                        if _look_up(color, depth, levels, x, y, z, np.log(away * per_nearest) * codes, off, total):
                            hits += 1
                known[row, column] = hits > 0
                if hits:
                    n_known += 1
                    for k in range(3):
                        filled[row, column, k] = total[k] / hits
        share[i] = n_known / (size * size)
        if n_known:
            if n_known < size * size:
                fill(filled, known)
            for row in range(size):
                for column in range(size):
                    for k in range(3):
                        patches[i, row, column, k] = np.uint8(min(max(filled[row, column, k], 0.0), 255.0) + 0.5)


@kernel()
def fill(picture, known):
    """Fill what is not known of a square picture (s, s, 3), s a power of 2, of which something is: from coarser and
    coarser means of what is known, back to the finest (pull and push; Gortler et al., The Lumigraph, 1996)."""
    size = picture.shape[0]
    if size == 1:
        return
    half = size // 2
    coarse, has = np.zeros((half, half, 3)), np.zeros((half, half), np.bool_)
    for row in range(half):
        for column in range(half):
            n = 0
            for j in range(2):
                for i in range(2):
                    if known[2 * row + j, 2 * column + i]:
                        n += 1
                        for k in range(3):
                            coarse[row, column, k] += picture[2 * row + j, 2 * column + i, k]
            if n:
                has[row, column] = True
                for k in range(3):
                    coarse[row, column, k] /= n
    fill(coarse, has)
    for row in range(size):
        for column in range(size):
            if not known[row, column]:
                y = min(max((row - 0.5) / 2, 0.0), half - 1.0)
                x = min(max((column - 0.5) / 2, 0.0), half - 1.0)
                top, left = int(y), int(x)
                bottom, right = min(top + 1, half - 1), min(left + 1, half - 1)
                g, f = y - top, x - left
                for k in range(3):
                    upper = (1 - f) * coarse[top, left, k] + f * coarse[top, right, k]
                    lower = (1 - f) * coarse[bottom, left, k] + f * coarse[bottom, right, k]
                    picture[row, column, k] = (1 - g) * upper + g * lower
