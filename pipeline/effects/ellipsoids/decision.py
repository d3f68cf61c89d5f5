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
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipeline.effects.ellipsoids.corners import are_corners
from pipeline.effects.ellipsoids.fit import moments, principal_axes
from pipeline.effects.ellipsoids.neighbourhoods import LEAST_AFTER_OUTLIERS, OUTLIER_REACHES, Neighbourhood, gather
from pipeline.effects.ellipsoids.wide import are_wide
from pipeline.execution.compiled import kernel
from pipeline.numerics.hashing import FIRST, STEP

# Lengths in splat radii, angles in radians. Tuned on the room of tests/thin_scene.py, seeds 0 to 2, with noise of
# 0.05 to 0.23 radii; the test measures other seeds.
REACH_RADII = 2.5  # of the neighbourhood that decides
RING_RADII = 1.25  # members nearer than this say nothing of whether a disc of one radius is filled
WIDEST_GAP = math.radians(65)  # half a ring has 10 members at the median density: most gaps between them stay below
LEAST_ARC = math.radians(110)
TOLERANCE_RADII = 0.3
TOLERANCE_SIGMAS = 4.0  # of the scan's noise, where that is more
MOST_TOLERANCE_RADII = 0.8  # noise beyond it hides whatever is thinner than a disc
WIDER = (2.0, 3.0)
WIDER_ARC = math.radians(270)
WIDEST_RADII = OUTLIER_REACHES * REACH_RADII  # how far from a splat anything is looked at
HYPOTHESES = 32  # planes through three members; a quarter of the threes at a crease lie on one side of it
LINES = 16  # directions a line may have
# A neighbourhood whose second deviation is at most this is thin whatever a plane explains: half a disc of REACH_RADII
# has 0.66, a rope of one radius across its own 0.35. One above the second figure that is flat is no rope.
LINE_RADII = 0.45
WIDE_RADII = 0.7
# What no plane explains and yet fills the neighbourhood is rough or noisy, such as stray points of a stereo scan about
# relief (deviations of 1.2, 0.9 and 0.5 on fountain_p11): it has no outline of its own to be drawn.
SLENDER_RADII = 0.8  # second deviation: more than that of 95 % of points on ropes
SMALL_RADII = 1.0  # first deviation, of all small balls
# Two tubes that explain a neighbourhood twice as wide are ropes that cross. Half widths of 0.6 and 0.75 radii, shares
# of 0.85 and 0.93, reaches of 3.75 and 5 radii and one to three tubes were tried on rooms of seeds 11, 13, 17 and 19:
# with these, ropes that are right go from 0.82 to 0.96 up to 0.88 to 0.97 and flat things lose nothing; three tubes
# lose 1 % of those, 3.75 radii 2 % of round ones.
CROSSING_RADII = 5.0
TUBE_RADII = 0.6
TUBES_SHARE = 0.85
FIRST_SHARE = 0.4  # of the first tube: what no tube through the splat explains so far, a second does not explain either
CROSSING_WIDE_RADII = 1.1  # second deviation: two ropes at right angles have 1.04 in REACH_RADII, a plane 1.25


@dataclass(frozen=True)
class Verdict:
    """What was decided of each splat, and from what."""

    ellipsoid: np.ndarray  # (n,) bool
    arc: np.ndarray  # (n,) float64 radians: of the best plane and line found, where only it could tell; 0 elsewhere


def decide(around: Neighbourhood, deviation: np.ndarray, radius: float, noise: float) -> Verdict:
    """`around` with a reach of REACH_RADII; its `deviation` (n, 3), longest first; `noise` of the scan (a length).

    Guarantees: a point without a neighbourhood is a disc; equal neighbourhoods are decided equally, in any unit.
    """
    sigma = deviation / radius
    tolerance = _tolerance(radius, noise)
    enough = around.count >= LEAST_AFTER_OUTLIERS
    line = sigma[:, 1] <= LINE_RADII
    flat = (sigma[:, 2] <= 0.5 * tolerance) & (sigma[:, 1] >= WIDE_RADII)
    slender = (sigma[:, 1] <= SLENDER_RADII) | (sigma[:, 0] <= SMALL_RADII)
    open_ = np.flatnonzero(enough & slender & ~line & ~flat)  # most splats are neither: planes are tried for few
    arc = np.zeros(len(sigma))
    arc[open_] = _best_arcs(around.offset[open_] / radius, around.count[open_], tolerance, LEAST_ARC)
    return Verdict(enough & ~flat & slender & (arc < LEAST_ARC), arc)


def thin_splats(
    point: np.ndarray, around: np.ndarray, radius: float, noise: float, near: Neighbourhood | None = None
) -> np.ndarray:
    """Which of `point` (n, 3) call for an ellipsoid, (n,) bool. `around` (m, 3) are the scan's points, thinned by
    CELL_RADII, to WIDEST_RADII about them; `near` their neighbourhoods of REACH_RADII, if they are known."""
    if near is not None:
        return _thin_of_open(point, around, radius, noise, near)
    thin = ~are_wide(point, around, REACH_RADII * radius, CROSSING_WIDE_RADII * radius)
    open_ = np.flatnonzero(thin)
    if len(open_):
        tree = cKDTree(around) if len(around) else None
        near = gather(point[open_], around, REACH_RADII * radius, tree)
        thin[open_] = _thin_of_open(point[open_], around, radius, noise, near, tree)
    return thin


def _thin_of_open(
    point: np.ndarray, around: np.ndarray, radius: float, noise: float, near: Neighbourhood, tree: cKDTree | None = None
) -> np.ndarray:  # (n,) bool
    deviation, _ = principal_axes(moments(near.offset, near.count)[1])
    thin = decide(near, deviation, radius, noise).ellipsoid
    rows = np.flatnonzero(
        ~thin & (near.count >= LEAST_AFTER_OUTLIERS) & (deviation[:, 1] <= CROSSING_WIDE_RADII * radius)
    )
    thin[rows] = at_crossings(near.offset[rows] / radius)
    for scale in WIDER:
        rows = np.flatnonzero(thin)
        further = gather(point[rows], around, scale * REACH_RADII * radius, tree)
        thin[rows] = ~flat_further_out(further, scale * radius, noise)
        if scale == WIDER[0]:
            flatness = 0.5 * _tolerance(radius, noise) * radius
            least, inner = LINE_RADII * radius, REACH_RADII * radius
            thin[rows] &= ~are_corners(further, deviation[rows], least, inner, flatness)
    return thin


def _tolerance(radius: float, noise: float) -> float:
    """How far from a plane, in radii, what it explains may lie."""
    return min(max(TOLERANCE_RADII, TOLERANCE_SIGMAS * noise / radius), MOST_TOLERANCE_RADII)


def flat_further_out(around: Neighbourhood, radius: float, noise: float) -> np.ndarray:
    """Where a plane explains nearly all directions, (n,) bool, for splats as large as `radius`."""
    tolerance = _tolerance(radius, noise)
    return _best_arcs(around.offset / radius, around.count, tolerance, WIDER_ARC) >= WIDER_ARC


def at_crossings(offset: np.ndarray) -> np.ndarray:
    """Which neighbourhoods (n, MOST, 3), in radii, nearest first and zeros beyond their members, two tubes explain,
    (n,) bool: the first of them holds the splat itself."""
    away = np.linalg.norm(offset, axis=2)
    count = 1 + ((away > 0) & (away <= CROSSING_RADII)).sum(axis=1)
    return _share_of_tubes(offset, count) >= TUBES_SHARE


@kernel()
def _share_of_tubes(offset, count):
    """The share (n,) of the first `count` members that lie in the best tube through member 0 and the best one of the
    others."""
    n, most, _ = offset.shape
    share = np.zeros(n)
    left = np.empty(most, np.int64)
    for i in range(n):
        for j in range(count[i]):
            left[j] = j
        others = _outside_best_tube(offset[i], left, count[i], True)
        if 1 - others / count[i] >= FIRST_SHARE:
            share[i] = 1 - _outside_best_tube(offset[i], left, others, False) / count[i]
    return share


@kernel()
def _outside_best_tube(offset, left, n, through_first):
    """How many of the first `n` of `left` lie outside the tube along two of them that holds most; they become its
    first."""
    best, at, to = 0, -1, -1
    for h in range(HYPOTHESES if n > 1 else 0):
        a, b, _ = _three(h, n)
        inside = _inside_tube(offset, left, n, left[a], left[b], through_first)
        if inside > best:
            best, at, to = inside, left[a], left[b]
    outside = 0
    for j in range(n):
        if at < 0 or _off_line(offset, at, to, left[j]) > TUBE_RADII**2:
            left[outside] = left[j]
            outside += 1
    return outside


@kernel()
def _inside_tube(offset, left, n, a, b, through_first):
    """How many members lie in the tube along members `a` and `b`; 0 where those are too near to tell, or where it
    misses member 0."""
    length = 0.0
    for k in range(3):
        length += (offset[b, k] - offset[a, k]) ** 2
    if length < (CROSSING_RADII / 2) ** 2 or (through_first and _off_line(offset, a, b, 0) > TUBE_RADII**2):
        return 0
    inside = 0
    for j in range(n):
        inside += _off_line(offset, a, b, left[j]) <= TUBE_RADII**2
    return inside


@kernel()
def _off_line(offset, a, b, j):
    """The squared distance of member `j` from the line through members `a` and `b`."""
    d0, d1, d2 = offset[b, 0] - offset[a, 0], offset[b, 1] - offset[a, 1], offset[b, 2] - offset[a, 2]
    p0, p1, p2 = offset[j, 0] - offset[a, 0], offset[j, 1] - offset[a, 1], offset[j, 2] - offset[a, 2]
    c0, c1, c2 = _cross(d0, d1, d2, p0, p1, p2)
    return (c0 * c0 + c1 * c1 + c2 * c2) / (d0 * d0 + d1 * d1 + d2 * d2)


@kernel()
def _best_arcs(offset, count, tolerance, enough):
    """The longest arc (n,) of any hypothesis; stops at the first that is long enough."""
    n, most, _ = offset.shape
    best = np.zeros(n)
    height, x, y = np.empty(most), np.empty(most), np.empty(most)
    for i in range(n):
        for h in range(HYPOTHESES):
            a, b, c = _three(h, count[i])
            if not _project(offset[i], count[i], a, b, c, height, x, y):
                continue
            if abs(height[0]) > tolerance:
                continue
            best[i] = max(best[i], _arc_of_plane(count[i], height, x, y, tolerance))
            for j in range(count[i]):
                height[j] = -height[j]
            best[i] = max(best[i], _arc_of_plane(count[i], height, x, y, tolerance))
            if best[i] >= enough:
                break
    return best


@kernel()
def _three(hypothesis, count):
    """Three members, by a fixed hash, so that equal neighbourhoods are decided equally."""
    state = np.uint64(hypothesis + 1) * STEP
    state = (state ^ (state >> np.uint64(30))) * FIRST
    n = np.uint64(count)
    return (
        np.int64((state >> np.uint64(4)) % n),
        np.int64((state >> np.uint64(24)) % n),
        np.int64((state >> np.uint64(44)) % n),
    )


@kernel()
def _cross(p0, p1, p2, q0, q1, q2):
    return p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0


@kernel()
def _project(offset, count, a, b, c, height, x, y):
    """Members in the frame of the plane through members `a`, `b` and `c`; False where those are nearly on a line.

    Number by number: with arrays of three, these kernels took 6.3 s to compile; so, 1.9 s.
    """
    a0, a1, a2 = offset[a, 0], offset[a, 1], offset[a, 2]
    p0, p1, p2 = offset[b, 0] - a0, offset[b, 1] - a1, offset[b, 2] - a2
    q0, q1, q2 = offset[c, 0] - a0, offset[c, 1] - a1, offset[c, 2] - a2
    n0, n1, n2 = _cross(p0, p1, p2, q0, q1, q2)
    area, length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
    if area <= 0.2 * length * math.sqrt(q0 * q0 + q1 * q1 + q2 * q2):
        return False
    n0, n1, n2 = n0 / area, n1 / area, n2 / area
    p0, p1, p2 = p0 / length, p1 / length, p2 / length
    q0, q1, q2 = _cross(n0, n1, n2, p0, p1, p2)
    for j in range(count):
        o0, o1, o2 = offset[j, 0], offset[j, 1], offset[j, 2]
        height[j] = (o0 - a0) * n0 + (o1 - a1) * n1 + (o2 - a2) * n2
        x[j] = o0 * p0 + o1 * p1 + o2 * p2
        y[j] = o0 * q0 + o1 * q1 + o2 * q2
    return True


@kernel()
def _arc_of_plane(count, height, x, y, tolerance):
    """The longest arc on the kept side of any line that leaves all members above the plane behind, and the point
    not."""
    clean = True
    for j in range(count):
        clean = clean and height[j] <= tolerance
    best = 0.0
    direction = np.empty(count)
    for line in range(1 if clean else LINES):
        c, s = math.cos(2 * math.pi * line / LINES), math.sin(2 * math.pi * line / LINES)
        cut = -math.inf
        for j in range(count):
            if height[j] > tolerance:
                cut = max(cut, c * x[j] + s * y[j])
        if cut >= 0:
            continue
        kept = 0
        for j in range(count):
            if (
                abs(height[j]) <= tolerance
                and c * x[j] + s * y[j] >= cut
                and x[j] * x[j] + y[j] * y[j] >= RING_RADII**2
            ):
                _insert(direction, kept, math.atan2(y[j], x[j]))
                kept += 1
        best = max(best, _longest_run(direction[:kept]))
    return best


@kernel()
def _insert(held, n, value):
    """Put a value among the first `n`, which are sorted."""
    while n > 0 and held[n - 1] > value:
        held[n] = held[n - 1]
        n -= 1
    held[n] = value


@kernel()
def _longest_run(direction):
    """The longest arc whose sorted directions (m,) lie no further than WIDEST_GAP apart, around the turn."""
    m = len(direction)
    start = -1
    for j in range(m):
        after = direction[(j + 1) % m] + (2 * math.pi if j == m - 1 else 0.0)
        if after - direction[j] > WIDEST_GAP:
            start = (j + 1) % m
            break
    if m == 0 or start < 0:
        return 2 * math.pi if m else 0.0
    best, run = 0.0, 0.0
    for j in range(start, start + m - 1):
        here, after = direction[j % m], direction[(j + 1) % m]
        gap = after - here + (2 * math.pi if (j + 1) % m == 0 else 0.0)
        run = run + gap if gap <= WIDEST_GAP else 0.0
        best = max(best, run)
    return best
