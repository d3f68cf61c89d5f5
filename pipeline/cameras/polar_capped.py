"""The map of a laser station: the whole sphere in three charts, a band around the horizon between two polar caps.

    columns 0 .. H     bottom cap, elevation below -45 degrees   (azimuthal equidistant)
    columns H .. 2H    top cap, elevation above +45 degrees
    columns 2H .. 6H   band, azimuth along the columns from 0 on, elevation along the rows (plate carree)

A map is H = `height_px` rows high and 6H columns wide; its step is pi / 2H radians in all charts. With rho = hypot(x,
y):

    caps   r = 2/pi atan2(rho, |z|)    column = H (x r/rho + 1/2 [bottom] or + 3/2 [top])   row = H (y r/rho + 1/2)
    band   column = H (4 frac(theta / 2 pi) + 2)                                            row = H (2 psi/pi + 1/2)

Texels' solid angles are step^2 cos(psi) in the band and step^2 sin(alpha) / alpha, alpha from the pole, in caps: from
0.707 to 1. The corners of the caps' squares show directions that the band shows too.

References: Comino, Andujar, Chica and Brunet, CEIG 2019, section 3.1 and equations 1 to 6, of which the printed inverse
is not one: r is not 2 pi arccos(z), nor t of the band divided by 2 pi; arccos loses half of its digits at the poles.
Snyder and Mitchell, Sampling-efficient mapping of spherical images, 2001.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, hypot, pi

import numpy as np

from pipeline.execution.compiled import kernel, part

BOTTOM, TOP, BAND = range(3)  # the charts
COLUMNS = 6  # of a map, in heights
BELOW_ONE = 1 - 2.0**-52


def height_for(step: float) -> int:
    """Rows of the coarsest map whose step is no more than this, in radians.

    >>> height_for(np.radians(0.1))
    900
    """
    return max(1, ceil(pi / 2 / step - 1e-9))


@dataclass(frozen=True)
class PolarCapped:
    """A `Projection` (camera.py): depth is the distance from the centre; z is up."""

    centre: tuple[float, float, float]
    height_px: int

    @property
    def size(self) -> tuple[int, int]:
        return COLUMNS * self.height_px, self.height_px

    @property
    def step(self) -> float:
        """Of a texel, in radians."""
        return pi / 2 / self.height_px

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, depth = np.empty((len(points), 2)), np.empty(len(points))
        _project(np.asarray(points, np.float64) - np.asarray(self.centre), self.height_px, pixels, depth)
        return pixels, depth

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        direction = np.empty((len(pixels), 3))
        _unproject(np.asarray(pixels, np.float64), self.height_px, direction)
        return direction * np.asarray(depth, np.float64)[:, None] + np.asarray(self.centre)

    def footprint(self, pixels: np.ndarray) -> np.ndarray:
        found = np.empty(len(pixels))
        _footprint(np.asarray(pixels, np.float64), self.height_px, found)
        return found


@part()
def chart_of(x, y, z):
    """The chart that shows a direction of any length but 0."""
    if abs(z) <= hypot(x, y):
        return BAND
    return TOP if z > 0 else BOTTOM


@part(error_model="numpy")
def in_chart(chart, x, y, z, height):
    """Column and row of a direction of any length but 0 in a chart, which need not be the one that shows it."""
    rho = hypot(x, y)
    if chart == BAND:
        turn = np.arctan2(y, x) / (2 * pi)
        turn -= floor(turn)
        if turn >= 1.0:  # a hair below 0
            turn = 0.0
        return height * (4 * turn + 2), height * (np.arctan2(z, rho) * (2 / pi) + 0.5)
    away = z if chart == TOP else -z
    stretch = 2 / pi * np.arctan2(rho, away) / rho if rho > 0 else 0.0
    return height * (x * stretch + (1.5 if chart == TOP else 0.5)), height * (y * stretch + 0.5)


@part()
def chart_at(column, height):
    """The chart that a column belongs to; each has its first column, not the one after its last."""
    if column < height:
        return BOTTOM
    return TOP if column < 2 * height else BAND


@part(error_model="numpy")
def direction_at(chart, column, row, height):
    """The unit direction that a chart has at this column and row, also beyond its edges."""
    if chart == BAND:
        theta, psi = (column / height - 2) * (pi / 2), (row / height - 0.5) * (pi / 2)
        level = np.cos(psi)
        return level * np.cos(theta), level * np.sin(theta), np.sin(psi)
    u, v = column / height - (1.5 if chart == TOP else 0.5), row / height - 0.5
    r = hypot(u, v)
    along = np.sin(pi / 2 * r) / r if r > 0 else pi / 2
    down = np.cos(pi / 2 * r)
    return u * along, v * along, down if chart == TOP else -down


@kernel()
def _project(local, height, pixels, depth):
    for i in range(local.shape[0]):
        x, y, z = local[i]
        distance = np.sqrt(x * x + y * y + z * z)
        if distance > 0:
            chart = chart_of(x, y, z)
            column, pixels[i, 1] = in_chart(chart, x, y, z, height)
            if chart != BAND:  # what rounds to the first column of the next chart
                column = min(column, (chart + 1) * height * BELOW_ONE)
            pixels[i, 0], depth[i] = column, distance
        else:
            pixels[i, 0], pixels[i, 1], depth[i] = np.nan, np.nan, np.nan


@kernel()
def _unproject(pixels, height, direction):
    for i in range(pixels.shape[0]):
        column, row = pixels[i]
        direction[i, 0], direction[i, 1], direction[i, 2] = direction_at(chart_at(column, height), column, row, height)


@kernel(error_model="numpy")
def _footprint(pixels, height, found):
    step = pi / 2 / height
    for i in range(pixels.shape[0]):
        column, row = pixels[i]
        chart = chart_at(column, height)
        if chart == BAND:
            shrunk = np.cos((row / height - 0.5) * (pi / 2))
        else:
            alpha = pi / 2 * hypot(column / height - (1.5 if chart == TOP else 0.5), row / height - 0.5)
            shrunk = np.sin(alpha) / alpha if alpha > 0 else 1.0
        found[i] = step * step * shrunk
