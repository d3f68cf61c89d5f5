"""A station's map drawn from the splats that it saw: first the nearest surface of each texel, then the colours of all
splats that lie on it, blended in linear light with the weight (1 - d^2)^SHARPNESS.

A texel shows a surface, not a sample: splats are discs in their own plane, as wide as their points lie apart, so what
lies between samples is closed and silhouettes are those of discs. No sample is lost: each has at least the texel that
it falls into.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, ceil, floor, hypot, pi

import numpy as np

from pipeline.cameras.polar_capped import BAND, BOTTOM, COLUMNS, TOP, direction_at
from pipeline.execution.compiled import kernel, part
from pipeline.maps.station_map import MapFrame, StationMap, encode_distances
from pipeline.numerics.srgb import LINEAR_OF_LEVEL, levels_of_linear

NARROWEST, WIDEST = 0.75, 6.0  # radii of splats in steps of the map: no holes between texels, and no blobs of strays
SHARPNESS = 3  # of weights: 1 is the renderer's; maps are looked up once more, and splats blended once more
MARGIN = 1.0  # radii behind the nearest surface that still blend with it
OWN_TEXEL = 0.71  # steps: half of a texel's diagonal
LEAST_WEIGHT = 1e-3  # of a sample in its own texel, where its disc is seen from the side
# A splat this near, in its own radii, surrounds the station: a tripod, a hand. It has no place on a map.
NEAREST_RADII = 2.0
CORNER = pi / 2 * 0.5**0.5  # from the pole to the corner of a cap's square
CHANNELS = 5  # of sums: linear red, green and blue, distance, weight


@dataclass(frozen=True)
class Canvas:
    """A map being drawn."""

    nearest: np.ndarray  # (h, 6 h) float32: distance of the nearest surface, infinite where there is none yet
    sums: np.ndarray  # (h, 6 h, CHANNELS) float32, weighted


def empty_canvas(height: int) -> Canvas:
    """A canvas of `height` rows that nothing has been drawn on: all depths are infinite."""
    shape = (height, COLUMNS * height)
    return Canvas(np.full(shape, np.inf, np.float32), np.zeros((*shape, CHANNELS), np.float32))


def draw_depth(canvas: Canvas, local: np.ndarray, normal: np.ndarray, radius: np.ndarray) -> int:
    """Lower the nearest surfaces to those of splats at `local` (n, 3) from the station, with unit `normal` (n, 3),
    either way round, and `radius` (n,). Returns how many were left out, as they surround the station."""
    color = np.empty((0, 3), np.uint8)
    return _draw(canvas.nearest, canvas.sums, local, normal, radius, color, LINEAR_OF_LEVEL)


def draw_color(canvas: Canvas, local: np.ndarray, normal: np.ndarray, radius: np.ndarray, color: np.ndarray) -> None:
    """Add the colours (n, 3) uint8 of splats to the texels in which they lie on the nearest surface, once that is
    known."""
    if len(local):
        _draw(canvas.nearest, canvas.sums, local, normal, radius, color, LINEAR_OF_LEVEL)


def finish(canvas: Canvas, station: int, centre: tuple[float, float, float]) -> StationMap:
    """The map of what was drawn."""
    weight = canvas.sums[..., 4]
    covered = weight > 0
    color = np.zeros((*weight.shape, 4), np.uint8)
    safe = np.where(covered, weight, np.float32(1))
    for k in range(3):
        color[..., k] = np.where(covered, levels_of_linear(canvas.sums[..., k] / safe), 0)
    color[..., 3] = np.where(covered, 255, 0)
    distance = np.where(covered, canvas.sums[..., 3] / safe, np.inf)
    known = distance[covered]
    low, high = (float(known.min()), float(known.max())) if len(known) else (1.0, 1.0)
    frame = MapFrame(station, centre, len(weight), low, max(high, low * (1 + 1e-6)))
    return StationMap(frame, color, encode_distances(distance, frame))


@kernel()
def _draw(nearest, sums, local, normal, radius, color, linear):
    """Both passes: without colours the depth is lowered, with them they are added."""
    n_left_out = 0
    height = nearest.shape[0]
    for i in range(local.shape[0]):
        distance = np.sqrt(local[i, 0] ** 2 + local[i, 1] ** 2 + local[i, 2] ** 2)
        if not distance > NEAREST_RADII * radius[i]:
            n_left_out += 1
            continue
        reach = asin(radius[i] / distance) + OWN_TEXEL * pi / 2 / height
        for chart in (BOTTOM, TOP, BAND):
            first_row, last_row, first_column, last_column = texels_around(chart, local[i], distance, reach, height)
            for row in range(first_row, last_row + 1):
                for turn in range(first_column, last_column + 1):
                    column = turn
                    if chart == BAND:
                        column = (turn - 2 * height) % (4 * height) + 2 * height
                    x, y, z = direction_at(chart, column + 0.5, row + 0.5, height)
                    away, weight = _hit(x, y, z, local[i], normal[i], distance, radius[i], height)
                    if not weight > 0:
                        continue
                    if not len(color):
                        nearest[row, column] = min(nearest[row, column], np.float32(away))
                    elif away <= nearest[row, column] + MARGIN * radius[i]:
                        for k in range(3):
                            sums[row, column, k] += np.float32(weight * linear[color[i, k]])
                        sums[row, column, 3] += np.float32(weight * away)
                        sums[row, column, 4] += np.float32(weight)
    return n_left_out


@part(error_model="numpy")
def _hit(x, y, z, centre, normal, distance, radius, height):
    """Where a ray from the station meets a splat: the distance along it, and the blending weight, 0 for a miss."""
    facing = x * normal[0] + y * normal[1] + z * normal[2]
    away = (centre[0] * normal[0] + centre[1] * normal[1] + centre[2] * normal[2]) / facing
    if away > 0 and away < 2 * distance:
        off = (away * x - centre[0]) ** 2 + (away * y - centre[1]) ** 2 + (away * z - centre[2]) ** 2
        weight = 1 - off / (radius * radius)
        if weight > 0:
            return away, weight**SHARPNESS
    chord = (x - centre[0] / distance) ** 2 + (y - centre[1] / distance) ** 2 + (z - centre[2] / distance) ** 2
    if chord <= (OWN_TEXEL * pi / 2 / height) ** 2:
        return distance, LEAST_WEIGHT
    return distance, 0.0


@part()
def texels_around(chart, point, distance, reach, height):
    """First and last row and column of a chart's texels within the angle `reach` of a point's direction; last before
    first where there are none. Columns of the band may lie beyond its seam by less than a turn."""
    psi = asin(min(1.0, max(-1.0, point[2] / distance)))
    if chart == BAND:
        if abs(psi) - reach > pi / 4:
            return 0, -1, 0, -1
        first_row = max(0, int(floor(height * ((psi - reach) * 2 / pi + 0.5))))
        last_row = min(height - 1, int(floor(height * ((psi + reach) * 2 / pi + 0.5))))
        level = np.cos(psi)
        if np.sin(reach) >= level or reach >= pi / 2:
            return first_row, last_row, 2 * height, 6 * height - 1
        middle, half = (
            height * (2 / pi * np.arctan2(point[1], point[0]) + 2),
            height * 2 / pi * asin(np.sin(reach) / level),
        )
        if half >= 2 * height - 1:
            return first_row, last_row, 2 * height, 6 * height - 1
        return first_row, last_row, int(floor(middle - half)), int(floor(middle + half))
    alpha = pi / 2 - psi if chart == TOP else pi / 2 + psi
    if alpha - reach > CORNER:
        return 0, -1, 0, -1
    end = min(alpha + reach, 0.8 * pi)
    half = height * 2 / pi * reach * (end / np.sin(end) if end > 1e-6 else 1.0)
    rho = hypot(point[0], point[1])
    out = height * 2 / pi * alpha / rho if rho > 0 else 0.0
    left = height if chart == TOP else 0
    middle_column, middle_row = left + height / 2 + out * point[0], height / 2 + out * point[1]
    return (
        max(0, int(floor(middle_row - half))),
        min(height - 1, int(floor(middle_row + half))),
        max(left, int(floor(middle_column - half))),
        min(left + height - 1, int(ceil(middle_column + half))),
    )
