"""Disc or ellipsoid: what the 2020 paper leaves open (sections 5.3.1 and 6).

A splat is a disc wherever a plane explains its neighbourhood, or a plane up to one straight line (what a clipline can
cut): interiors, borders, creases, corners, either face of a board. It is an ellipsoid where no plane through it does:
on what is thinner than the disc or more curved than the disc can follow.

"Explains" is measured as an arc. A plane is tried with every line that leaves all that stands above the plane behind it
(what lies below, such as the other face of a board, does not speak against the plane). Of the members within a
tolerance of the plane and on the kept side, those in a ring around the splat are sorted by direction; the longest run
of directions without a wide gap is the arc. Inside a plane it is the full turn, at a border half of it; on a rope it is
as narrow as the rope, at either end; on a ball next to nothing, as all that lies a radius away is off the plane.

Scan lines further apart than a splat look like wires, but have their like on both sides: what seems thin is looked at
again in twice and three times the reach, and is a disc after all where a plane explains nearly the full turn there.

Where two ropes cross a plane explains them as well as it explains a wall. So does a cross of two tubes, and no wall is
one.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.arcs import reach_arc
from pipeline.effects.ellipsoids.corners import are_corners
from pipeline.effects.ellipsoids.fit import moments, principal_axes
from pipeline.effects.ellipsoids.full import is_full
from pipeline.effects.ellipsoids.nearest import gather, narrowed
from pipeline.effects.ellipsoids.neighbourhoods import (
    LEAST,
    LEAST_AFTER_OUTLIERS,
    MOST,
    OUTLIER_REACHES,
    Around,
    Neighbourhood,
)
from pipeline.effects.ellipsoids.spread import spread_of
from pipeline.effects.ellipsoids.tubes import CROSSING_RADII, at_crossings

# Lengths in splat radii, angles in radians. Tuned on the room of tests/thin_scene.py, seeds 0 to 2, with noise of
# 0.05 to 0.23 radii; the test measures other seeds.
REACH_RADII = 2.5  # of the neighbourhood that decides
LEAST_ARC = math.radians(110)
TOLERANCE_RADII = 0.3
TOLERANCE_SIGMAS = 4.0  # of the scan's noise, where that is more
MOST_TOLERANCE_RADII = 0.8  # noise beyond it hides whatever is thinner than a disc
WIDER = (2.0, 3.0)
WIDER_ARC = math.radians(270)
CELLS_RADII = REACH_RADII / 2  # of the grid that neighbours are looked for in
WIDE_CELLS_RADII = REACH_RADII  # for wider neighbourhoods
AT_ONCE = 512  # neighbourhoods, of 1.5 kB each
WIDEST_RADII = OUTLIER_REACHES * REACH_RADII  # how far from a splat anything is looked at
# A neighbourhood whose second deviation is at most this is thin whatever a plane explains: half a disc of REACH_RADII
# has 0.66, a rope of one radius across its own 0.35. One above the second figure that is flat is no rope.
LINE_RADII = 0.45
WIDE_RADII = 0.7
# What no plane explains and yet fills the neighbourhood is rough or noisy, such as stray points of a stereo scan about
# relief (deviations of 1.2, 0.9 and 0.5 on fountain_p11): it has no outline of its own to be drawn.
SLENDER_RADII = 0.8  # second deviation: more than that of 95 % of points on ropes
SMALL_RADII = 1.0  # first deviation, of all small balls
CROSSING_WIDE_RADII = 1.1  # second deviation: two ropes at right angles have 1.04 in REACH_RADII, a plane 1.25


def thin_splats(point: np.ndarray, around: Around, radius: float, noise: float) -> np.ndarray:
    """Which of `point` (n, 3) no plane explains that is cut by a line at most, and so call for an ellipsoid, (n,) bool.

    `around` are the scan's points, thinned by CELL_RADII, to WIDEST_RADII about them, in cells of CELLS_RADII; `noise`
    of the scan (a length). Guarantees: a point without a neighbourhood is a disc; equal neighbourhoods are decided
    equally.
    """
    wide = Around(around.given, WIDE_CELLS_RADII * radius, round(WIDEST_RADII / WIDE_CELLS_RADII))
    count, is_wide, deviation = _spread(point, around, wide, radius)
    tolerance = _tolerance(radius, noise)
    known = (count >= LEAST_AFTER_OUTLIERS) & ~is_wide  # the others are discs
    first, second, third = deviation.T / radius
    flat = (third <= 0.5 * tolerance) & (second >= WIDE_RADII)
    slender = (second <= SLENDER_RADII) | (first <= SMALL_RADII)
    thin = known & ~flat & slender
    planes = thin & (second > LINE_RADII)
    thin &= ~planes
    crossing = known & ~thin & ~planes
    rows = np.flatnonzero(crossing)
    crossing[rows] = ~is_full(point[rows], wide, CROSSING_RADII * radius)
    open_, full = planes | thin | crossing, count > MOST  # one that is full is the same in any wider reach
    for reach, rows in ((REACH_RADII, open_ & full), (WIDER[0] * REACH_RADII, open_ & ~full)):
        for part in _parts(point, np.flatnonzero(rows), wide):
            near = gather(point[part], wide, reach * radius, radius)
            sizes = deviation[part] / radius
            thin[part] = _thin(point[part], wide, near, thin[part], planes[part], sizes, radius, noise)
    return thin


def _parts(point: np.ndarray, rows: np.ndarray, around: Around) -> list[np.ndarray]:
    """`rows` by AT_ONCE, those of a cell together: they share a search."""
    if around.is_grid:
        rows = rows[np.argsort(around.cells(point[rows]))]
    return [rows[start : start + AT_ONCE] for start in range(0, len(rows), AT_ONCE)]


def _thin(
    point: np.ndarray,
    around: Around,
    near: Neighbourhood,
    thin: np.ndarray,
    planes: np.ndarray,
    deviation: np.ndarray,
    radius: float,
    noise: float,
) -> np.ndarray:  # (n,) bool
    """Of neighbourhoods in radii, all in twice the reach: those that are `thin`, or that no plane explains (`planes`:
    where that is open), or else where two ropes cross, unless they are scan lines or corners of flat things."""
    rows = np.flatnonzero(planes)
    closer = narrowed(_rows(near, rows), REACH_RADII)
    thin[rows] = ~reach_arc(closer.offset, closer.count, _tolerance(radius, noise), LEAST_ARC)
    rows = np.flatnonzero(~thin & (near.count < MOST))  # two tubes have fewer: rooms 36, crossed wires 56
    thin[rows] = at_crossings(_rows(near, rows))
    rows = np.flatnonzero(thin)
    thin[rows] = _stay_thin(point[rows], around, _rows(near, rows), deviation[rows], radius, noise)
    return thin


def _rows(near: Neighbourhood, rows: np.ndarray) -> Neighbourhood:
    return Neighbourhood(near.offset[rows], near.count[rows])


def _spread(
    point: np.ndarray, around: Around, wide: Around, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each neighbourhood of REACH_RADII its members, whether it is too wide to be thin, and its deviations."""
    reach = REACH_RADII * radius
    found = spread_of(point, around, reach, CROSSING_WIDE_RADII * radius)
    count, is_wide, deviation = found.count, found.is_wide, found.deviation
    rows = np.flatnonzero((count < LEAST) | (count > MOST))
    near = gather(point[rows], wide, reach)
    count[rows] = np.where(count[rows] > MOST, count[rows], near.count)
    deviation[rows] = principal_axes(moments(near.offset, near.count)[1])[0]
    is_wide[rows] = deviation[rows, 1] > CROSSING_WIDE_RADII * radius
    return count, is_wide, deviation


def _stay_thin(
    point: np.ndarray, around: Around, further: Neighbourhood, deviation: np.ndarray, radius: float, noise: float
) -> np.ndarray:  # (n,) bool
    """Of what seems thin, all but scan lines and corners of flat things; lengths in radii, `further` in twice the
    reach. A neighbourhood that is full is the same in any wider reach."""
    thin = ~flat_further_out(further, WIDER[0], radius, noise)
    rows = np.flatnonzero(thin)
    flatness = 0.5 * _tolerance(radius, noise)
    thin[rows] = ~are_corners(_rows(further, rows), deviation[rows], LINE_RADII, REACH_RADII, flatness)
    full, open_ = np.flatnonzero(thin & (further.count == MOST)), np.flatnonzero(thin & (further.count < MOST))
    thin[full] = ~flat_further_out(_rows(further, full), WIDER[1], radius, noise)
    widest = gather(point[open_], around, WIDER[1] * REACH_RADII * radius, radius)
    thin[open_] = ~flat_further_out(widest, WIDER[1], radius, noise)
    return thin


def _tolerance(radius: float, noise: float) -> float:
    """How far from a plane, in radii, what it explains may lie."""
    return min(max(TOLERANCE_RADII, TOLERANCE_SIGMAS * noise / radius), MOST_TOLERANCE_RADII)


def flat_further_out(around: Neighbourhood, times: float, radius: float, noise: float) -> np.ndarray:
    """Where a plane explains nearly all directions, (n,) bool, for splats `times` as large; offsets in radii."""
    tolerance = _tolerance(times * radius, noise)
    return reach_arc(around.offset, around.count, tolerance, WIDER_ARC, times)
